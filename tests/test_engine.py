"""An engine has a name: it runs what it can, refuses in a sentence what it cannot, and stands in what it has made."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import one_sentence

import jaxgran as jg
from jaxgran.dynamics import jax_engine
from jaxgran.dynamics.engine import _warn_once, select_engine, solver_in_use
from jaxgran.dynamics.tally import empty_tally
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.results import choices_of
from jaxgran.maps.settings import MapSettings
from jaxgran.model.control_flow import AXIS, in_batch
from jaxgran.sampling import batch
from jaxgran.sampling.batch import stack

STEPS = jnp.int32(100)
SETTINGS = MapSettings((0.5, 0.9), (0.6,), grains=64, seeds=1, strain=2.0)


def of(engine: str = "auto", **others) -> jg.ShearFlow:
    return jg.ShearFlow(pytest.GRAINS, 0.5, 0.7, 1e-3, engine=engine, **others)


def single(state: jg.State) -> jg.State:
    return jax.tree.map(lambda x: x.astype(jnp.float32), state)


def assert_same_bits(one, other) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def refusal(call) -> str:
    with pytest.raises(jg.InputError) as caught:
        call()
    assert one_sentence(str(caught.value))
    return str(caught.value)


# What is selected


def test_auto_takes_the_machine_code_where_it_can_and_jax_elsewhere(flowing) -> None:
    state = flowing(0.7)
    assert select_engine(of()) == select_engine(of(), state) == "numba"
    assert select_engine(of(solver="nesterov"), state) == "jax"
    assert select_engine(of(), single(state)) == "jax"
    assert select_engine(of(), state, "events") == "jax"
    found = []
    batch = jax.tree.map(lambda x: x[None], state)
    jax.vmap(lambda one: found.append(select_engine(of(), one)), axis_name=AXIS)(batch)
    jax.vmap(lambda one: found.append(select_engine(of(), one)))(batch)
    assert found == ["jax", "numba"]


def test_a_state_of_several_precisions_is_one_sentence(flowing) -> None:
    mixed = replace(single(flowing(0.7)), side=flowing(0.7).side)
    for call in (lambda: jg.advance(of(), mixed, STEPS), lambda: jg.sample(of(), mixed, 0.1)):
        assert refusal(call).startswith("state must be of one precision, and its numbers are float32 and float64: ")


def test_single_precision_that_was_not_asked_for_is_one_warning(flowing) -> None:
    _warn_once.cache_clear()
    state = single(flowing(0.7))
    assert select_engine(of(), state) == "jax"  # in a session of double precision it was asked for
    with jax.enable_x64(False):
        assert select_engine(of("jax"), state) == select_engine(of(solver="jacobi"), state) == "jax"
        with pytest.warns(match=r"^JAX computes in single precision.*jax_enable_x64"):
            assert select_engine(of(), state) == "jax"
        assert select_engine(of(), state) == "jax"


def test_jax_takes_whatever_it_is_asked_for(flowing) -> None:
    for state in (flowing(0.7), single(flowing(0.7))):
        for solver in ("barzilai-borwein", "jacobi"):
            assert select_engine(of("jax", solver=solver), state, "events") == "jax"


IMPOSSIBLE = {
    "thread block on a processor": (
        lambda state: jg.advance(of("pallas"), state, STEPS),
        "on a CPU, not pallas: it is made for NVIDIA GPUs",
    ),
    "another solver": (
        lambda state: jg.advance(of("numba", solver="jacobi"), state, STEPS),
        "with the solver jacobi, not numba",
    ),
    "single precision": (
        lambda state: jg.advance(of("numba"), single(state), STEPS),
        "in float32, not numba: it computes in float64",
    ),
    "a named axis": (
        lambda state: jax.vmap(lambda one: jg.advance(of("numba"), one, STEPS), axis_name=AXIS)(
            jax.tree.map(lambda x: x[None], state)
        ),
        "in a vmap with the axis name 'replica', not numba",
    ),
    "every step": (
        lambda state: jg.advance(of("numba"), state, STEPS, free_flight=False),
        "with free_flight=False, not numba",
    ),
    "moving contacts": (
        lambda state: jg.advance(of("numba"), state, STEPS, moving_contacts=True),
        "with moving_contacts, not numba",
    ),
    "derivatives in reverse mode": (
        lambda state: jax.grad(
            lambda alpha: jnp.sum(
                jg.advance(replace(of("numba"), restitution=alpha), state, STEPS, events=50)[0].velocities ** 2
            )
        )(0.5),
        "with events, not numba: only the engine jax does that",
    ),
    "an observable": (
        lambda state: jg.sample(of("numba", solver="jacobi"), state, 0.1, observe=lambda seen: seen.state.side),
        "with the solver jacobi, not numba",
    ),
    "an observable, block by block": (
        lambda state: jg.sample(
            of("pallas"), state, 0.1, observe=lambda seen: seen.state.side, callback=lambda *_: False
        ),
        "on a CPU, not pallas",
    ),
    "a sample": (lambda state: jg.sample(of("pallas"), state, 0.1), "on a CPU, not pallas"),
    "a preparation": (lambda _: jg.prepare(of("pallas"), jax.random.key(0)), "on a CPU, not pallas"),
    "snapshots": (lambda state: jg.snapshot_series(of("pallas"), state, 0.1, 2), "on a CPU, not pallas"),
    "free cooling": (
        lambda state: jg.cooling(of("pallas", shear_rate=0.0), state, [0.1]),
        "on a CPU, not pallas",
    ),
    "a map": (
        lambda _: jg.ratio_map([0.5], [0.6], engine="numba", solver="nesterov"),
        "with the solver nesterov, not numba",
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_an_engine_that_cannot_do_what_is_asked_says_so(case: str, flowing) -> None:
    call, words = IMPOSSIBLE[case]
    sentence = refusal(lambda: call(flowing(0.7)))
    assert sentence.startswith(f"engine must be auto or jax {words}")


# What runs


def test_the_machine_code_by_name_is_auto_to_the_bit(flowing) -> None:
    state, advance = flowing(0.7), jax.jit(jg.advance)
    assert_same_bits(advance(of("numba"), state, STEPS), advance(of(), state, STEPS))


def test_jax_by_name_is_the_plain_advance(flowing, monkeypatch) -> None:
    monkeypatch.setattr(jax_engine, "advance", lambda *arguments: arguments)
    for flow in (of("jax"), of(solver="jacobi"), of("jax", solver="jacobi")):
        assert jg.advance(flow, flowing(0.7), STEPS) == (flow, flowing(0.7), STEPS, True, None, False)


def test_jax_by_name_advances_a_batch_in_lockstep_on_a_processor_too(flowing) -> None:
    states = jax.tree.map(lambda x: jnp.stack([x, x]), flowing(0.7))
    found = {}

    def notes(flow, state, steps):
        found[flow.engine] = in_batch()
        return state, empty_tally(state.side.dtype)

    for engine in ("auto", "numba", "jax"):
        batch.batch_program(notes)(stack([of(engine)] * 2), states, jnp.ones(2, jnp.int32))
    assert found == {"auto": False, "numba": False, "jax": True}


# What stands in a dataset


@pytest.mark.parametrize(
    ("asked", "engine", "solver"),
    [
        ({}, "numba", "gauss-seidel, barzilai-borwein where stiff"),
        ({"engine": "numba"}, "numba", "gauss-seidel, barzilai-borwein where stiff"),
        ({"engine": "jax"}, "jax", "barzilai-borwein"),
        ({"solver": "nesterov"}, "jax", "nesterov"),
        ({"engine": "jax", "solver": "jacobi"}, "jax", "jacobi"),
    ],
)
def test_a_dataset_names_what_ran_and_what_was_asked_for(asked: dict, engine: str, solver: str) -> None:
    settings = replace(SETTINGS, **asked)
    data = map_dataset(settings, {}, {})
    assert (data.attrs["engine"], data.attrs["solver"]) == (engine, solver)
    assert (data.attrs["engine_requested"], data.attrs["solver_requested"]) == (settings.engine, settings.solver)
    assert MapSettings(**choices_of(data)) == settings


def test_in_single_precision_a_map_is_of_the_engine_jax() -> None:
    with jax.enable_x64(False):
        data = map_dataset(SETTINGS, {}, {})
        assert "in float32, not numba" in refusal(lambda: replace(SETTINGS, engine="numba"))
    assert (data.attrs["precision"], data.attrs["engine"], data.attrs["solver"]) == (
        "float32",
        "jax",
        "barzilai-borwein",
    )


def test_the_thread_block_solves_by_its_own_method() -> None:
    assert solver_in_use("pallas", "barzilai-borwein") == "barzilai-borwein"


@pytest.mark.slow
def test_a_map_by_jax_and_jacobi_agrees_with_the_machine_code_within_errors() -> None:
    choices = {"grains": 64, "seeds": 1, "equilibrate": 1.0, "strain": 2.0}
    way = {"engine": "jax", "solver": "jacobi", "batch": 2}
    original, usual = jg.ratio_map([0.5, 0.9], [0.6], **choices, **way), jg.ratio_map([0.5, 0.9], [0.6], **choices)
    error = np.hypot(original.pressure_stderr, usual.pressure_stderr)
    assert np.all(abs(original.pressure - usual.pressure) < 5 * error)
    assert (original.attrs["engine"], original.attrs["solver"]) == ("jax", "jacobi")
