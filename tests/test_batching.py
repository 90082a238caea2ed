"""A plain ``vmap`` is the best way by itself: each replica has the bits it has alone, however it is
transformed.
"""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import assert_same_bits, flow_of, replica, stacked
from jax import export, lax
from jax.sharding import Mesh, PartitionSpec
from synthetic import refused

import jaxgran as jg
from jaxgran import environment
from jaxgran.dynamics.advance import advance

ALPHAS, STEPS = jnp.asarray([0.3, 0.5, 0.9]), 20
ENGINES = {"jax": jg.Jax(), "numba": jg.Numba()}


@pytest.fixture(scope="module")
def states(flowing) -> jg.State:
    return stacked([flowing(0.7), flowing(0.7, 2), flowing(0.7, 1)])


compiled = partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": True})
"""Compiles a function as users have it: sums of loops by the older emitter depend on what else is
computed.
"""


def assert_same(one: tuple, other: tuple) -> None:
    """The same bits, but for the energy of waves: the last bit of a cosine of XLA depends on the
    batch.
    """
    np.testing.assert_allclose(one[1].wave_kinetic, other[1].wave_kinetic, rtol=1e-14)
    assert_same_bits(
        (one[0], replace(one[1], wave_kinetic=0)), (other[0], replace(other[1], wave_kinetic=0))
    )


def advanced(engine: jg.Jax | jg.Numba, alpha, state: jg.State) -> tuple:
    flow = replace(flow_of(0.7), restitution=alpha)
    return advance(flow, state, jnp.int32(STEPS), engine=engine)


@pytest.fixture(scope="module")
def alone():
    """``alone(name)(alpha, state)``: one replica by itself, by an engine; compiled once."""
    return cache(lambda name: compiled(partial(advanced, ENGINES[name])))


@pytest.mark.parametrize("name", ENGINES)
def test_replicas_of_a_vmap_have_the_bits_of_each_alone(name: str, states, alone) -> None:
    run = partial(advanced, ENGINES[name])
    together = compiled(jax.vmap(run))(ALPHAS, states)
    crossed = compiled(jax.vmap(jax.vmap(run, (0, None)), (None, 0)))(ALPHAS, states)
    mapped = compiled(lambda *batch: lax.map(lambda one: run(*one), batch))(ALPHAS, states)
    for k, alpha in enumerate(ALPHAS):
        for batch in (together, mapped, replica(crossed, k)):
            assert_same(replica(batch, k), alone(name)(alpha, replica(states, k)))


def test_replicas_of_a_vmap_advance_one_after_another(states) -> None:
    """With loops and conditions of their own, which an axis of replicas would turn into choices
    between branches.
    """
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
    ends = [alone("jax")(alpha, replica(states, k)) for k, alpha in enumerate(ALPHAS)]
    accelerator = SimpleNamespace(platform="accelerator")
    monkeypatch.setattr(environment, "default_device", lambda: accelerator)
    run = jax.vmap(
        lambda alpha, state: advance(
            replace(flow_of(0.7), restitution=alpha), state, jnp.int32(STEPS)
        )
    )
    together = compiled(run)(ALPHAS, states)
    for k, one in enumerate(ends):
        assert_same(replica(together, k), one)
    crossed = compiled(jax.vmap(run, (None, 0)))(ALPHAS, jax.tree.map(lambda x: x[None], states))
    assert_same_bits(replica(crossed, 0), together)
    exported = export.export(jax.jit(run), platforms=["cuda", "rocm", "tpu"])(ALPHAS, states)
    assert "custom_call" not in exported.mlir_module()


def speed(name: str, alpha, state) -> jax.Array:
    return jnp.sum(advanced(ENGINES[name], alpha, state)[0].velocities ** 2)


def slope(name: str, alpha, state) -> jax.Array:
    return jax.jvp(lambda x: speed(name, x, state), (alpha,), (jnp.ones_like(alpha),))[1]


@pytest.fixture(scope="module")
def slopes(states) -> tuple[np.ndarray, int]:
    """The derivative of each replica alone by the engine ``Jax``, and its number of conditions."""
    traced = compiled(partial(slope, "jax")).trace(ALPHAS[0], replica(states, 0))
    run = traced.lower().compile()
    values = [run(alpha, replica(states, k)) for k, alpha in enumerate(ALPHAS)]
    return np.array(values), str(traced.jaxpr).count(" cond[")


def test_forward_derivatives_are_those_of_finite_differences(states, alone, slopes) -> None:
    step = 1e-6
    high, low = (alone("jax")(ALPHAS[0] + x, replica(states, 0))[0] for x in (step, -step))
    numerical = np.sum(np.square(high.velocities) - np.square(low.velocities)) / (2 * step)
    np.testing.assert_allclose(slopes[0][0], numerical, rtol=1e-4)


@pytest.mark.parametrize(
    "order", [f"{name}, {order}" for name in ENGINES for order in ("vmap of jvp", "jacfwd of vmap")]
)
def test_forward_derivatives_follow_replicas_with_conditions_of_their_own(
    order: str, states, slopes
) -> None:
    """In every order, no condition becomes a choice of both branches."""
    name, order = order.split(", ")

    def columns(alphas, states):
        return jax.jacfwd(lambda x: jax.vmap(partial(speed, name))(x, states))(alphas)

    run = jax.vmap(partial(slope, name)) if order == "vmap of jvp" else columns
    traced = compiled(run).trace(ALPHAS, states)
    assert str(traced.jaxpr).count(" cond[") >= slopes[1] > 5
    values = traced.lower().compile()(ALPHAS, states)
    if run is columns:
        np.testing.assert_allclose(values, np.diag(slopes[0]), rtol=1e-12)
    else:
        np.testing.assert_array_equal(values, slopes[0])


def test_reverse_mode_without_a_number_of_events_is_refused(states) -> None:
    for each in ENGINES.values():
        with pytest.raises(ValueError, match="Reverse-mode"):
            jax.jit(jax.grad(lambda x, e=each: advanced(e, x, replica(states, 0))[1].impulse))(0.5)


def test_reverse_mode_of_a_batch_takes_the_number_of_events(states, slopes) -> None:
    engine = jg.Jax(events=STEPS + 1)

    def loss(alphas):
        return jnp.sum(jax.vmap(partial(advanced, engine))(alphas, states)[0].velocities ** 2)

    np.testing.assert_allclose(jax.jit(jax.grad(loss))(ALPHAS), slopes[0], rtol=1e-6)


@pytest.mark.parametrize("name", ENGINES)
def test_a_share_of_the_replicas_on_each_device_has_the_same_bits(name: str, states, alone) -> None:
    """Of one device here; ``test_batch`` emulates four. The axis may have any name."""
    run = jax.vmap(partial(advanced, ENGINES[name]))
    mesh, spec = Mesh(np.asarray(jax.devices()), ("replica",)), PartitionSpec("replica")
    sharded = jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    ends = compiled(sharded)(ALPHAS, states)
    for k, alpha in enumerate(ALPHAS):
        assert_same(replica(ends, k), alone(name)(alpha, replica(states, k)))


def test_a_scan_advances_replicas_in_turn(states, alone) -> None:
    def later(alpha, state):
        def step(state, _):
            return advanced(jg.Jax(), alpha, state)[0], None

        return lax.scan(step, state, length=2)[0]

    together = compiled(jax.vmap(later))(ALPHAS, states)
    between, _ = alone("jax")(ALPHAS[1], replica(states, 1))
    assert_same_bits(replica(together, 1), alone("jax")(ALPHAS[1], between)[0])


def test_a_sample_advances_replicas_in_turn(states) -> None:
    def pressure(alpha, state):
        flow = replace(flow_of(0.7), restitution=alpha)
        return jg.sample(flow, state, 0.1, blocks=2, engine=jg.Jax())[1].pressure

    together = compiled(jax.vmap(pressure))(ALPHAS, states)
    assert together[1] == compiled(pressure)(ALPHAS[1], replica(states, 1))


@pytest.mark.parametrize("name", ENGINES)
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


@pytest.mark.parametrize("name", ENGINES)
def test_a_condition_of_each_replica_takes_its_own_branch(name: str, states) -> None:
    def advanced_if(alpha, steps):
        flow = replace(flow_of(0.7), restitution=alpha)
        run = partial(advance, flow, replica(states, 0), engine=ENGINES[name])
        return lax.cond(steps > 1, lambda: run(steps), lambda: run(jnp.int32(0)))

    steps = jnp.asarray([1, 5, 9], jnp.int32)
    _, tally = jax.jit(jax.vmap(advanced_if))(ALPHAS, steps)
    np.testing.assert_array_equal(tally.steps, [0, 5, 9])


def test_second_derivatives_are_those_of_the_first_ones(states) -> None:
    def energy(alpha, engine):
        flow, state = replace(flow_of(0.7), restitution=alpha), replica(states, 0)
        solver = jg.BarzilaiBorwein(1e-12)
        end, _ = advance(flow, state, jnp.int32(STEPS), solver=solver, engine=engine)
        return jnp.sum(end.velocities**2)

    step, first = 1e-5, jax.jit(jax.grad(partial(energy, engine=jg.Jax(events=STEPS + 1))))
    numerical = (first(0.7 + step) - first(0.7 - step)) / (2 * step)
    forward = jax.jacfwd(jax.jacfwd(partial(energy, engine=None)))
    for curvature in (forward, jax.jacfwd(first)):
        np.testing.assert_allclose(jax.jit(curvature)(0.7), numerical, rtol=1e-6)


def test_states_that_share_a_flow_advance_with_conditions_of_their_own(states, alone) -> None:
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
    shared = compiled(jax.vmap(partial(end, replace(flow, restitution=ALPHAS[1]))))(states)
    assert_same(replica(shared, 1), alone("jax")(ALPHAS[1], replica(states, 1)))


@pytest.mark.parametrize("name", ENGINES)
def test_a_compiled_function_closes_over_flows_of_numpy(name: str, states, alone) -> None:
    flows = stacked([flow_of(0.7, restitution=alpha) for alpha in ALPHAS])
    flows, steps = jax.tree.map(np.asarray, flows), np.array([5, 9, STEPS])

    def ends(states):
        return jax.vmap(partial(advance, engine=ENGINES[name]))(flows, states, steps)

    end = replica(compiled(ends)(states), 2)
    assert_same(end, alone(name)(ALPHAS[2], replica(states, 2)))


def test_a_sample_is_differentiated_backwards_with_a_number_of_events(states) -> None:
    def pressure(alpha, engine):
        flow = replace(flow_of(0.7), restitution=alpha)
        return jg.sample(flow, replica(states, 0), 0.02, blocks=2, engine=engine)[1].pressure

    forward = jax.jit(jax.jacfwd(partial(pressure, engine=jg.Jax())))(0.5)
    backward = jax.jit(jax.grad(partial(pressure, engine=jg.Jax(events=21))))(0.5)
    np.testing.assert_allclose(backward, forward, rtol=1e-6)
    assert forward != 0
