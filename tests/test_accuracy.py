"""Long averages of small flows: against an event-driven program, a value that was measured with
many replicas, other units of time and shorter time steps. And the choice of time step: against
temperatures of other programs and the charts that it was read off.
"""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from test_event_driven import lattice

import jaxgran as jg
from benchmarks.independent.event_driven import Law, averages, sheared
from jaxgran.dynamics.batch import stack
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.timestep import (
    automatic_timestep,
    expected_temperature,
    longest_timestep,
    stress_error,
)

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
# (packing fraction, restitution): temperature of event-driven hard discs, and of soft ones in the
# stiff limit
TEMPERATURES = {
    (0.20, 0.9): 10.92,
    (0.20, 0.7): 3.105,
    (0.20, 0.5): 1.633,
    (0.60, 0.9): 2.057,
    (0.60, 0.7): 0.548,
    (0.60, 0.5): 0.344,
    (0.70, 0.9): 1.97,
    (0.70, 0.7): 0.537,
    (0.70, 0.5): 0.369,
    (0.80, 0.5): 1.27,
    (0.80, 0.8): 1.59,
}


def test_expected_temperature_is_within_a_factor_of_two_of_other_programs() -> None:
    flows = stack([ShearFlow(64, alpha, nu, 1e-5) for nu, alpha in TEMPERATURES])
    expected = expected_temperature(predicted(flows).granular_temperature, flows.packing_fraction)
    ratio = expected / np.array(list(TEMPERATURES.values()))
    assert np.all((ratio > 0.5) & (ratio < 2))


def test_expected_temperature_scales_with_the_square_of_the_shear_rate() -> None:
    flow, faster = (stack([ShearFlow(64, 0.5, 0.8, 1e-5, shear_rate=rate)]) for rate in (1.0, 2.0))
    cold, hot = (
        expected_temperature(predicted(f).granular_temperature, 0.8, f.shear_rate)
        for f in (flow, faster)
    )
    np.testing.assert_allclose(hot, 4 * cold, rtol=1e-6)


@pytest.mark.parametrize("activation", [0.5, 0.0])
def test_time_steps_shorten_with_heat_with_density_and_with_the_error_asked_for(activation) -> None:
    nu = np.linspace(0.1, 0.83, 20)
    for steps in (
        longest_timestep(1.0, nu, activation),
        automatic_timestep(1.0, nu, activation, 256, 1e-3),
    ):
        assert np.all(np.diff(steps) <= 0) and steps[-1] > 0
    np.testing.assert_allclose(
        longest_timestep(4.0, nu, activation), longest_timestep(1.0, nu, activation) / 2
    )
    assert np.all(
        automatic_timestep(1.0, nu, activation, 256, 1e-3)
        < automatic_timestep(1.0, nu, activation, 256, 1e-2)
    )
    assert np.all(
        automatic_timestep(1.0, nu, activation, 256, 0.1) <= longest_timestep(1.0, nu, activation)
    )
    assert np.all(longest_timestep(1.0, nu, 0.0) < longest_timestep(1.0, nu, 0.5))


def test_errors_of_time_steps_are_within_the_bound_and_their_noise() -> None:
    """Of all samples of a study with steps of up to 1e-2, also of those with deep overlaps."""
    study = json.loads((RESULTS / "timestep_error.json").read_text())
    for row in study["rows"]:
        crossing = row["timestep"] * np.sqrt(row["temperature"])
        bound = stress_error(crossing, row["packing_fraction"], study["plan"]["grains"])
        assert abs(row["error"]) < bound + 3 * row["error_stderr"], row


def test_errors_of_the_committed_chart_of_whole_runs_are_within_the_bound_and_its_noise() -> None:
    chart, compared = json.loads((RESULTS / "speed_vs_accuracy.json").read_text()), 0
    for flow in chart["flows"]:
        for row in flow["rows"]:
            if row["curve"] != "jaxgran":
                continue
            temperature = row["values"]["granular_temperature"][0]
            crossing = row["setting"] * np.sqrt(temperature)
            if crossing > 5e-3:
                continue
            compared += 1
            bound = stress_error(crossing, flow["packing_fraction"], flow["discs"])
            for name in ("pressure", "shear_stress"):
                error, noise = row["errors"][name]
                where = flow["packing_fraction"], row["setting"], name
                assert abs(error) < bound + 3 * noise + 0.01, where
    assert compared > 2 * len(chart["flows"])


def test_the_bound_grows_where_few_grains_may_jam() -> None:
    bounds = stress_error(1e-3, 0.8, np.array([1e9, 4096, 256, 64]))
    assert bounds[0] == pytest.approx(1e-3 * 1.6 / 0.0386, rel=1e-3) and np.all(np.diff(bounds) > 0)
    few = automatic_timestep(1.0, 0.8, 0.5, 64, 0.01)
    assert few / automatic_timestep(1.0, 0.8, 0.5, 10**9, 0.01) == pytest.approx(
        bounds[0] / bounds[3]
    )


GRAINS = 64


def sampled(strain: float, engine: jg.Jax | None = None, **numbers: float) -> jg.Sample:
    """A long sample of a steady flow."""
    flow = jg.ShearFlow(GRAINS, **{"timestep": 1e-3, **numbers})
    return jg.sample(flow, jg.prepare(flow, jax.random.key(1)), strain, engine=engine)[1]


def assert_agree(sample: jg.Sample, expected: dict, scale: float = 1.0) -> None:
    """Averages are those expected within four standard errors of both, which are small."""
    for name, (value, error) in expected.items():
        own, stderr = getattr(sample, name) / scale, sample.errors()[name] / scale
        both = np.hypot(stderr, error)
        assert both < 0.05 * value and abs(own - value) < 4 * both, name


def test_averages_of_the_engine_jax_are_those_of_event_driven_discs() -> None:
    law = Law(0.9)
    discs, _ = sheared(lattice(8, 0.5), law, 20.0)
    discs, sums = sheared(discs, law, 200.0, blocks=20)
    blocks = averages(sums, discs)
    expected = {
        name: (np.mean(blocks[name]), np.std(blocks[name], ddof=1) / np.sqrt(20))
        for name in ("pressure", "granular_temperature")
    }
    numbers = {"restitution": 0.9, "packing_fraction": 0.5}
    assert_agree(sampled(100.0, engine=jg.Jax(), **numbers), expected)


def test_the_force_ratio_of_a_dense_flow_is_that_of_64_replicas() -> None:
    """1.3343 ± 0.0020 over a strain of 50 each."""
    sample = sampled(400.0, restitution=0.3, packing_fraction=0.7)
    assert_agree(sample, {"force_ratio": (1.3343, 0.002)})
    assert sample.errors()["force_ratio"] < 0.02


def test_stresses_go_with_the_square_of_a_shear_rate_that_is_no_power_of_two() -> None:
    """Bagnold's scaling; that of a power of two is exact."""
    numbers = {"restitution": 0.7, "packing_fraction": 0.5}
    one, fast = (
        sampled(400.0, shear_rate=rate, timestep=1e-3 / rate, **numbers) for rate in (1.0, 3.0)
    )
    names = "pressure", "shear_stress", "granular_temperature"
    assert_agree(fast, {name: (getattr(one, name), one.errors()[name]) for name in names}, 9.0)


def test_a_dense_flow_converges_in_the_time_step_within_its_bound() -> None:
    """A step of 5e-3 makes the pressure too small by far; the bound of each step holds."""
    numbers = {"restitution": 0.5, "packing_fraction": 0.8}
    exact = sampled(100.0, timestep=1e-4, **numbers)
    for timestep, is_coarse in ((5e-3, True), (1e-3, False)):
        sample = sampled(100.0, timestep=timestep, **numbers)
        noise = np.hypot(sample.errors()["pressure"], exact.errors()["pressure"]) / exact.pressure
        error = sample.pressure / exact.pressure - 1
        assert abs(error) < sample.timestep_error + 3 * noise
        assert (error < -4 * noise) == is_coarse
