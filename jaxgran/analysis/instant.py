"""An instant of a flow on the host: positions and speeds of its grains, and the forces between
them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgran.analysis.force_chains import pair_forces
from jaxgran.analysis.series import ratio
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.model.cell import centred


class Instant(NamedTuple):
    """The grains of a flow at one time, and the forces between them over one or more time steps."""

    positions: Float[np.ndarray, "grains 2"]  # in σ, in the sheared cell whose centre is the origin
    radii: Float[np.ndarray, " grains"]
    speed: Float[np.ndarray, " grains"]  # |c|, the peculiar speed, in σγ̇
    pairs: Int[np.ndarray, "pairs 2"]  # indices i < j of each pair in loaded contact
    force: Float[np.ndarray, " pairs"]  # mean over the time steps, in mσγ̇²
    clustered: Bool[np.ndarray, " pairs"]  # whether most of it acts in clusters of three or more
    side: float
    tilt: float


def instant_of(frame: Snapshot) -> Instant:
    """The instant of one snapshot, with the forces of its time step; of a series of successive ones
    as ``averaged``.
    """
    if np.ndim(frame.state.side):
        return averaged([instant_of(frame[k]) for k in range(len(frame))])
    arrays = jax.tree.map(np.asarray, frame)
    state, rate, pairs = arrays.state, arrays.shear_rate.item(), pair_forces(arrays)
    side, tilt = state.side.item(), state.tilt.item()
    return Instant(
        positions=centred(state.positions, side, tilt),
        radii=state.grains.radii,
        speed=np.hypot(*state.velocities.T) / rate,
        pairs=np.stack([pairs.i, pairs.j], axis=-1),
        force=pairs.force / rate**2,
        clustered=pairs.cluster_share > 0.5,
        side=side,
        tilt=tilt,
    )


def averaged(instants: Sequence[Instant]) -> Instant:
    """One instant from those of successive time steps: grains of the middle one, forces averaged
    over all.
    """
    middle = instants[len(instants) // 2]
    pairs, force, clustered = (
        np.concatenate([getattr(one, name) for one in instants])
        for name in ("pairs", "force", "clustered")
    )
    distinct, pair = np.unique(pairs, axis=0, return_inverse=True)
    total, in_clusters = (
        np.bincount(pair.ravel(), force * w, minlength=len(distinct)) for w in (1, clustered)
    )
    return middle._replace(
        pairs=distinct,
        force=total / len(instants),
        clustered=ratio(in_clusters, total) > 0.5,
    )
