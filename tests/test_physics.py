"""Laws that cross modules: rebound, energy, momentum, power, Bagnold's scaling."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS, flow_of
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import gaps_of, kinetic_energy

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.tally import TABLE
from jaxgran.model.cell import displacement, relative_velocity, wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains, own_grains
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.averages import averages
from jaxgran.sampling.heated import heated
from jaxgran.sampling.steady_state import prepare

EPS = np.finfo(float).eps
COLLISIONS, BLOCKS = 100, 50
# Share of the power that one iteration wastes at least; one of the numba engine is a sweep over all
# contacts
WASTED = {"numba": 5e-4, "jax": 1e-2}


def pair_velocity(state: State) -> np.ndarray:
    """Velocity of grain 0 seen from grain 1 in the laboratory, shear rate one."""
    r, c = np.asarray(state.positions), np.asarray(state.velocities)
    return c[0] - c[1] + (r[0] - r[1])[1] * np.array([1, 0])


def momentum(state: State) -> np.ndarray:
    return np.sum(np.asarray(state.grains.masses)[:, None] * np.asarray(state.velocities), axis=0)


def energy(state: State) -> float:
    return kinetic_energy(state.grains.masses, state.velocities)


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_two_discs_rebound_with_the_coefficient_of_restitution(engine_run, scene, restitution):
    """At random phases, speeds, angles, sizes and offsets; the normal is that of the change."""
    rng = np.random.default_rng(int(10 * restitution))
    for _ in range(COLLISIONS):
        radii = rng.uniform(0.37, 0.63, 2)
        angle = rng.uniform(0, 2 * np.pi)
        offset = rng.uniform(-0.8, 0.8)
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-np.sin(angle), np.cos(angle)])
        speed, timestep = rng.uniform(1, 10), 10 ** rng.uniform(-5, -3)
        reach = np.sum(radii)
        travel = rng.uniform(1, 3) * speed * timestep
        apart = along * (np.sqrt(1 - offset**2) * reach + travel) + across * offset * reach
        places, drift = 8 + np.array([apart, [0, 0]]), rng.normal(size=2)
        share = rng.uniform(0, 1)
        meeting = [drift - share * speed * along, drift + (1 - share) * speed * along]
        before = scene(places, meeting, radii)
        flow = flow_of(0.02, restitution=restitution, timestep=timestep)
        after, tally = engine_run(flow, before, 8)
        assert tally.collisions > 0
        kick = pair_velocity(after) - pair_velocity(before)
        normal = kick / np.linalg.norm(kick)
        assert normal @ (places[0] - places[1]) > 0.5 * reach
        rebound = -(normal @ pair_velocity(after)) / (normal @ pair_velocity(before))
        assert rebound == pytest.approx(restitution, rel=0, abs=1e-10)
        masses = np.asarray(before.grains.masses)[:2]
        reduced, speed = np.prod(masses) / np.sum(masses), normal @ pair_velocity(before)
        lost = pytest.approx((1 - restitution**2) / 2 * reduced * speed**2, rel=1e-9, abs=1e-9)
        assert float(tally.dissipation) == lost and float(tally.binary_dissipation) == lost
        assert tally.status == Status.ok


@pytest.mark.parametrize("activation", ["midpoint", "touching"])
def test_three_touching_balls_in_a_row_share_the_momentum_at_once(engine_run, scene, activation):
    """The known answer of a simultaneous law, not that of Newton's cradle."""
    before = scene([[3, 4], [4, 4], [5, 4]], [[1, 0], [0, 0], [0, 0]])
    after, tally = engine_run(flow_of(0.02, restitution=1.0, activation=activation), before, 1)
    laboratory = np.asarray(after.velocities)[:3] + np.array([[4, 0]])
    np.testing.assert_allclose(
        laboratory, [[-1 / 3, 0], [2 / 3, 0], [2 / 3, 0]], rtol=0, atol=1e-11
    )
    assert tally.contacts == 2


# Dense, inelastic networks at a coarse step, and single collisions
POINTS = [(0.75, 1e-2), (0.6, 1e-3)]


@pytest.mark.parametrize(("packing_fraction", "timestep"), POINTS)
@pytest.mark.parametrize("restitution", [0.0, 0.9, 1.0])
def test_no_step_gains_energy_and_elastic_steps_keep_it(
    engine_run, flowing, packing_fraction, timestep, restitution
):
    """In the frame of the contacts: the fall of energy and the work of the shear on impulses."""
    state = flowing(packing_fraction)
    flow = flow_of(packing_fraction, restitution=restitution, timestep=timestep)
    lost, exchanged = [], []
    for _ in range(60):
        after, tally = engine_run(flow, state, 1)
        turned = np.asarray(after.velocities) + timestep * np.asarray(after.velocities)[:, 1:] * [
            1,
            0,
        ]  # before the flight
        fall = energy(state) - kinetic_energy(state.grains.masses, turned)
        loss = fall - float(tally.contact_moment[1, 0])
        scale = energy(state) + float(tally.impulse)
        assert loss == pytest.approx(float(tally.dissipation), rel=0, abs=1e-13 * scale)
        lost.append(loss / scale)
        exchanged.append(np.sum(np.abs(turned - np.asarray(state.velocities))))
        state = after
    assert np.sum(np.array(exchanged) > 1e-3) > 5
    assert np.min(lost) >= -1e-13 if restitution < 1 else np.max(np.abs(lost)) <= 1e-8
    assert np.max(lost) > 1e-5 or restitution == 1


@pytest.mark.parametrize("packing_fraction", [0.6, 0.75])
def test_impulses_are_proportional_to_one_plus_restitution(engine_run, flowing, packing_fraction):
    state = flowing(packing_fraction)
    flow, changes = flow_of(packing_fraction, timestep=1e-2), []
    for restitution in (0.0, 0.3, 1.0):
        after, tally = engine_run(replace(flow, restitution=restitution), state, 1)
        turned = np.asarray(after.velocities) + flow.timestep * np.asarray(after.velocities)[
            :, 1:
        ] * [1, 0]
        changes.append((turned - np.asarray(state.velocities)) / (1 + restitution))
        sums = [tally.impulse, tally.binary_impulse, *np.ravel(tally.contact_moment)]
        changes[-1] = np.append(changes[-1], np.array(sums) / (1 + restitution))
    assert np.max(np.abs(changes[0])) > 0.1
    np.testing.assert_allclose(
        changes[1:], [changes[0]] * 2, rtol=0, atol=64 * EPS * np.max(np.abs(changes[0]))
    )


@pytest.mark.parametrize("drift", [(0.0, 0.0), (0.3, 0.7)])
def test_momentum_is_conserved(engine_run, flowing, drift):
    """m c_y stays, m c_x falls by γ̇ m c_y t: a drift across changes nothing in the laboratory."""
    state = flowing(0.75)
    state = replace(state, velocities=state.velocities + jnp.asarray([drift]))
    flow, steps = flow_of(0.75), 400
    after, tally = engine_run(flow, state, steps, BarzilaiBorwein())
    before, time = momentum(state), steps * flow.timestep
    assert tally.solves > 50
    rounding = EPS * float(tally.impulse) * np.sqrt(tally.contacts)
    np.testing.assert_allclose(
        momentum(after), before - [time * before[1], 0], rtol=0, atol=rounding
    )


@pytest.mark.parametrize("activation", ["midpoint", "touching"])
@pytest.mark.parametrize(("packing_fraction", "timestep"), POINTS)
def test_shear_power_is_dissipation_and_change_of_energy(
    engine_run, flowing, packing_fraction, timestep, activation
):
    state = flowing(packing_fraction)
    flow = flow_of(packing_fraction, timestep=timestep, restitution=0.3, activation=activation)
    after, tally = engine_run(flow, state, 300, BarzilaiBorwein())
    power = -(tally.contact_moment + tally.kinetic_moment)[0, 1]  # ∫ τ γ̇ A dt with γ̇ = 1
    assert tally.solves > 20 and tally.dissipation > 0
    change = energy(after) - energy(state)
    assert tally.dissipation + change == pytest.approx(
        float(power), rel=0, abs=1e-11 * float(tally.dissipation)
    )


@pytest.mark.parametrize(("packing_fraction", "restitution"), [(0.3, 0.9), (0.7, 0.0), (0.8, 0.4)])
def test_flow_without_shear_keeps_its_momentum_and_loses_what_it_dissipates(
    engine_run, packed, packing_fraction, restitution
):
    velocities = np.random.default_rng(0).normal(size=(GRAINS, 2))
    state = replace(packed(packing_fraction), velocities=jnp.asarray(velocities))
    after, tally = engine_run(
        flow_of(packing_fraction, restitution=restitution, shear_rate=0.0), state, 300
    )
    np.testing.assert_allclose(momentum(after), momentum(state), rtol=0, atol=1e-10)
    assert float(tally.energy_change) <= 1e-12 * energy(state)
    np.testing.assert_allclose(tally.energy_change, -tally.dissipation, atol=1e-8 * energy(state))


def test_energy_balance_tests_the_books_and_the_complementarity_power_the_solver(
    engine, engine_run, flowing
):
    """The balance closes however badly a network is solved; what impulses waste falls."""
    flow, state = flow_of(0.75, restitution=0.1), flowing(0.75)
    wasted = []
    for tolerance, cap in ((1e-12, 1), (1e-2, 5000), (1e-4, 5000), (1e-8, 5000)):
        _, tally = engine_run(flow, state, 300, BarzilaiBorwein(tolerance, cap))
        measured = averages(jax.tree.map(np.asarray, tally), float(state.side) ** 2, GRAINS, 1.0)
        assert abs(measured["energy_balance_error"]) < 1e-11
        assert measured["momentum_drift"] < 1e-13
        wasted.append(abs(float(measured["complementarity_power"])))
    assert wasted[0] > WASTED[engine]
    assert np.all(np.array(wasted[1:]) < [1e-2, 1e-4, 1e-8])


@pytest.mark.parametrize("packing_fraction", [0.2, 0.75])
def test_no_contact_is_missed_over_large_shear(engine_run, flowing, packing_fraction):
    """Overlaps by brute force are at most those of contacts and a step of the fastest pair."""
    state, flow, tilts = flowing(packing_fraction), flow_of(packing_fraction, restitution=0.7), []
    for _ in range(BLOCKS):
        state, tally = engine_run(flow, state, 60, BarzilaiBorwein())
        assert tally.status == Status.ok
        fastest = 2 * np.max(np.linalg.norm(state.velocities, axis=1)) + 1.3
        deepest = -np.min(gaps_of(state.positions, state.grains.radii, state.side, state.tilt))
        assert deepest <= tally.largest_overlap + fastest * flow.timestep
        tilts.append(float(state.tilt))
    assert np.sum(np.diff(tilts) < 0) == round(0.06 * BLOCKS) > 0


def test_moments_are_symmetric_and_the_stresses_compress(engine_run, flowing):
    _, tally = engine_run(flow_of(0.75), flowing(0.75), 300)
    for moment in (tally.contact_moment, tally.binary_moment, tally.kinetic_moment):
        np.testing.assert_allclose(moment[0, 1], moment[1, 0], rtol=1e-12)
        assert np.all(np.linalg.eigvalsh(moment) > 0)


@pytest.mark.parametrize(
    "packing_fraction", [0.2, 0.75, 0.8]
)  # at 0.82 one in four cells of 64 grains jams
def test_twice_the_shear_rate_and_half_the_step_repeat_the_trajectory_to_the_bit(
    engine_run, flowing, packing_fraction
):
    """Bagnold: rigid grains have no time scale but the shear's, so stresses go with its square."""
    steps = 500
    state = flowing(packing_fraction)
    flow = flow_of(packing_fraction)
    solver = BarzilaiBorwein(max_steps=100_000)
    faster = replace(flow, shear_rate=2.0, timestep=flow.timestep / 2)
    slow, slow_tally = engine_run(flow, state, steps, solver)
    fast, fast_tally = engine_run(
        faster, replace(state, velocities=2 * state.velocities), steps, solver
    )
    assert slow_tally.solves > (5 if packing_fraction == 0.2 else 50)
    np.testing.assert_array_equal(fast.positions, slow.positions)
    np.testing.assert_array_equal(fast.tilt, slow.tilt)
    np.testing.assert_array_equal(fast.velocities, 2 * slow.velocities)
    for name, row in TABLE.items():
        numerator, _, denominator = row["unit"].partition("/")
        power = numerator.count("γ̇") * (2 if "γ̇²" in numerator else 1) - denominator.count("γ̇")
        expected = 2.0**power * np.asarray(getattr(slow_tally, name))
        np.testing.assert_array_equal(getattr(fast_tally, name), expected, err_msg=name)


@settings(max_examples=20, deadline=None)
@given(mass=st.integers(-40, 40), length=st.integers(-8, 8), time=st.integers(-20, 20))
def test_units_are_free(engines, flowing, mass, length, time) -> None:
    """Masses, lengths and times in other units, powers of two, repeat the trajectory to the bit,
    but for lengths: the floor of a residual is in γ̇σ.
    """
    m, d, t = 4.0**mass, 2.0**length, 2.0**time
    state, steps = flowing(0.7), 200
    units = State(
        Grains(d * state.grains.radii, m * state.grains.masses),
        d * state.positions,
        d / t * state.velocities,
        d * state.side,
        state.tilt,
    )
    flow = flow_of(0.7, restitution=0.3)
    one, sums = engines["numba"](flow, state, steps)
    other, scaled = engines["numba"](
        replace(flow, shear_rate=1 / t, timestep=1e-3 * t), units, steps
    )
    rtol = 0 if length == 0 else 1e-7
    np.testing.assert_allclose(other.velocities * (t / d), one.velocities, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(
        scaled.contact_moment * (t / (m * d**2)), sums.contact_moment, rtol=rtol
    )
    assert scaled.status == sums.status and sums.collisions > 10


def test_a_flow_of_light_grains_is_prepared_as_any_other() -> None:
    """The predicted temperature, which begins it, is proportional to the masses."""
    flow, diameters = flow_of(0.8, restitution=0.7), np.linspace(0.74, 1.26, GRAINS)
    heavy, light = (
        prepare(flow, jax.random.key(0), 0.1, own_grains(diameters, masses=m * diameters**2))
        for m in (1.0, 2.0**-30)
    )
    np.testing.assert_allclose(light.velocities, heavy.velocities, rtol=1e-6, atol=1e-6)


def test_a_flow_that_is_moved_repeats_its_trajectory_there(engine_run, flowing):
    """No place of the sheared cell is special. A place that is higher by b flows faster by γ̇ b."""
    state, flow, shift = flowing(0.6), flow_of(0.6), np.array([[1.3, -2.7]])
    steps = 300
    moved = replace(state, positions=wrap(state.positions + shift, state.side, state.tilt))
    here, tally = engine_run(flow, state, steps)
    there, moved_tally = engine_run(flow, moved, steps)
    assert tally.solves > 10
    assert moved_tally.solves == tally.solves
    np.testing.assert_allclose(there.velocities, here.velocities, atol=1e-8)
    strain = steps * float(flow.timestep)
    expected = here.positions + shift + strain * shift[:, 1:] * np.array([[1.0, 0.0]])
    gone = displacement(there.positions, expected, here.side, here.tilt)
    np.testing.assert_allclose(gone, 0, atol=1e-8)
    np.testing.assert_allclose(moved_tally.contact_moment, tally.contact_moment, rtol=1e-6)


def test_a_gas_without_shear_cools_as_haffs_law_says() -> None:
    """ln T = −(1 − α²)/2 C after C collisions a grain; times N/(N − 1), as the total momentum is
    zero.

    A collision takes (1 − α²) w²/4 of energy, w² exponential with the mean 4T: so ln T has the
    standard deviation (1 − α²) √(C/2N) in one run. Sonine's correction to the loss, 3 a₂/16, is 0.4
    %.
    """
    alpha, seeds, count = 0.95, 8, 64
    flow = ShearFlow(count, alpha, 0.3, 1e-3, shear_rate=0.0, polydispersity=0.0)
    advanced = jax.jit(advance)
    gas = heated(flow, jax.random.split(jax.random.key(0), seeds))
    gas, _ = advanced(replace(flow, restitution=1.0), gas, jnp.int32(6000))  # in equilibrium
    end, tally = advanced(flow, gas, jnp.int32(12_000))
    collisions = 2 * np.asarray(tally.collisions) / count
    fallen = np.log([energy(end[k]) / energy(gas[k]) for k in range(seeds)])
    excess = np.mean(fallen + (1 - alpha**2) / 2 * collisions * count / (count - 1))
    assert fallen.mean() < -0.8
    error = (1 - alpha**2) * np.sqrt(collisions.mean() / (2 * count) / seeds)
    assert abs(excess) <= 4 * error + 0.004 * abs(fallen.mean())


def test_compiled_velocities_equal_the_interpreted_ones(flowing):
    """Some releases of JAX return wrong numbers from compiled code, silently."""
    state = flowing(0.75)
    i, j = (np.arange(GRAINS), np.roll(np.arange(GRAINS), 5))

    def relative(state: State):
        separations = displacement(state.positions[i], state.positions[j], state.side, state.tilt)
        return relative_velocity(state.velocities, i, j, separations, jnp.asarray(1.0))

    np.testing.assert_allclose(
        jax.jit(relative)(state), relative(state), rtol=0, atol=64 * EPS * float(state.side)
    )
