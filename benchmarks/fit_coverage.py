"""How often do the intervals of a fitted restitution hold? 100 trajectories of tracked discs for each noise.

    python -m benchmarks fit_coverage           # all noises at one restitution, some at two more; 40 minutes
    python -m benchmarks fit_coverage --quick   # one restitution, ten trajectories; --runs 40 for another number

The trajectories are made by the event-driven reference, which shares no code with the fit: N = 64, ν = 0.6, 100 frames
over a strain of 0.5. Positions, velocities and presence are then spoilt. The noise is not given to the fit. The
limits of the fit were chosen on trajectories of another seed.
"""

import time
from dataclasses import replace

import jax
import numpy as np

import jaxgran as jg
from benchmarks.event_driven import Discs, Law, discs_of, sheared
from benchmarks.output import Output
from jaxgran.model.checks import InputError

GRAINS, FRACTION, FRAMES, STRAIN = 64, 0.6, 100, 0.5
RESTITUTIONS = (0.6, 0.3, 0.9)
RUNS, FEW_RUNS = 100, 10
CONTACT_DURATION = 1e-6  # of the reference, in 1/γ̇: no collapse can last
SETTLING = 2.0  # strain before the first trajectory
BETWEEN = 0.5  # strain from one trajectory to the next
SEED = 1  # 0 made the trajectories on which the limits of the fit were chosen

# Noise of velocities over their root mean square (None: no velocities), of positions in σ, and share of discs not seen
NOISES = [(v, x, m) for v in (0.0, 0.01, 0.05, None) for x in (1e-4, 1e-3) for m in (0.0, 0.1)]
FEW_NOISES = [(0.0, 1e-4, 0.0), (0.05, 1e-3, 0.0), (0.05, 1e-3, 0.1), (None, 1e-4, 0.0)]


def trajectories(
    restitution: float, runs: int, fraction: float = FRACTION, frames: int = FRAMES, strain: float = STRAIN
) -> list[jg.Tracks]:
    """Tracks without noise, one after the other of one flow."""
    flow = jg.ShearFlow(GRAINS, restitution, fraction, 1e-3)
    discs, law = discs_of(jg.prepare(flow, jax.random.key(SEED))), Law(restitution, CONTACT_DURATION)
    discs, _ = sheared(discs, law, SETTLING)
    found = []
    for _ in range(runs):
        discs, seen = observed(discs, law, frames, strain)
        found.append(seen)
        discs, _ = sheared(discs, law, BETWEEN)
    return found


def observed(discs: Discs, law: Law, frames: int = FRAMES, strain: float = STRAIN) -> tuple[Discs, jg.Tracks]:
    """The discs after a trajectory, and its tracks."""
    positions, velocities, cell = [], [], []
    for k in range(frames):
        if k:
            discs, _ = sheared(discs, law, strain / (frames - 1))
        positions.append(discs.positions.copy())
        velocities.append(discs.velocities.copy())
        velocities[-1][:, 0] += law.shear_rate * discs.positions[:, 1]
        cell.append((discs.side, discs.side, discs.side * (discs.tilt - np.floor(discs.tilt + 0.5))))
    times = strain * np.arange(frames) / (frames - 1)
    arrays = (np.array(x) for x in (positions, velocities, cell))
    return discs, jg.Tracks(times, 2 * discs.radii, discs.masses, *arrays, law.shear_rate)


def peculiar(seen: jg.Tracks) -> np.ndarray:
    """Velocities less those of the shear, at γ̇ = 1."""
    return seen.velocities - np.stack([seen.positions[..., 1], 0 * seen.positions[..., 1]], axis=-1)


def spoilt(seen: jg.Tracks, velocity: float | None, position: float, missing: float, seed: int) -> jg.Tracks:
    """Tracks with noise."""
    rng = np.random.default_rng([SEED, seed])
    error = np.nan if velocity is None else velocity * np.sqrt(np.mean(peculiar(seen) ** 2))
    positions = seen.positions + position * rng.normal(size=seen.positions.shape)
    velocities = seen.velocities + error * rng.normal(size=seen.positions.shape)
    unseen = rng.random(seen.positions.shape[:2]) < missing
    positions[unseen], velocities[unseen] = np.nan, np.nan
    return replace(seen, positions=positions, velocities=velocities)


def row(found: list[jg.Tracks], restitution: float, velocity: float | None, position: float, missing: float) -> dict:
    """Coverage and bias of the fits of all trajectories with one noise."""
    fits, refused, start = [], 0, time.perf_counter()
    for seed, seen in enumerate(found):
        try:
            fits.append(jg.fit_restitution(spoilt(seen, velocity, position, missing, seed)))
        except (InputError, RuntimeError):
            refused += 1
    off = np.array([fit.restitution - restitution for fit in fits])
    errors = np.array([fit.stderr for fit in fits])
    held = np.array([fit.low <= restitution <= fit.high for fit in fits])
    return {
        "restitution": restitution,
        "velocity_noise": velocity,
        "position_noise": position,
        "missing": missing,
        "fits": len(fits),
        "refused": refused,
        "coverage": float(held.mean()),
        "coverage_stderr": float(np.sqrt(held.mean() * (1 - held.mean()) / len(held))),
        "bias_in_errors": float(np.mean(off / errors)),
        "spread_in_errors": float(np.std(off / errors, ddof=1)),
        "bias": float(off.mean()),
        "stderr": float(np.median(errors)),
        "collisions": float(np.mean([fit.collisions for fit in fits])),
        "rejected": float(np.mean([fit.rejected for fit in fits])),
        "misfit": float(np.median([fit.misfit for fit in fits])),
        "seconds": (time.perf_counter() - start) / len(found),
    }


def sentence(row: dict) -> str:
    noise = "none" if row["velocity_noise"] is None else f"{100 * row['velocity_noise']:g} %"
    return (
        f"α {row['restitution']:g}, velocities {noise}, positions {row['position_noise']:g}, "
        f"missing {100 * row['missing']:g} %: {100 * row['coverage']:.0f} % of {row['fits']} intervals hold, "
        f"bias {row['bias_in_errors']:+.2f} ± {row['spread_in_errors'] / np.sqrt(row['fits']):.2f} errors, spread "
        f"{row['spread_in_errors']:.2f}, error {row['stderr']:.1e}, {row['collisions']:.0f} collisions, "
        f"{row['rejected']:.0f} rejected, refused {row['refused']}, misfit {row['misfit']:.2f}, {row['seconds']:.2f} s"
    )


def run(output: Output, runs: int | None = None) -> None:
    """Fit all trajectories with all noises, print, and write JSON."""
    rows = []
    for restitution in RESTITUTIONS[:1] if output.quick else RESTITUTIONS:
        found = trajectories(restitution, runs or (FEW_RUNS if output.quick else RUNS))
        few = output.quick or restitution != RESTITUTIONS[0]
        for noise in FEW_NOISES if few else NOISES:
            rows.append(row(found, restitution, *noise))
            print(sentence(rows[-1]), flush=True)
    output.write_json("fit_coverage", {"grains": GRAINS, "packing_fraction": FRACTION, "rows": rows})
