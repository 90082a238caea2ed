"""Where the time step, the packing fraction and the precision fail, every failure is flagged or
refused.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import stability
from jaxgran.model.state import State
from jaxgran.model.status import DEEP_OVERLAP, Status

pack = jax.jit(stability.pack)


@pytest.mark.parametrize("packing_fraction", [0.82, 0.835])
def test_dense_flow_converges_or_is_flagged(packing_fraction: float) -> None:
    """Beside jamming at 0.8386: what is called ok is solved, hardly overlaps and is finite, and no
    energy appears.
    """
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


@cache
def warm(restitution: float, packing_fraction: float) -> tuple[State, float]:
    """``stability.prepared`` of less strain, shared by the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stability, "pack", pack)
        patch.setattr(stability, "PREPARATION", [(0.05, 1e-3)] * 8)
        return stability.prepared(restitution, packing_fraction)
