"""Above the packing fraction of jamming every failure is flagged; the table of failures calls a
wrong average silent only if no status tells.
"""

from functools import partial
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran as jg
from benchmarks import stability
from benchmarks.peers.problem import Run, Stress
from jaxgran.model.status import DEEP_OVERLAP, Status


@pytest.mark.parametrize("packing_fraction", [0.82, stability.JAMMED])
def test_dense_flow_converges_or_is_flagged(packing_fraction: float) -> None:
    """Below jamming at 0.8386 it is ok; above, what is called ok is solved and gains no energy."""
    case = stability.Case(0.0, packing_fraction, 64)
    solver = jg.BarzilaiBorwein()
    state = stability.start(case, seed=0)
    before = float(np.sum(state.grains.masses[:, None] * state.velocities**2) / 2)
    flow = stability.flow_of(case, 3e-4)
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
    work = -(tally.contact_moment[0, 1] + tally.kinetic_moment[0, 1])
    assert tally.dissipation >= -1e-6 * before
    assert tally.energy_change <= work - tally.dissipation + 1e-6 * before


@pytest.mark.parametrize(
    ("errors", "status", "failure", "text", "colour"),
    [
        ((0.01, -0.05), "ok", None, "−5.0", stability.RIGHT_OK),
        ((0.01, -0.05), "deep_overlap", None, "−5.0", stability.RIGHT_WARNED),
        ((0.01, -0.0501), "ok", None, "−5.0", stability.WRONG_SILENT),
        ((0.2, 0.0), "deep_overlap", None, "+20", stability.WRONG_WARNED),
        ((0.2, 0.0), None, None, "+20", stability.WRONG_SILENT),
        ((0.0, 0.02), "ok", "too_slow", "+2.0\n±1.2", stability.RIGHT_OK),
        ((0.0, 0.04), "ok", None, "+4.0\n±1.2", stability.UNDECIDED),
        ((0.0, 0.03), "ok", "too_slow", "+3.0\n±1.2", stability.UNDECIDED),
        ((0.0, -0.07), "ok", "too_slow", "−7.0\n±1.2", stability.UNDECIDED),
        ((0.0, -0.08), "ok", "too_slow", "−8.0\n±1.2", stability.WRONG_SILENT),
        ((0.0, 0.02), "ok", "iteration_limit", "u", stability.FAILED),
        (None, "ok", None, "r", stability.UNDECIDED),
        (None, "deep_overlap", None, "r", stability.WRONG_WARNED),
    ],
)
def test_what_is_wrong_without_a_status_is_silent(
    errors: tuple[float, float] | None, status: str | None, failure: str | None, text, colour
) -> None:
    overlaps = {"ok": 1e-6, "deep_overlap": 0.1, None: None}
    row = {"method": "default", "failure": failure, "mean_overlap": overlaps[status]}
    row |= {"grains": 256, "packing_fraction": 0.8}
    for name, error in zip(stability.STRESSES, errors or (), strict=False):
        row[name] = (error, 0.012 if "±" in text else 0.01)
    assert stability.cell_of(row, stability.STRESSES) == (text, colour)


def test_a_sample_ends_when_it_is_precise_wrong_beyond_doubt_or_its_time_is_up(monkeypatch) -> None:
    """Blocks of known scatter: the number of blocks follows from the precision asked for."""
    plan = stability.Plan((), 3, 8)
    case = stability.Case(0.5, 0.5)
    right = dict.fromkeys(stability.STRESSES, (1.0, 0.002))

    def blocks(seed: int, mean: float) -> Run:
        """Blocks that are independent, with a scatter of 0.15."""
        random = np.random.default_rng(seed)
        return Run(lambda: Stress(*(mean + 0.15 * random.normal(size=4))), Mock())

    def ends(mean: float) -> dict:
        return stability.measured(plan, case, [partial(blocks, s, mean) for s in range(3)], right)

    precise, wrong = ends(1.02), ends(1.6)
    assert precise["failure"] is wrong["failure"] is None
    for name in stability.STRESSES:
        error, noise = precise[name]
        assert noise <= stability.PRECISION
        assert abs(error - 0.02) < 4 * noise
    assert 150 <= precise["strain"] / case.block <= 600  # (0.15 / 0.01)² = 225 independent blocks
    assert wrong["strain"] == 24 * case.block
    assert wrong["pressure"][0] > 0.05 + 4 * wrong["pressure"][1]
    monkeypatch.setattr(stability, "SECONDS", 0.0)
    stopped = ends(1.02)
    assert stopped["failure"] == "too_slow" and stopped["strain"] == 0


def test_parts_of_the_first_block_make_it_up() -> None:
    case = stability.Case(0.5, 0.5, 16)
    state = stability.start(case, seed=0)
    for timestep in (1e-2, 7e-3, 1e-4):
        run = stability.ContactDynamics(case, state, timestep)
        assert sum(run.pieces()) == run.steps == round(case.block / timestep)
        assert run.pieces()[0] <= max(1, run.steps // 1000)
