"""Where the time step, the packing fraction and the precision fail, every failure is flagged or
refused.
"""

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import refused

import jaxgran as jg
from benchmarks import stability
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import DEEP_OVERLAP, Status


@pytest.mark.parametrize("packing_fraction", [0.82, stability.JAMMED])
def test_dense_flow_converges_or_is_flagged(packing_fraction: float) -> None:
    """Below jamming at 0.8386 it is ok. Above, what is called ok is solved, hardly overlaps and is
    finite, and no energy appears.
    """
    grains, solver = 64, jg.BarzilaiBorwein()
    state = stability.start(grains, 0.0, packing_fraction, seed=0)
    flow = stability.flow_of(grains, 0.0, packing_fraction, 3e-4)
    before = stability.energy(state)
    state, tally = stability.advance(flow, state, jnp.int32(300), solver=solver)
    finite = all(np.isfinite(x).all() for x in jax.tree.leaves((state, tally)))
    status = Status(int(tally.status))
    assert finite or status == Status.nonfinite
    if status == Status.ok:
        assert (tally.deep_contacts > 0) == (tally.largest_overlap > DEEP_OVERLAP)
        assert tally.worst_residual <= 1.01 * solver.tolerance
    else:
        assert tally.unconverged > 0 or not finite
    assert status == Status.ok or packing_fraction >= stability.JAMMED
    assert not stability.gains(tally, stability.energy(state) - before, 1e-6 * before)


def test_a_setting_is_silent_only_if_nothing_tells_that_it_is_wrong() -> None:
    for errors, outcome, judged in (
        ([[0.01, 0.01], [-0.04, 0.01]], "ok", "ok"),
        ([[0.01, 0.01], [-0.04, 0.01]], "deep_overlap", "ok"),
        ([[0.01, 0.01], [-0.055, 0.01]], "ok", "ok"),
        ([[0.01, 0.01], [-0.07, 0.01]], "ok", "silent"),
        ([[0.2, 0.01], [0.0, 0.01]], "deep_overlap", "deep_overlap"),
        ([[0.0, 0.01], [0.0, 0.01]], "iteration_limit", "iteration_limit"),
        (None, "ok", "silent"),
    ):
        row = {"method": "default", "outcome": outcome, "errors": errors}
        assert stability.verdict(row) == judged
    soft = {"method": "soft discs, LAMMPS", "outcome": "ok"}
    assert stability.verdict(soft | {"errors": [[0.1, 0.0]]}) == "too_soft"
    assert stability.verdict(soft | {"errors": None}) == "no_reference"


def test_parts_of_a_block_make_it_up() -> None:
    for steps in (1, 2, 100, 5000):
        assert sum(stability.pieces(steps)) == steps
        assert stability.pieces(steps)[0] <= max(1, steps // 1000)


def test_a_time_step_that_maps_refuse_stands_in_brackets() -> None:
    row = {
        "alpha": 0.95,
        "nu": 0.3,
        "method": "default",
        "outcome": "ok",
        "errors": [[0, 0.01]] * 2,
    }
    for setting, shown in ((3e-3, r"($3\times10^{-3}$)"), (3e-4, r"$3\times10^{-4}$")):
        with refused("timestep must be at most 7") if shown[0] == "(" else nullcontext():
            MapSettings((0.95,), (0.3,), timestep=setting)
        figure = stability.draw([row | {"setting": setting}])
        assert shown in [text.get_text() for text in figure.axes[0].texts]
