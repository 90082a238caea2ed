"""An engine runs what it can, refuses in a sentence what it cannot, and is named in datasets."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS, assert_same_bits
from synthetic import refused
from test_batching import compiled

import jaxgran as jg
from jaxgran.contact.projected_methods import solver_name
from jaxgran.dynamics.engine import Numerics, _warn_once, select_engine
from jaxgran.environment import on_processor
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.settings_checks import require_engine

STEPS = jnp.int32(100)
SETTINGS = MapSettings((0.5, 0.9), (0.6,), grains=64, seeds=1, strain=2.0)


def of(**others) -> jg.ShearFlow:
    return jg.ShearFlow(GRAINS, 0.5, 0.7, 1e-3, **others)


def selected(state=None, **numerics) -> str:
    return select_engine(Numerics(**numerics), state).name


def single(state: jg.State) -> jg.State:
    return jax.tree.map(lambda x: x.astype(jnp.float32), state)


def refusal(call) -> str:
    with refused() as caught:
        call()
    return str(caught.value)


# What is selected


def test_auto_takes_the_machine_code_where_it_can_and_jax_elsewhere(flowing) -> None:
    state = flowing(0.7)
    assert selected() == selected(state) == "numba"
    assert selected(state, solver=jg.BarzilaiBorwein(1e-9, 7)) == "numba"
    assert selected(state, solver=jg.Nesterov()) == "jax"
    assert selected(single(state)) == "jax"


def test_a_state_of_several_precisions_is_one_sentence(flowing) -> None:
    mixed = replace(single(flowing(0.7)), side=flowing(0.7).side)
    for call in (lambda: jg.advance(of(), mixed, STEPS), lambda: jg.sample(of(), mixed, 0.1)):
        assert refusal(call).startswith(
            "state must be of one precision, and its numbers are float32 and float64: "
        )


def test_single_precision_that_was_not_asked_for_is_one_warning(flowing) -> None:
    _warn_once.cache_clear()
    state = single(flowing(0.7))
    assert selected(state) == "jax"  # in a session of double precision it was asked for
    with jax.enable_x64(False):
        assert selected(state, engine=jg.Jax()) == selected(state, solver=jg.Jacobi()) == "jax"
        with pytest.warns(match=r"^JAX computes in single precision.*jax_enable_x64"):
            assert selected(state) == "jax"
        assert selected(state) == "jax"


IMPOSSIBLE = {
    "another solver": (
        lambda state: jg.advance(of(), state, STEPS, engine=jg.Numba(), solver=jg.Jacobi()),
        "with the solver jacobi: take jg.Jax()",
    ),
    "single precision": (
        lambda state: jg.advance(of(), single(state), STEPS, engine=jg.Numba()),
        'in float32 (jax.config.update("jax_enable_x64", True) computes in float64): take jg.Jax()',
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_an_engine_that_cannot_do_what_is_asked_says_so(case: str, flowing) -> None:
    call, words = IMPOSSIBLE[case]
    sentence = refusal(lambda: call(flowing(0.7)))
    assert sentence.startswith(f"engine numba cannot run {words}")


# What runs


def test_a_number_of_steps_may_be_one_of_python(flowing) -> None:
    one, *others = (jg.advance(of(), flowing(0.7), n) for n in (100, np.int64(100), STEPS))
    for other in others:
        assert_same_bits(one, other)


def test_a_part_of_a_state_may_be_traced(flowing) -> None:
    flow, state = of(), flowing(0.7)

    def ends(velocities):
        return jg.advance(flow, replace(state, velocities=velocities), 20)[0].velocities

    whole = compiled(lambda state: jg.advance(flow, state, 20)[0].velocities)(state)
    assert_same_bits(compiled(ends)(state.velocities), whole)


@pytest.mark.parametrize("numerics", [{"engine": jg.Jax()}, {"solver": jg.Jacobi()}])
def test_jax_by_name_and_for_another_solver_is_the_plain_advance(numerics, flowing, run) -> None:
    solver = numerics.get("solver", jg.BarzilaiBorwein())
    chosen = jax.jit(partial(jg.advance, **numerics))(of(), flowing(0.7), STEPS)
    assert_same_bits(chosen, run(of(), flowing(0.7), STEPS, solver=solver))


@pytest.mark.parametrize(
    ("name", "value"), [("events", 0), ("free_flight", 1), ("moving_contacts", "no")]
)
def test_options_of_the_engine_jax_are_checked(name: str, value) -> None:
    with refused(f"{name} must be"):
        jg.Jax(**{name: value})


# What stands in a dataset


@pytest.mark.parametrize(
    ("asked", "engine", "solver"),
    [
        ({}, "numba", "gauss-seidel, barzilai-borwein where stiff"),
        ({"engine": jg.Numba()}, "numba", "gauss-seidel, barzilai-borwein where stiff"),
        ({"engine": jg.Jax()}, "jax", "barzilai-borwein"),
        ({"solver": jg.Nesterov(tolerance=1e-6)}, "jax", "nesterov"),
        ({"engine": jg.Jax(), "solver": jg.Jacobi(relaxation=1.5)}, "jax", "jacobi"),
    ],
)
def test_a_dataset_names_what_ran_and_what_was_asked_for(
    asked: dict, engine: str, solver: str
) -> None:
    settings = replace(SETTINGS, **asked)
    data = map_dataset(settings, {}, {})
    assert (data.attrs["engine"], data.attrs["solver"]) == (engine, solver)
    requested = (
        "auto" if settings.engine is None else settings.engine.name,
        solver_name(settings.solver),
    )
    assert (data.attrs["engine_requested"], data.attrs["solver_requested"]) == requested
    assert (data.attrs["tolerance"], data.attrs["max_steps"]) == (settings.solver.tolerance, 5000)
    assert MapSettings(**from_attrs(data)) == settings


def test_in_single_precision_a_map_is_of_the_engine_jax() -> None:
    with jax.enable_x64(False):
        data = map_dataset(SETTINGS, {}, {})
        assert "in float32 (jax.config.update" in refusal(
            lambda: require_engine(replace(SETTINGS, engine=jg.Numba()))
        )
    assert (data.attrs["precision"], data.attrs["engine"], data.attrs["solver"]) == (
        "float32",
        "jax",
        "barzilai-borwein",
    )


def test_the_default_device_chooses_the_engine_not_the_backend(flowing, monkeypatch) -> None:
    """As where a GPU is present and the user computes on the processor."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    flows, states = jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * 2), (of(), flowing(0.7)))
    with jax.default_device(jax.devices("cpu")[0]):
        assert on_processor()
        _, tally = jax.jit(partial(jg.advance, engine=jg.Numba()))(flows, states, STEPS)
    assert np.all(np.asarray(tally.steps) == int(STEPS))


def test_an_axis_of_the_user_is_not_taken_for_the_replicas_of_a_batch(flowing) -> None:
    batch = jax.tree.map(lambda x: x[None], flowing(0.7))
    run = partial(jg.advance, of(), steps=STEPS, engine=jg.Numba())
    _, tally = jax.jit(jax.vmap(run, axis_name="replica"))(batch)
    assert tally.steps == float(STEPS)


def test_an_advance_refuses_a_state_of_another_packing_fraction(flowing) -> None:
    assert refusal(
        lambda: jg.advance(replace(of(), packing_fraction=0.6), flowing(0.7), STEPS)
    ).startswith("packing_fraction must be 0.7, which the state has, not 0.6")


@pytest.mark.parametrize("call", [partial(jg.sample, strain=0.1), partial(jg.advance, steps=STEPS)])
def test_a_state_of_more_precision_than_that_of_jax_is_refused(flowing, call) -> None:
    with jax.enable_x64(False), pytest.raises(jg.InputError, match="float32, not float64"):
        call(of(), flowing(0.7))
