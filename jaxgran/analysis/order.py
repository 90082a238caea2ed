"""Structure of a flow from snapshots: coordination, pair correlation, hexatic order, profiles."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay

from jaxgran.analysis.force_chains import loaded_contacts
from jaxgran.analysis.series import Curve, Measured, all_pairs, centres, histograms, ratio, series, with_errors
from jaxgran.dynamics.snapshots import Snapshot

_IMAGE_SPACINGS = 5  # margin of images in mean grain spacings, longer than any Delaunay edge


class Coordination(NamedTuple):
    """Coordination number: twice the number of contacts over the number of grains.

    Rattlers, grains with fewer than three contacts, are removed recursively.
    """

    loaded: Measured
    loaded_without_rattlers: Measured
    touching: Measured
    touching_without_rattlers: Measured


class HexaticOrder(NamedTuple):
    """``overall`` |⟨ψ₆⟩| and ``local`` ⟨|ψ₆|⟩ over the grains; both are 1 in a hexagonal crystal.

    Without order, the former is about N^(−1/2).
    """

    overall: Measured
    local: Measured


class Profiles(NamedTuple):
    """Number density (1/σ²) and mass-weighted mean velocities along x (σγ̇) against the height y (σ)."""

    density: Curve
    peculiar_velocity: Curve
    laboratory_velocity: Curve


def coordination(snapshots: Snapshot, tolerance: float = 1e-3) -> Coordination:
    """Coordination number of the loaded contacts, and of all pairs whose gap is at most ``tolerance`` (σ)."""
    frames, load = series(snapshots), loaded_contacts(snapshots)
    times, grains = frames.state.positions.shape[:2]
    radii = frames.state.grains.radii
    # rows: loaded, loaded without rattlers, touching, touching without rattlers
    ends = np.zeros((4, times))  # twice the contacts
    kept = np.full((4, times), float(grains))
    for t, (i, j, separations) in enumerate(all_pairs(frames)):
        touching = np.linalg.norm(separations, axis=-1) - radii[t, i] - radii[t, j] <= tolerance
        here = load.time == t
        for k, (a, b) in enumerate(((load.i[here], load.j[here]), (i[touching], j[touching]))):
            ends[2 * k, t] = 2 * len(a)
            ends[2 * k + 1, t], kept[2 * k + 1, t] = _without_rattlers(a, b, grains)
    z = with_errors(lambda s: {"z": ratio(s["ends"], s["kept"])}, {"ends": ends.T, "kept": kept.T})["z"]
    return Coordination(*(Measured(*number) for number in zip(*z, strict=True)))


def pair_correlation(snapshots: Snapshot, edges: ArrayLike) -> Curve:
    """Pair correlation g against the separation over the contact distance, r/((d_i + d_j)/2).

    g is the number of pairs in a bin over that of random points in the cell. It is valid as long as the last edge times
    the largest diameter is below half the side.
    """
    frames, edges = series(snapshots), np.asarray(edges)
    i, j = np.triu_indices(frames.state.positions.shape[1], 1)
    contact_distances = frames.state.grains.radii[:, i] + frames.state.grains.radii[:, j]
    pairs = [
        np.histogram(np.linalg.norm(separations, axis=-1) / touching, edges)[0]
        for (_, _, separations), touching in zip(all_pairs(frames), contact_distances, strict=True)
    ]
    at_random = np.pi * np.sum(contact_distances**2, axis=1) / frames.state.side**2
    expected = at_random[:, None] * np.diff(edges**2)
    estimates = with_errors(
        lambda s: {"g": ratio(s["pairs"], s["expected"])}, {"pairs": np.stack(pairs), "expected": expected}
    )
    return Curve(centres(edges), *estimates["g"])


def hexatic_order(snapshots: Snapshot) -> HexaticOrder:
    """Sixfold bond-orientational order: ψ₆ of a grain is the mean of exp(6iθ) over its Delaunay neighbours.

    Source: D. R. Nelson and B. I. Halperin, Phys. Rev. B 19, 2457 (1979).
    """
    state = series(snapshots).state
    orders = []
    for positions, side, tilt in zip(state.positions, state.side, state.tilt, strict=True):
        points, grains = _with_images(positions, side, tilt), len(positions)
        first, neighbours = Delaunay(points).vertex_neighbor_vertices
        count = np.diff(first[: grains + 1])
        bonds = points[neighbours[: first[grains]]] - np.repeat(points[:grains], count, axis=0)
        waves = np.exp(6j * np.arctan2(bonds[:, 1], bonds[:, 0]))
        psi = np.add.reduceat(waves, first[:grains]) / count
        orders.append([1.0, np.abs(psi.mean()), np.abs(psi).mean()])
    psi6 = with_errors(lambda s: {"psi": s["x"][..., 1:] / s["x"][..., :1]}, {"x": np.array(orders)})["psi"]
    return HexaticOrder(*(Measured(*order) for order in zip(*psi6, strict=True)))


def profiles(snapshots: Snapshot, bins: int = 10) -> Profiles:
    """Density and mean velocity in bands of equal height; the side must be the same at all times."""
    frames = series(snapshots)
    state, shear_rate = frames.state, frames.shear_rate
    times, grains = state.positions.shape[:2]
    edges = np.linspace(0, state.side[0], bins + 1)
    time, height = np.repeat(np.arange(times), grains), (state.positions[..., 1] % state.side[:, None]).ravel()
    masses = state.grains.masses
    weights = {"n": np.ones_like(masses), "m": masses, "p": masses * state.velocities[..., 0]}
    sums = {name: histograms(times, time, height, edges, x.ravel()) for name, x in weights.items()}
    sums["area"] = state.side**2 / bins
    estimates = with_errors(lambda s: {"n": s["n"] / s["area"][..., None], "c": ratio(s["p"], s["m"])}, sums)
    heights = centres(edges)
    laboratory = Curve(heights, estimates["c"].value + shear_rate[0] * heights, estimates["c"].error)
    return Profiles(Curve(heights, *estimates["n"]), Curve(heights, *estimates["c"]), laboratory)


def _without_rattlers(i: np.ndarray, j: np.ndarray, grains: int) -> tuple[int, int]:
    """Twice the contacts, and the grains, that remain when rattlers are removed recursively."""
    while True:
        count = np.bincount(np.concatenate([i, j]), minlength=grains)
        kept = (count[i] > 2) & (count[j] > 2)
        if kept.all():
            return 2 * len(i), int(np.sum(count > 2))
        i, j = i[kept], j[kept]


def _with_images(positions: Float[np.ndarray, "grains 2"], side: float, tilt: float) -> Float[np.ndarray, "points 2"]:
    """Positions of the grains, followed by those of their images in a margin around the cell."""
    lattice = side * np.array([[1, 0], [tilt, 1]])
    fractional = positions @ np.linalg.inv(lattice)
    fractional -= np.floor(fractional)
    margin = min(1, _IMAGE_SPACINGS / np.sqrt(len(positions)))
    shifts = np.stack(np.meshgrid((0, 1, -1), (0, 1, -1)), axis=-1).reshape(-1, 1, 2)
    images = (fractional + shifts).reshape(-1, 2)
    near = np.all((images >= -margin) & (images <= 1 + margin), axis=1)
    return images[near] @ lattice
