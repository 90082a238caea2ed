"""Force chains: clusters of grains in loaded contact, their forces and fabric.

A contact is *loaded* if it carries an impulse. A *cluster* is a set of grains connected by loaded contacts.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxgran.analysis.series import Curve, Measured, Sums, by_time, centres, histograms, ratio, series, with_errors
from jaxgran.contact.clusters import cluster_labels
from jaxgran.dynamics.snapshots import Snapshot

_DIRECTIONS = 12  # bins of 15° on the half circle, for the mean force at an angle


class Loaded(NamedTuple):
    """The loaded contacts of all snapshots, as one list."""

    time: Int[np.ndarray, " loaded"]  # number of the snapshot
    i: Int[np.ndarray, " loaded"]
    j: Int[np.ndarray, " loaded"]
    force: Float[np.ndarray, " loaded"]  # p/dt, in mσγ̇²
    normals: Float[np.ndarray, "loaded 2"]  # from grain j to grain i
    distances: Float[np.ndarray, " loaded"]  # of the centres, in σ

    def moments(self) -> Float[np.ndarray, "loaded 2 2"]:
        """σ^a F^b of each contact, in mσ²γ̇². The contact stress is their sum divided by the area of the cell."""
        return (self.force * self.distances)[:, None, None] * self.normals[:, :, None] * self.normals[:, None, :]


class PairForces(NamedTuple):
    """Pairs of grains in loaded contact at any time of a series, and their mean forces over the series."""

    i: Int[np.ndarray, " pairs"]
    j: Int[np.ndarray, " pairs"]  # > i
    force: Float[np.ndarray, " pairs"]  # mean of p/dt over all snapshots, loaded or not, in mσγ̇²
    cluster_share: Float[np.ndarray, " pairs"]  # share of it that acts within clusters of three or more grains


class Clusters(NamedTuple):
    """The cluster of each grain at each time."""

    labels: Int[np.ndarray, "times grains"]  # unique over all times
    sizes: Int[np.ndarray, "times grains"]  # 1 without loaded contacts


class ClusterShare(NamedTuple):
    """Shares of loaded contacts, and of their force, pressure and shear stress, in clusters of three or more grains.

    Each is a scalar over the whole series. The contact pressure is Σ tr(σF)/2, the contact shear stress −Σ σ^x F^y. In
    a cluster of two, a binary collision, F = F_bc exactly: only larger ones raise the force ratio above 1.
    """

    contacts: Measured
    force: Measured
    pressure: Measured
    shear_stress: Measured


class Fabric(NamedTuple):
    """Anisotropies of the loaded contacts. Angles are those of the normals, in radians in (−π/2, π/2].

    =================  ======  ====  ====================================================================
    field              shape   unit  meaning
    =================  ======  ====  ====================================================================
    tensor             (2, 2)  –     fabric tensor ⟨n n⟩
    anisotropy         ()      –     a_c of the density of directions (1 + a_c cos 2(θ − θ_c))/2π
    direction          ()      rad   θ_c
    force_anisotropy   ()      –     a_n of the mean force at an angle, f₀(1 + a_n cos 2(θ − θ_n))
    force_direction    ()      rad   θ_n
    stress_anisotropy  ()      –     (Σ₁ − Σ₂)/(Σ₁ + Σ₂), principal values of the contact stress
    =================  ======  ====  ====================================================================
    """

    tensor: Measured
    anisotropy: Measured
    direction: Measured
    force_anisotropy: Measured
    force_direction: Measured
    stress_anisotropy: Measured


def loaded_contacts(snapshots: Snapshot) -> Loaded:
    """The contacts that carry an impulse, of all snapshots."""
    frames = series(snapshots)
    time, slot = np.nonzero(frames.contacts.used & (frames.impulses > 0))
    force = frames.impulses[time, slot] / frames.timestep[time]
    picked = (x[time, slot] for x in (frames.contacts.normals, frames.contacts.distances))
    return Loaded(time, frames.contacts.i[time, slot], frames.contacts.j[time, slot], force, *picked)


def clusters(snapshots: Snapshot) -> Clusters:
    """Clusters of grains connected by loaded contacts, at each time."""
    times, grains = series(snapshots).state.positions.shape[:2]
    load = loaded_contacts(snapshots)
    first = load.time * grains
    labels, sizes = cluster_labels(first + load.i, first + load.j, times * grains)
    return Clusters(labels.reshape(times, grains), sizes.reshape(times, grains))


def pair_forces(snapshots: Snapshot) -> PairForces:
    """Mean force of each pair over a series; with a snapshot every time step, its impulse over the elapsed time."""
    load, sizes = loaded_contacts(snapshots), clusters(snapshots).sizes
    times, grains = sizes.shape
    keys = np.minimum(load.i, load.j).astype(np.int64) * grains + np.maximum(load.i, load.j)
    pairs, pair = np.unique(keys, return_inverse=True)
    in_cluster = sizes[load.time, load.i] > 2
    total, clustered = (np.bincount(pair, load.force * w, minlength=pairs.size) for w in (1, in_cluster))
    return PairForces(pairs // grains, pairs % grains, total / times, ratio(clustered, total))


def cluster_sizes(snapshots: Snapshot, edges: ArrayLike | None = None) -> Curve:
    """Share of each size among the clusters of two or more grains, averaged over the sizes in each bin.

    ``edges`` are integer bin edges; a bin contains its lower edge. By default each size is a bin.
    """
    sizes = clusters(snapshots).sizes
    edges = np.arange(2, max(sizes.max(), 2) + 2) if edges is None else np.asarray(edges)
    time = np.repeat(np.arange(len(sizes)), sizes.shape[1])
    weights = np.where(sizes > 1, 1 / sizes, 0)  # the grains of a cluster have a total weight of one
    sums = {"n": histograms(len(sizes), time, sizes.ravel(), edges, weights.ravel()), "all": weights.sum(axis=1)}
    estimates = with_errors(lambda s: {"p": ratio(s["n"], s["all"][..., None] * np.diff(edges))}, sums)["p"]
    return Curve(centres(edges) - 0.5, *estimates)


def cluster_share(snapshots: Snapshot) -> ClusterShare:
    """Shares of clusters of three or more grains in the contacts, forces and contact stress."""
    load, sizes = loaded_contacts(snapshots), clusters(snapshots).sizes
    moments = load.moments()
    pressure, shear = (moments[:, 0, 0] + moments[:, 1, 1]) / 2, -moments[:, 0, 1]
    carried = np.stack([np.ones_like(load.force), load.force, pressure, shear], axis=-1)
    in_cluster = (sizes[load.time, load.i] > 2)[:, None]
    sums = {
        "all": by_time(len(sizes), load.time, carried),
        "many": by_time(len(sizes), load.time, carried * in_cluster),
    }
    estimates = with_errors(lambda s: {"share": ratio(s["many"], s["all"])}, sums)["share"]
    return ClusterShare(*(Measured(*share) for share in zip(*estimates, strict=True)))


def force_distribution(snapshots: Snapshot, edges: ArrayLike) -> Curve:
    """Probability density of F/⟨F⟩ over the loaded contacts, in bins with the given edges."""
    load, edges = loaded_contacts(snapshots), np.asarray(edges)
    times = len(series(snapshots).impulses)
    counts = histograms(times, load.time, load.force * load.force.size / load.force.sum(), edges)
    sums = {"n": counts, "all": np.bincount(load.time, minlength=times)}
    estimates = with_errors(lambda s: {"p": ratio(s["n"], s["all"][..., None] * np.diff(edges))}, sums)["p"]
    return Curve(centres(edges), *estimates)


def fabric(snapshots: Snapshot) -> Fabric:
    """Fabric tensor and the anisotropies of contacts and forces.

    For nearly monodisperse discs with aligned principal directions they give the stress:
    (Σ₁ − Σ₂)/(Σ₁ + Σ₂) ≈ (a_c + a_n)/2, or (a_c + a_n)/(2 + a_c a_n) to second order. The mean force at an angle is
    taken in bins of 15°; the force anisotropy is NaN if a bin is empty.

    Source: L. Rothenburg and R. J. Bathurst, Géotechnique 39, 601 (1989).
    """
    load, times = loaded_contacts(snapshots), len(series(snapshots).impulses)
    angle = np.arctan2(load.normals[:, 1], load.normals[:, 0]) % np.pi
    edges = np.linspace(0, np.pi, _DIRECTIONS + 1)
    angle = np.minimum(angle, np.nextafter(np.pi, 0))  # a tiny negative angle modulo π rounds to π
    sums = {
        "nn": by_time(times, load.time, load.normals[:, :, None] * load.normals[:, None, :]),
        "stress": by_time(times, load.time, load.moments()),
        "contacts": histograms(times, load.time, angle, edges),
        "force": histograms(times, load.time, angle, edges, load.force),
    }
    width = np.pi / _DIRECTIONS
    wave = np.stack([np.cos(2 * centres(edges)), np.sin(2 * centres(edges))])
    wave = wave * width / np.sin(width)  # corrects for the average over the width of a bin

    def estimate(s: Sums) -> Sums:
        normals, stress = (ratio(x, np.trace(x, axis1=-2, axis2=-1)[..., None, None]) for x in (s["nn"], s["stress"]))
        force = ratio(s["force"], s["contacts"])
        (contact, direction), (deviator, _) = (_mode(x[..., 0, 0] - 0.5, x[..., 0, 1]) for x in (normals, stress))
        second, force_direction = _mode(*((force * w).sum(axis=-1) for w in wave))
        return {
            "tensor": normals,
            "anisotropy": 4 * contact,
            "direction": direction,
            "force_anisotropy": ratio(2 * second, force.sum(axis=-1)),
            "force_direction": force_direction,
            "stress_anisotropy": 2 * deviator,
        }

    return Fabric(**with_errors(estimate, sums))


def _mode(x: Any, y: Any) -> tuple[Any, Any]:
    """Amplitude and angle of a second Fourier mode."""
    return np.hypot(x, y), np.arctan2(y, x) / 2
