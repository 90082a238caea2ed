"""Force chains: clusters of grains in loaded contact, and their forces.

A contact is *loaded* if it carries an impulse. A *cluster* is a set of grains connected by loaded
contacts.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxgran.analysis.series import Measured, by_time, ratio, series, with_errors
from jaxgran.contact.clusters import cluster_labels
from jaxgran.dynamics.snapshots import Snapshot


class Loaded(NamedTuple):
    """The loaded contacts of all snapshots, as one list."""

    time: Int[np.ndarray, " loaded"]  # number of the snapshot
    i: Int[np.ndarray, " loaded"]
    j: Int[np.ndarray, " loaded"]
    force: Float[np.ndarray, " loaded"]  # p/dt, in mσγ̇²
    normals: Float[np.ndarray, "loaded 2"]  # from grain j to grain i
    distances: Float[np.ndarray, " loaded"]  # of the centres, in σ

    def moments(self) -> Float[np.ndarray, "loaded 2 2"]:
        """σ^a F^b of each contact, in mσ²γ̇². The contact stress is their sum divided by the area
        of the cell.
        """
        return (
            (self.force * self.distances)[:, None, None]
            * self.normals[:, :, None]
            * self.normals[:, None, :]
        )


class PairForces(NamedTuple):
    """Pairs of grains in loaded contact at any time of a series, and their mean forces over the
    series.
    """

    i: Int[np.ndarray, " pairs"]
    j: Int[np.ndarray, " pairs"]  # > i
    force: Float[np.ndarray, " pairs"]  # mean of p/dt over all snapshots, loaded or not, in mσγ̇²
    cluster_share: Float[
        np.ndarray, " pairs"
    ]  # share of it that acts within clusters of three or more grains


class Clusters(NamedTuple):
    """The cluster of each grain at each time."""

    labels: Int[np.ndarray, "times grains"]  # unique over all times
    sizes: Int[np.ndarray, "times grains"]  # 1 without loaded contacts


class ClusterShare(NamedTuple):
    """Shares of loaded contacts, and of their force, pressure and shear stress, in clusters of
    three or more grains.

    Each is a scalar over the whole series. The contact pressure is Σ tr(σF)/2, the contact shear
    stress −Σ σ^x F^y. In a cluster of two, a binary collision, F = F_bc exactly: only larger ones
    raise the force ratio above 1.
    """

    contacts: Measured
    force: Measured
    pressure: Measured
    shear_stress: Measured


def loaded_contacts(snapshots: Snapshot) -> Loaded:
    """The contacts that carry an impulse, of all snapshots."""
    frames = series(snapshots)
    time, slot = np.nonzero(frames.contacts.used & (frames.impulses > 0))
    force = frames.impulses[time, slot] / frames.timestep[time]
    picked = (x[time, slot] for x in (frames.contacts.normals, frames.contacts.distances))
    return Loaded(
        time, frames.contacts.i[time, slot], frames.contacts.j[time, slot], force, *picked
    )


def clusters(snapshots: Snapshot) -> Clusters:
    """Clusters of grains connected by loaded contacts, at each time."""
    times, grains = series(snapshots).state.positions.shape[:2]
    load = loaded_contacts(snapshots)
    first = load.time * grains
    labels, sizes = cluster_labels(first + load.i, first + load.j, times * grains)
    return Clusters(labels.reshape(times, grains), sizes.reshape(times, grains))


def pair_forces(snapshots: Snapshot) -> PairForces:
    """Mean force of each pair over a series; with a snapshot every time step, its impulse over the
    elapsed time.
    """
    load, sizes = loaded_contacts(snapshots), clusters(snapshots).sizes
    times, grains = sizes.shape
    keys = np.minimum(load.i, load.j).astype(np.int64) * grains + np.maximum(load.i, load.j)
    pairs, pair = np.unique(keys, return_inverse=True)
    in_cluster = sizes[load.time, load.i] > 2
    total, clustered = (
        np.bincount(pair, load.force * w, minlength=pairs.size) for w in (1, in_cluster)
    )
    return PairForces(pairs // grains, pairs % grains, total / times, ratio(clustered, total))


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
