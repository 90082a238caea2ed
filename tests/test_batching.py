"""Each replica of a plain ``vmap`` has the bits it has alone, however it is transformed."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, assert_same_bits, flow_of, replica, stacked
from jax import export, lax
from jax.sharding import Mesh, PartitionSpec
from synthetic import refused

import jaxgran as jg
from jaxgran import environment
from jaxgran.dynamics import jax_engine
from jaxgran.dynamics.advance import advance

ALPHAS, STEPS = jnp.asarray([0.3, 0.5, 0.9]), 20
ENGINES = {"jax": jg.Jax(), "numba": jg.Numba()}
by_engine = pytest.mark.parametrize("name", ENGINES)


@pytest.fixture(scope="module")
def states(flowing) -> jg.State:
    return stacked([flowing(0.7), flowing(0.7, 2), flowing(0.7, 1)])


compiled = partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": True})
"""Compiles a function as users have it: sums of loops by the older emitter depend on what else is
computed.
"""


def assert_same(one: tuple, other: tuple) -> None:
    """The same bits, but for the waves: the last bit of XLA's cosine depends on the batch."""
    np.testing.assert_allclose(one[1].wave_kinetic, other[1].wave_kinetic, rtol=1e-14)
    assert_same_bits(one[0], other[0])
    assert_same_bits(replace(one[1], wave_kinetic=0), replace(other[1], wave_kinetic=0))


def advanced(engine: jg.Jax | jg.Numba | None, alpha, state: jg.State) -> tuple:
    flow = replace(flow_of(0.7), restitution=alpha)
    return advance(flow, state, jnp.int32(STEPS), solver=EXACT, engine=engine)


@pytest.fixture(scope="module")
def alone():
    """``alone(name)(alpha, state)``: one replica by itself, by an engine; compiled once."""
    return cache(lambda name: compiled(partial(advanced, ENGINES[name])))


@by_engine
def test_replicas_of_a_vmap_have_the_bits_of_each_alone(name: str, states, alone) -> None:
    """In a ``lax.map`` over one ``vmap`` over states of another over flows."""
    crossed = jax.vmap(jax.vmap(partial(advanced, ENGINES[name]), (0, None)), (None, 0))
    twice = stacked([states, states])
    ends = compiled(lambda batches: lax.map(partial(crossed, ALPHAS), batches))(twice)
    for k, alpha in enumerate(ALPHAS):
        for one in map(partial(replica, ends), range(2)):
            assert_same(replica(replica(one, k), k), alone(name)(alpha, replica(states, k)))


def test_replicas_of_a_vmap_advance_one_after_another(states) -> None:
    """With loops and conditions of their own, which are no choices between branches."""
    batched = jax.make_jaxpr(
        jax.vmap(lambda state: advance(flow_of(0.7), state, jnp.int32(STEPS), engine=jg.Jax()))
    )
    names = [equation.primitive.name for equation in batched(states).eqns]
    (call,) = (e for e in batched(states).eqns if e.primitive.name == "custom_jvp_call")
    inside = [equation.primitive.name for equation in call.params["call_jaxpr"].eqns]
    assert inside.count("scan") == 1
    assert not {"while", "select_n", "cond"} & {*names, *inside}


def test_lockstep_has_the_bits_of_each_replica_alone_and_lowers_for_every_accelerator(
    states, alone, monkeypatch
) -> None:
    """Beside replicas that are not finite, too."""
    ends = [alone("jax")(alpha, replica(states, k)) for k, alpha in enumerate(ALPHAS)]
    accelerator = SimpleNamespace(platform="accelerator")
    monkeypatch.setattr(environment, "default_device", lambda: accelerator)
    run = jax.vmap(partial(advanced, None))
    spoilt = [
        replace(states, **{name: getattr(states, name).at[1, 5, 0].set(jnp.nan)})
        for name in ("positions", "velocities")
    ]
    crossed = compiled(jax.vmap(run, (None, 0)))(ALPHAS, stacked([states, *spoilt]))
    ok, bad = jg.Status.ok, jg.Status.nonfinite
    np.testing.assert_array_equal(crossed[1].status, [[ok, ok, ok], [ok, bad, ok], [ok, bad, ok]])
    for row, k in np.argwhere(crossed[1].status == ok):
        assert_same(replica(replica(crossed, row), k), ends[k])
    exported = export.export(jax.jit(run), platforms=["cuda", "rocm", "tpu"])(ALPHAS, states)
    assert "custom_call" not in exported.mlir_module()


def speed(name: str, alpha, state) -> jax.Array:
    return jnp.sum(advanced(ENGINES[name], alpha, state)[0].velocities ** 2)


def slope(name: str, alpha, state) -> jax.Array:
    return jax.jvp(lambda x: speed(name, x, state), (alpha,), (jnp.ones_like(alpha),))[1]


@pytest.fixture(scope="module")
def slope_alone(states):
    """The derivative of one replica by the engine ``Jax``, traced."""
    return jax.jit(partial(slope, "jax")).trace(ALPHAS[0], replica(states, 0))


@pytest.fixture(scope="module")
def slope_of(slope_alone):
    """``slope_of(alpha, state)``: the same, compiled."""
    return slope_alone.lower().compile()


@pytest.fixture(scope="module")
def slopes(states, slope_of) -> np.ndarray:
    return np.array([slope_of(alpha, replica(states, k)) for k, alpha in enumerate(ALPHAS)])


def test_forward_derivatives_are_those_of_finite_differences(states, alone, slopes) -> None:
    step = 1e-6
    high, low = (alone("jax")(ALPHAS[0] + x, replica(states, 0))[0] for x in (step, -step))
    numerical = np.sum(np.square(high.velocities) - np.square(low.velocities)) / (2 * step)
    np.testing.assert_allclose(slopes[0], numerical, rtol=1e-6)


@pytest.mark.parametrize(("name", "order"), [("numba", "vmap of jvp"), ("jax", "jacfwd of vmap")])
def test_forward_derivatives_follow_replicas_with_conditions_of_their_own(
    name: str, order: str, states, slope_alone, slopes
) -> None:
    """In either order, no condition becomes a choice of both branches."""

    def columns(alphas, states):
        return jax.jacfwd(lambda x: jax.vmap(partial(speed, name))(x, states))(alphas)

    run = jax.vmap(partial(slope, name)) if order == "vmap of jvp" else columns
    traced = jax.jit(run).trace(ALPHAS, states)
    assert str(traced.jaxpr).count(" cond[") >= str(slope_alone.jaxpr).count(" cond[") > 5
    values = traced.lower().compile()(ALPHAS, states)
    expected = np.diag(slopes) if run is columns else slopes
    np.testing.assert_allclose(values, expected, rtol=1e-12)


@pytest.fixture
def one_size_of_a_solve(monkeypatch) -> None:
    """Contacts are solved on the list of near pairs, so that there is less to trace."""
    monkeypatch.setattr(jax_engine, "contact_buffers", lambda _: ())


@by_engine
def test_reverse_mode_without_a_number_of_events_is_refused(
    name: str, states, one_size_of_a_solve
) -> None:
    with pytest.raises(ValueError, match="Reverse-mode"):
        jax.eval_shape(jax.grad(partial(speed, name)), 0.5, replica(states, 0))


def test_reverse_mode_of_a_batch_takes_the_number_of_events(states, slopes) -> None:
    engine = jg.Jax(events=STEPS + 1)

    def loss(alphas):
        return jnp.sum(jax.vmap(partial(advanced, engine))(alphas, states)[0].velocities ** 2)

    np.testing.assert_allclose(jax.jit(jax.grad(loss))(ALPHAS), slopes, rtol=1e-9)


@by_engine
def test_a_share_of_the_replicas_on_each_device_has_the_same_bits(name: str, states, alone) -> None:
    """Of one device here; ``test_batch`` emulates four. The axis may have any name."""
    run = jax.vmap(partial(advanced, ENGINES[name]))
    mesh, spec = Mesh(np.asarray(jax.devices()), ("replica",)), PartitionSpec("replica")
    sharded = jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    ends = compiled(sharded)(ALPHAS, states)
    for k, alpha in enumerate(ALPHAS):
        assert_same(replica(ends, k), alone(name)(alpha, replica(states, k)))


def test_a_sample_advances_replicas_in_turn(states, alone) -> None:
    """Its second block has the bits of an advance from the end of the first."""

    def sampled(alpha, state):
        flow = replace(flow_of(0.7), restitution=alpha)
        return jg.sample(flow, state, 2e-3 * STEPS, blocks=2, solver=EXACT, engine=jg.Jax())

    ends, sample = compiled(jax.vmap(sampled))(ALPHAS, states)
    np.testing.assert_array_equal(sample.tally.steps, STEPS)
    between, _ = alone("jax")(ALPHAS[1], replica(states, 1))
    end, tally = alone("jax")(ALPHAS[1], between)
    second = replace(replica(replica(sample.tally, 1), 1), status=tally.status)  # it is short
    assert_same((replica(ends, 1), second), (end, tally))


@by_engine
def test_a_packing_fraction_is_that_of_the_state_alone(name: str, flowing) -> None:
    """Another one ends its replica of ``vmap``; a derivative, which would be zero, is refused."""

    def end(nu: jax.Array) -> tuple[jax.Array, jax.Array]:
        flow = replace(flow_of(0.7), packing_fraction=nu)
        after, tally = advance(flow, flowing(0.7), jnp.int32(STEPS), engine=ENGINES[name])
        return jnp.sum(after.velocities**2), tally.status

    energy, status = jax.jit(jax.vmap(end))(jnp.array([0.69, 0.7]))
    assert status.tolist() == [jg.Status.nonfinite, jg.Status.ok] and np.isfinite(energy[1])
    with refused("packing_fraction must not be differentiated"):
        jax.jit(jax.jacfwd(lambda nu: end(nu)[0]))(0.7)


@by_engine
def test_a_condition_of_each_replica_takes_its_own_branch(name: str, states) -> None:
    def flown_if(alpha, steps):
        flow = replace(flow_of(0.7), restitution=alpha)
        run = partial(advance, flow, replica(states, 0), engine=ENGINES[name])
        return lax.cond(steps > 1, lambda: run(steps)[1].steps, lambda: -1.0)

    steps = jnp.asarray([1, 5, 9], jnp.int32)
    np.testing.assert_array_equal(jax.jit(jax.vmap(flown_if))(ALPHAS, steps), [-1, 5, 9])


def test_second_derivatives_are_those_of_the_first_ones(
    states, slope_of, one_size_of_a_solve
) -> None:
    def energy(alpha, engine):
        end, _ = advanced(engine, alpha, replica(states, 0))
        return jnp.sum(end.velocities**2)

    step = 1e-5
    high, low = (slope_of(jnp.asarray(0.7 + x), replica(states, 0)) for x in (step, -step))
    forward = jax.jacfwd(jax.jacfwd(partial(energy, engine=None)))
    backward = jax.jacfwd(jax.grad(partial(energy, engine=jg.Jax(events=STEPS + 1))))
    for curvature in (forward, backward):
        np.testing.assert_allclose(jax.jit(curvature)(0.7), (high - low) / (2 * step), rtol=1e-6)


def test_states_that_share_a_flow_advance_with_conditions_of_their_own(states) -> None:
    """As flows of their own do, whatever is batched: states, flows or both."""

    def end(flow, state):
        return advance(flow, state, jnp.int32(STEPS), engine=jg.Jax())

    def conditions(axes, *arguments) -> tuple[int, int]:
        text = str(jax.make_jaxpr(jax.vmap(end, axes))(*arguments))
        return text.count(" cond["), text.count("select_n")

    flow, flows = flow_of(0.7), stacked([flow_of(0.7)] * 3)
    of_both = conditions((0, 0), flows, states)
    assert conditions((None, 0), flow, states) == of_both
    assert conditions((0, None), flows, replica(states, 0)) == of_both


@by_engine
def test_a_compiled_function_closes_over_flows_of_numpy(name: str, states, alone) -> None:
    flows = stacked([flow_of(0.7, restitution=alpha) for alpha in ALPHAS])
    flows, steps = jax.tree.map(np.asarray, flows), np.array([5, STEPS, STEPS])

    def ended(states):
        run = partial(advance, solver=EXACT, engine=ENGINES[name])
        return jax.vmap(run)(flows, states, steps)

    ends = compiled(ended)(states)
    for k in (1, 2):
        assert_same(replica(ends, k), alone(name)(ALPHAS[k], replica(states, k)))


def test_a_sample_is_differentiated_backwards_with_a_number_of_events(states) -> None:
    def pressure(alpha, engine):
        flow = replace(flow_of(0.7), restitution=alpha)
        return jg.sample(flow, replica(states, 0), 0.02, blocks=2, engine=engine)[1].pressure

    forward = jax.jit(jax.jacfwd(partial(pressure, engine=jg.Jax())))(0.5)
    backward = jax.jit(jax.grad(partial(pressure, engine=jg.Jax(events=21))))(0.5)
    np.testing.assert_allclose(backward, forward, rtol=1e-6)
    assert forward != 0
