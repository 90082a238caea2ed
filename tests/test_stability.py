"""Where the time step, the packing fraction and the precision fail, every failure is flagged or refused."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import stability
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import DEEP_OVERLAP, Status

PAIRS = stability.GRAINS // 2
pack = jax.jit(stability.pack)


@pytest.mark.parametrize("packing_fraction", [0.82, 0.835])
def test_dense_flow_converges_or_is_flagged(packing_fraction: float) -> None:
    """Beside jamming at 0.8386: what is called ok is solved, hardly overlaps and is finite, and no energy appears."""
    state, _ = warm(0.0, packing_fraction)
    flow = stability.flow_of("default", 0.0, packing_fraction, timestep=3e-4)
    before = stability.energy(state)
    state, tally = stability.advance(flow, state, jnp.int32(300))
    finite = all(np.isfinite(x).all() for x in jax.tree.leaves((state, tally)))
    status = Status(int(tally.status))
    assert finite or status == Status.nonfinite
    if status == Status.ok:
        assert (tally.deep_contacts > 0) == (tally.largest_overlap > DEEP_OVERLAP)
        assert tally.worst_residual <= 1.01 * stability.solver_of("default").tolerance
    else:
        assert tally.unconverged > 0 or not finite
    assert not stability.gains(tally, stability.energy(state) - before, 1e-6 * before)


def test_float32_positions_lose_collisions_at_a_timestep_below_their_rounding() -> None:
    """Where a step moves a pair by less than half a rounding of its separation, 6e-8 σ or less, it stands still."""
    for timestep, found in ((1e-5, True), (1e-6, True), (1e-8, False)):
        wide, narrow = (collisions(variant, timestep) for variant in ("default", "float32"))
        assert wide == PAIRS
        lost = PAIRS - narrow
        assert lost == 0 if found else lost > 4 * np.sqrt(PAIRS) / 2, timestep  # four errors of a count out of PAIRS


@cache
def warm(restitution: float, packing_fraction: float) -> tuple[State, float]:
    """``stability.prepared`` of less strain, shared by the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability, "pack", pack)
        patch.setattr(stability, "PREPARATION", [(0.05, 1e-3)] * 8)
        return stability.prepared(restitution, packing_fraction)


def collisions(variant: str, timestep: float) -> int:
    """How many of lone pairs, at speeds of 0.5 to 2 σγ̇ and gaps of 1e-5 σ, collide in the time in which all should."""
    flow = stability.flow_of(variant, 0.9, 0.1, timestep=timestep)
    dtype, random, gap, row = flow.timestep.dtype, np.random.default_rng(0), 1e-5, np.arange(PAIRS)
    angle, speed = random.uniform(0, 2 * np.pi, PAIRS), random.uniform(0.5, 2, PAIRS)[:, None]
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    radii = random.uniform(0.4, 0.6, (2, PAIRS))
    places = 4.0 + 6.0 * np.stack([row % 8, row // 8], axis=-1)
    positions = np.concatenate([places, places + along * (radii.sum(axis=0) + gap)[:, None]])
    velocities = np.concatenate([along * speed / 2, -along * speed / 2])
    velocities[:, 0] -= positions[:, 1]  # peculiar; the shear rate is one
    radii = radii.ravel()
    state = State(Grains(radii, 4 * radii**2), positions, velocities, np.asarray(54.0), np.asarray(0.0))
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype), state)
    steps = jnp.int32(np.ceil(4 * gap / timestep) + 4)
    state, tally = stability.advance(flow, state, steps, solver=stability.solver_of(variant))
    return int(tally.collisions)
