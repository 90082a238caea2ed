"""Tracks of discs by the event-driven reference, which shares no code with jaxgran, as a camera would see them."""

from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.independent.event_driven import Discs, Law, sheared
from jaxgran.io.tracks import Tracks

GRAINS, FRAMES, STRAIN, RESTITUTION = 64, 60, 0.3, 0.6


@cache
def tracks(restitution: float = RESTITUTION, shear_rate: float = 1.0, seed: int = 0, strain: float = STRAIN) -> Tracks:
    """What is seen without noise, after a strain of 0.5 from a lattice; ν = 0.5."""
    rng = np.random.default_rng(seed)
    radii = rng.permutation(np.linspace(0.37, 0.63, GRAINS))
    side = float(np.sqrt(np.pi * np.sum(radii**2) / 0.5))
    rows = round(np.sqrt(GRAINS))
    lattice = (np.stack(np.meshgrid(np.arange(rows), np.arange(rows)), axis=-1).reshape(-1, 2) + 0.5) * side / rows
    masses = 4 * radii**2
    velocities = rng.normal(size=(GRAINS, 2)) / np.sqrt(masses)[:, None]
    velocities -= np.sum(masses[:, None] * velocities, axis=0) / masses.sum()
    discs = Discs(radii, masses, lattice, velocities, np.full(GRAINS, -np.inf), side, 0.0)
    law = Law(restitution, 1e-9, shear_rate)
    discs, _ = sheared(discs, law, 0.5)
    seen = []
    for _ in range(FRAMES):
        cell = (discs.side, discs.side, (discs.tilt - np.floor(discs.tilt + 0.5)) * discs.side)
        seen.append((discs.positions.copy(), discs.velocities.copy(), cell))
        discs, _ = sheared(discs, law, strain / (FRAMES - 1))
    positions, velocities, cell = (np.array(x) for x in zip(*seen, strict=True))
    velocities[..., 0] += shear_rate * positions[..., 1]
    time = strain * np.arange(FRAMES) / (FRAMES - 1)
    return Tracks(time, 2 * radii, masses, positions, velocities, cell, shear_rate)


def noisy(seen: Tracks, position: float, velocity: float, missing: float = 0.0, seed: int = 0) -> Tracks:
    """The same with noise: of positions in σ, of velocities over a typical one; and with a share that is not seen."""
    rng = np.random.default_rng(seed)
    speed = np.sqrt(np.mean(np.diff(seen.positions, axis=0)[..., 1].clip(-0.1, 0.1) ** 2)) / np.diff(seen.time).mean()
    positions = seen.positions + position * rng.normal(size=seen.positions.shape)
    velocities = seen.velocities + velocity * speed * rng.normal(size=seen.positions.shape)
    unseen = rng.random(seen.positions.shape[:2]) < missing
    positions[unseen], velocities[unseen] = np.nan, np.nan
    return replace(seen, positions=positions, velocities=velocities)


def without_velocities(seen: Tracks) -> Tracks:
    return replace(seen, velocities=np.full(seen.velocities.shape, np.nan))
