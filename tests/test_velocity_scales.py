"""Which part of the granular temperature is local, and which is in the longest waves."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS, flow_of

import jaxgran as jg
from jaxgran.dynamics import velocity_scales
from jaxgran.dynamics.velocity_scales import READ_AFTER
from jaxgran.model.grains import Grains
from jaxgran.model.state import State

COUNT, SIDE = 900, 30.0

local_temperature, wave_temperature = map(
    jax.jit, (velocity_scales.local_temperature, velocity_scales.wave_temperature)
)


def state_of(velocities, positions=None, tilt=0.3, masses=None) -> State:
    rng = np.random.default_rng(5)
    places = rng.uniform(0, SIDE, (COUNT, 2)) if positions is None else positions
    grains = Grains(
        jnp.full(COUNT, 0.5), jnp.ones(COUNT) if masses is None else jnp.asarray(masses)
    )
    return State(
        grains, jnp.asarray(places), jnp.asarray(velocities), jnp.asarray(SIDE), jnp.asarray(tilt)
    )


def places() -> np.ndarray:
    return np.random.default_rng(5).uniform(0, SIDE, (COUNT, 2))


def wave(positions: np.ndarray, number: tuple[int, int], tilt: float) -> np.ndarray:
    """The phase of a wave that fits into the sheared cell."""
    x, y = positions.T / SIDE
    return 2 * np.pi * (number[0] * (x - tilt * y) + number[1] * y)


def test_uncorrelated_velocities_have_one_temperature_at_all_lengths():
    rng = np.random.default_rng(1)
    masses = rng.uniform(0.5, 2, COUNT)
    drawn = [rng.normal(size=(COUNT, 2)) * np.sqrt(3 / masses)[:, None] for _ in range(200)]
    states = [state_of(velocities, masses=masses) for velocities in drawn]
    local = np.array([local_temperature(one) for one in states])
    waves = np.array([wave_temperature(one) for one in states])
    for measured in (local, waves):
        assert abs(measured.mean() - 3) < 4 * measured.std() / np.sqrt(len(measured))


def test_a_uniform_velocity_in_each_box_is_no_local_temperature():
    """With 900 grains there are 6 × 6 boxes."""
    tilt = -0.4
    x, y = places().T / SIDE
    column, row = np.floor(((x - tilt * y) % 1) * 6), np.floor(y * 6)
    velocities = np.stack([np.sin(column) + row, np.cos(row * column)], axis=1)
    assert local_temperature(state_of(velocities, tilt=tilt)) < 1e-28
    assert local_temperature(state_of(velocities, tilt=tilt + 0.1)) > 1e-3


@pytest.mark.parametrize("number", [(1, 0), (0, 1), (1, 1), (1, -1), (2, 0)])
def test_a_wave_of_the_sheared_cell_is_counted_if_it_is_one_of_the_longest(number):
    tilt = 0.3
    even = np.stack(np.meshgrid(np.arange(30), np.arange(30)), axis=-1).reshape(-1, 2) + 0.5
    positions = even + np.stack([tilt * even[:, 1], np.zeros(COUNT)], axis=1)
    velocities = np.stack([np.zeros(COUNT), np.cos(wave(positions, number, tilt))], axis=1)
    expected = COUNT / 4 / 8  # |Σ cos²|²/N = N/4, in one of four waves and one of two components
    found = wave_temperature(state_of(velocities, positions, tilt))
    np.testing.assert_allclose(found, 0 if number == (2, 0) else expected, atol=1e-9)


def test_neither_depends_on_the_image_of_a_grain_or_on_the_cell_that_describes_the_lattice():
    rng = np.random.default_rng(3)
    velocities, one = rng.normal(size=(COUNT, 2)), places()
    image = (
        one + rng.integers(-2, 3, (COUNT, 1)) * np.array([SIDE, 0.0]) + np.array([0.3 * SIDE, SIDE])
    )
    for measure in (local_temperature, wave_temperature):
        np.testing.assert_allclose(
            measure(state_of(velocities, image)), measure(state_of(velocities, one)), rtol=1e-9
        )


@pytest.mark.parametrize("count", [2, 16])
def test_few_grains_are_one_box(count):
    velocities = np.random.default_rng(2).normal(size=(count, 2))
    grains = Grains(jnp.full(count, 0.5), jnp.ones(count))
    positions = jnp.asarray(np.random.default_rng(4).uniform(0, 5, (count, 2)))
    state = State(grains, positions, jnp.asarray(velocities), jnp.asarray(5.0), jnp.asarray(0.0))
    np.testing.assert_allclose(
        local_temperature(state), np.sum(np.var(velocities, axis=0)) / 2 * count / (count - 1)
    )


def test_the_local_temperature_is_averaged_as_well_as_the_granular_temperature():
    """In dense dissipative flow, where both fluctuate alike; one reading a block did worse."""
    flow = jg.ShearFlow(64, 0.2, 0.8, 1e-3)
    state = jg.prepare(flow, jax.random.key(0))
    _, sample = jg.sample(flow, state, 80.0)
    errors = sample.errors()
    local, granular = (
        float(errors[name] / getattr(sample, name))
        for name in ("local_granular_temperature", "granular_temperature")
    )
    assert 0.5 < local / granular < 1.6


def test_readings_of_a_long_sample_are_those_of_any_time() -> None:
    """In one box of N grains the local temperature is N/(N − 1) times the granular one, which is
    averaged along all flights. A reading after a number of collisions is 2.7 % above that here.
    """
    grains, ratios = 32, []
    flow = jg.ShearFlow(grains, 0.1, 0.1, 2e-3)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=40.0)
    for _ in range(12):
        state, sample = jg.sample(flow, state, 20_000.0)
        ratios.append(sample.local_granular_temperature / sample.granular_temperature)
    excess = np.array(ratios, float) * (grains - 1) / grains - 1
    error = np.std(excess, ddof=1) / np.sqrt(len(excess))
    assert error < 0.006 and abs(np.mean(excess)) < 3 * error


def test_readings_of_both_engines_are_taken_in_the_same_steps(packed, engines):
    """Past one reading within the advance, in a dense and slowly sheared flow; with the tilt of
    another time the waves differ by 0.3 %.
    """
    rng = np.random.default_rng(0)
    flow = flow_of(0.7, restitution=1.0, timestep=2e-3, shear_rate=0.1)
    state = replace(packed(0.7), velocities=jnp.asarray(rng.normal(size=(GRAINS, 2))))
    (_, numba), (end, plain) = (engines[name](flow, state, 1500) for name in ("numba", "jax"))
    assert numba.collisions == plain.collisions > READ_AFTER * GRAINS / 2
    for name in ("local_kinetic", "wave_kinetic"):
        np.testing.assert_allclose(getattr(numba, name), getattr(plain, name), rtol=1e-4)
    last = plain.duration * wave_temperature(end)
    assert abs(plain.wave_kinetic - last) > 0.01 * last  # it is more than the last reading
