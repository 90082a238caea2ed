"""Free cooling: Haff's law in collisions and in time, no gain of energy, no time scale."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from synthetic import refused

from jaxgran.dynamics.snapshots import snapshot_series
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.free_cooling import Cooling, cooling
from jaxgran.sampling.sample import sample
from jaxgran.sampling.steady_state import heated, prepare
from jaxgran.theory.enskog import collisional_transfer
from jaxgran.theory.steady_shear import contact_value

GRAINS, NU, ALPHA, SEEDS = 64, 0.3, 0.95, 8
FLOW = ShearFlow(GRAINS, ALPHA, NU, 1e-3, shear_rate=0.0, polydispersity=0.0)
TIMES = np.linspace(1.5, 12.0, 8)


@pytest.fixture(scope="module")
def gases() -> list[State]:
    """Packings at temperature one, after some twelve collisions a grain without loss.

    Their keys are numbers, as in a map: what packs them is compiled once for both.
    """
    elastic, keys = replace(FLOW, restitution=1.0), [jax.random.PRNGKey(k) for k in range(SEEDS)]
    return [cooling(elastic, heated(FLOW, key), TIMES / 2)[0] for key in keys]


@pytest.fixture(scope="module")
def cooled(gases) -> list[Cooling]:
    return [cooling(FLOW, gas, TIMES)[1] for gas in gases]


def temperature(state: State) -> float:
    return float(np.sum(np.asarray(state.grains.masses)[:, None] * np.asarray(state.velocities) ** 2) / (2 * GRAINS))


def test_temperature_falls_with_the_collisions_as_haffs_law_says(cooled) -> None:
    """ln T = −(1 − α²)/2 C, whatever the density; times N/(N − 1), since two of the 2N velocities are the momentum's.

    A collision takes (1 − α²) w²/4 of energy, w² exponential with the mean 4T: so ln T has the standard deviation
    (1 − α²) √(C/2N) in one run. Sonine's correction to the loss, 3 a₂/16, is 0.4 %.
    """
    collisions = np.stack([one.collisions for one in cooled])
    fallen = np.log(np.stack([one.temperature for one in cooled]))
    excess = fallen + (1 - ALPHA**2) / 2 * collisions * GRAINS / (GRAINS - 1)
    error = (1 - ALPHA**2) * np.sqrt(collisions.mean(axis=0) / (2 * GRAINS) / SEEDS)
    assert fallen[:, -1].mean() < -0.8
    assert np.all(np.abs(excess.mean(axis=0)) <= 4 * error + 0.004 * np.abs(fallen.mean(axis=0)))


def test_temperature_falls_in_time_as_haffs_law_says(cooled) -> None:
    """1/√T = 1 + t/τ, 1/τ = (1 − α²) √π n χ/2, with Enskog's χ: 2n/τ is Enskog's dissipation rate at T = 1.

    To 3 %: four standard errors of the run of 1.5 % (the last test's, over eight runs, and that of the number of
    collisions), and one for χ (Henderson's to 0.3 %, and of order 1/N) and for Sonine's correction.
    """
    density = NU / (np.pi / 4)
    rate = (1 - ALPHA**2) * np.sqrt(np.pi) * density * float(contact_value(NU)) / 2
    loss = collisional_transfer(np.eye(2), ALPHA, NU, shear_rate=0.0, polydispersity=0.0).dissipation_rate
    assert float(loss) == pytest.approx(2 * density * rate, rel=1e-12)
    slowed = np.mean([1 / np.sqrt(np.asarray(one.temperature)) for one in cooled], axis=0) - 1
    measured = np.sum(slowed * TIMES) / np.sum(TIMES**2)
    assert measured == pytest.approx(rate * np.sqrt(GRAINS / (GRAINS - 1)), rel=0.03)


def test_energy_never_grows_and_is_what_the_contacts_have_left(gases) -> None:
    for alpha in (0.0, 0.5, 0.9):
        end, record = cooling(replace(FLOW, restitution=alpha), gases[0], TIMES)
        steps = np.diff(np.asarray(record.temperature), prepend=temperature(gases[0]))
        assert np.all(steps < 0)
        np.testing.assert_allclose(-steps * GRAINS, record.tally.dissipation, rtol=1e-9)
        assert record.temperature[-1] == pytest.approx(temperature(end))
        assert record.status <= Status.iteration_limit


def test_there_is_no_time_scale(gases) -> None:
    """Twice as fast grains and half the time step: the same places, bit for bit, and four times the temperature."""
    end, record = cooling(FLOW, gases[0], TIMES)
    fast = replace(gases[0], velocities=2 * gases[0].velocities)
    fast_end, fast_record = cooling(replace(FLOW, timestep=FLOW.timestep / 2), fast, TIMES / 2)
    np.testing.assert_array_equal(fast_end.positions, end.positions)
    np.testing.assert_array_equal(fast_end.velocities, 2 * end.velocities)
    np.testing.assert_array_equal(fast_record.temperature, 4 * record.temperature)
    np.testing.assert_array_equal(fast_record.collisions, record.collisions)
    np.testing.assert_array_equal(fast_record.tally.dissipation, 4 * record.tally.dissipation)


def test_record_is_at_the_times_in_whole_steps_and_starts_at_the_start(gases) -> None:
    times = [0.0104, 0.5, 0.6001, 0.7, 0.8, 0.9, 1.0, 1.1]  # as many as the others, compiled already
    _, record = cooling(FLOW, gases[0], times)
    np.testing.assert_allclose(record.times, [0.010, 0.5, 0.6, *times[3:]], rtol=1e-12)
    np.testing.assert_array_equal(record.tally.steps, [10, 490, 100, 100, 100, 100, 100, 100])
    np.testing.assert_allclose(record.collisions, 2 * np.cumsum(record.tally.collisions) / GRAINS)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda state: sample(FLOW, state, 1.0), "shear_rate must be above 0"),
        (lambda state: snapshot_series(FLOW, state, 1.0, 3), "shear_rate must be above 0"),
        (lambda _: prepare(FLOW, jax.random.key(0)), "shear_rate must be above 0"),
        (lambda state: cooling(replace(FLOW, shear_rate=1.0), state, TIMES), "shear_rate must be 0 in free cooling"),
        (lambda state: cooling(replace(FLOW, timestep=1.0), state, TIMES), "timestep must be at most"),
        (lambda state: cooling(FLOW, state, [1.0, 1.0]), "times must increase by a time step, 0.001, or more"),
        (lambda state: cooling(FLOW, state, [1.0, 1e30]), "at most 2147483647 time steps, 2.14748e\\+06, apart"),
        (lambda state: cooling(FLOW, state, [1.0, -2.0]), "times must be a list of positive times"),
        (lambda _: heated(FLOW, jax.random.key(0), temperature=0.0), "temperature must be a positive number"),
    ],
    ids=["sample", "snapshots", "prepare", "sheared", "overlaps", "same time", "late", "before", "temperature"],
)
def test_what_makes_no_sense_without_shear_is_refused_in_one_sentence(gases, made, words: str) -> None:
    with refused(words):
        made(gases[0])
