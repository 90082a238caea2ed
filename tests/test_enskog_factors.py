"""Measured rates are Enskog's times five factors, each one where its assumption holds."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flows import flow_of
from synthetic import refused, sample_of_tally

import jaxgran as jg
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.tally import Tally, empty_tally
from jaxgran.sampling.enskog_factors import RATES, measured_over_enskog
from jaxgran.sampling.sample import BLOCKS, Sample, estimates
from jaxgran.theory.assumptions import ASSUMPTIONS
from jaxgran.theory.enskog import collisional_transfer
from jaxgran.theory.steady_shear import contact_value

TENSOR = np.array([[1.3, -0.35], [-0.35, 0.8]])
GRAINS, NU, ALPHA, AREA, DURATION, COLLISIONS = 400, 0.5, 0.6, 400 * np.pi / 4 / 0.5, 10.0, 2000


def measured_rates(sample: Sample) -> dict[str, float]:
    contact = np.asarray(sample.contact_stress)
    of_stress = {"pressure": float(np.trace(contact)) / 2, "shear_stress": -float(contact[0, 1])}
    return of_stress | {"dissipation_rate": float(sample.dissipation_rate)}


FLOW = jg.ShearFlow(GRAINS, ALPHA, NU, 1e-3, polydispersity=0.0)


def chaotic_tally(
    rng: np.random.Generator,
    waves: float = 1.0,
    pairs: float = 1.0,
    speed: float = 1.0,
    impulse: float = 1.0,
) -> Tally:
    """Sums of a block of collisions of equal discs at random, with independent velocities of a
    temperature tensor.

    The granular temperature is so many times the local one, which is that of the collisions. The
    pairs at contact are so many times those of the theory, their speeds of approach and impulses so
    many times those of independent velocities and of binary collisions. Pairs are drawn, and each
    stands for the rate w at which it collides.
    """
    angle = rng.uniform(0, 2 * np.pi, COLLISIONS)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    w = rng.normal(-n[:, 0] * n[:, 1], np.sqrt(2 * np.einsum("ca,ab,cb->c", n, TENSOR, n)))
    w = speed * np.maximum(w, 0)
    # of each pair
    rate = pairs * (GRAINS**2 / AREA / 2) * float(contact_value(NU)) * 2 * np.pi / COLLISIONS * w
    binary, moments = (1 + ALPHA) / 2 * w, np.einsum("ca,cb->cab", n, n)
    sums = {
        "binary_moment": np.einsum("c,cab->ab", rate * binary, moments) * DURATION,
        "binary_speed_moment": np.einsum("c,cab->ab", rate * binary * w, moments) * DURATION,
        "binary_dissipation": np.sum(rate * (1 - ALPHA) / 2 * binary * w) * DURATION,
        "kinetic_moment": waves * GRAINS * TENSOR * DURATION,
        "local_kinetic": np.trace(TENSOR) / 2 * DURATION,
        "duration": np.float64(DURATION),
    }
    measured = {"contact_moment": sums["binary_moment"], "dissipation": sums["binary_dissipation"]}
    return replace(
        empty_tally(np.dtype(float)),
        **{name: impulse * one for name, one in measured.items()},
        **sums,
    )


def sample_of(tallies: list[Tally], flow: jg.ShearFlow = FLOW) -> Sample:
    blocks = jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *tallies)
    return sample_of_tally(blocks, flow)


def chaotic_sample(seed: int, **factors: float) -> Sample:
    rng = np.random.default_rng(seed)
    return sample_of([chaotic_tally(rng, **factors) for _ in range(BLOCKS)])


def sheared(engines, flowing, packing_fraction: float, blocks: int) -> Sample:
    flow, state, tallies = flow_of(packing_fraction), flowing(packing_fraction), []
    for _ in range(blocks):
        state, tally = engines["numba"](flow, state, 500, BarzilaiBorwein())
        tallies.append(tally)
    return sample_of(tallies, flow)


@pytest.mark.parametrize("packing_fraction", [0.2, 0.75])
def test_factors_times_enskog_are_what_is_measured(engines, flowing, packing_fraction) -> None:
    sample = sheared(engines, flowing, packing_fraction, 3)
    value, error = measured_over_enskog(flow_of(packing_fraction), [sample])
    measured = measured_rates(sample)
    for rate in RATES:
        factors = [value[f"{rate}_{factor}"] for factor in ASSUMPTIONS]
        product = np.prod(factors) * value[f"enskog_{rate}"]
        assert product == pytest.approx(measured[rate], rel=1e-12)
        of_errors = "local_temperature", "anisotropy", "chaos", "pairs"
        assert all(error[f"{rate}_{factor}"] > 0 for factor in of_errors)
    chaotic = {rate: value[f"enskog_{rate}"] for rate in RATES}
    for rate in RATES:
        chaotic[rate] *= value[f"{rate}_local_temperature"] * value[f"{rate}_anisotropy"]
    length = chaotic["dissipation_rate"] / measured["dissipation_rate"]
    assert value["correlation_length"] == pytest.approx(length, rel=1e-12)
    by_pressure = length * measured["pressure"] / chaotic["pressure"]
    assert value["correlation_length_from_pressure"] == pytest.approx(by_pressure, rel=1e-12)


def test_steady_flow_dissipates_the_power_of_its_shear(engines, flowing) -> None:
    value, error = estimates([sheared(engines, flowing, 0.75, 600)])
    off = value["dissipation_rate"] - value["shear_stress"]  # at a shear rate of one
    both = np.hypot(error["dissipation_rate"], error["shear_stress"])
    assert abs(off) < 3 * both < 0.2 * value["shear_stress"]


def test_factors_of_chaos_are_one() -> None:
    value, error = measured_over_enskog(FLOW, [chaotic_sample(0), chaotic_sample(1)])
    for rate in RATES:
        assert value[f"{rate}_binary"] == 1
        assert value[f"{rate}_local_temperature"] == pytest.approx(1, rel=1e-12)
        # T_xy < 0 adds to the speeds along which the shear pushes
        assert value[f"{rate}_anisotropy"] > 1
        for factor in ("chaos", "pairs"):
            off = abs(value[f"{rate}_{factor}"] - 1)
            assert off < 4 * error[f"{rate}_{factor}"] < 0.1
    for name in ("correlation_length", "correlation_length_from_pressure"):
        assert abs(value[name] - 1) < 4 * error[name] < 0.1


@pytest.mark.parametrize(
    ("made", "times", "expected"),
    [
        ("pairs", 3.0, {"pairs": 3.0}),
        ("impulse", 1.5, {"binary": 1.5}),
        ("speed", 0.5, {"chaos": 0.25, "dissipation_rate_chaos": 0.125}),
    ],
)
def test_a_change_of_collisions_is_found_in_its_own_factor(
    made: str, times: float, expected: dict
) -> None:
    chaotic, failing = (
        measured_over_enskog(FLOW, [chaotic_sample(2, **{made: x})])[0] for x in (1.0, times)
    )
    for rate in RATES:
        for factor in ASSUMPTIONS:
            change = failing[f"{rate}_{factor}"] / chaotic[f"{rate}_{factor}"]
            found_in = expected.get(f"{rate}_{factor}", expected.get(factor, 1.0))
            assert change == pytest.approx(found_in, rel=1e-9), (rate, factor)


def test_long_waves_change_the_granular_temperature_alone() -> None:
    calm, waving = (measured_over_enskog(FLOW, [chaotic_sample(2, waves=x)])[0] for x in (1.0, 2.0))
    lengths = ("correlation_length", "correlation_length_from_pressure")
    others = [factor for factor in ASSUMPTIONS if factor != "local_temperature"]
    kept = [f"{rate}_{factor}" for rate in RATES for factor in others]
    for name in (*kept, *lengths):
        assert waving[name] == pytest.approx(calm[name], rel=1e-9), name
    warm, cold = (momentum_and_energy(x * np.trace(TENSOR) / 2) for x in (2, 1))
    for rate in RATES:
        assert waving[f"enskog_{rate}"] == pytest.approx(warm[rate], rel=1e-9)
        factor = waving[f"{rate}_local_temperature"]
        assert factor == pytest.approx(cold[rate] / warm[rate], rel=1e-9)


def momentum_and_energy(temperature: float) -> dict[str, float]:
    """Enskog's contact stresses and dissipation rate at an isotropic temperature."""
    transfer = collisional_transfer(temperature * np.eye(2), ALPHA, NU, polydispersity=0.0)
    stress = np.asarray(transfer.stress)
    return {
        "pressure": np.trace(stress) / 2,
        "shear_stress": -stress[0, 1],
        "dissipation_rate": float(transfer.dissipation_rate),
    }


def test_no_collisions_have_no_factors_but_enskogs_rates() -> None:
    still = {
        "kinetic_moment": GRAINS * TENSOR,
        "local_kinetic": np.float64(1.0),
        "duration": np.float64(1.0),
    }
    value, _ = measured_over_enskog(
        FLOW, [sample_of([replace(empty_tally(np.dtype(float)), **still)] * 2)]
    )
    missing = [f"{rate}_{factor}" for rate in RATES for factor in ("chaos", "pairs", "binary")]
    assert np.isnan([value[name] for name in (*missing, "correlation_length")]).all()
    assert all(value[f"enskog_{rate}"] > 0 for rate in RATES)


def test_elastic_grains_have_no_correlation_length() -> None:
    zero = {"dissipation": np.float64(0), "binary_dissipation": np.float64(0)}
    elastic = replace(chaotic_tally(np.random.default_rng(0)), **zero)
    value, _ = measured_over_enskog(replace(FLOW, restitution=1.0), [sample_of([elastic] * 2)])
    assert np.isnan([value["correlation_length"], value["dissipation_rate_pairs"]]).all()
    assert value["enskog_dissipation_rate"] == 0 and np.isfinite(value["pressure_pairs"])


def test_own_grains_must_be_given_and_the_unit_of_mass_changes_no_factor() -> None:
    sample = chaotic_sample(0)
    heavy = replace(sample, mass=4 * sample.mass)  # in another unit: all moments are as many times
    moments = "contact_moment binary_moment binary_speed_moment kinetic_moment local_kinetic "
    times = {
        x: 4 * getattr(sample.tally, x)
        for x in (moments + "dissipation binary_dissipation").split()
    }
    heavy = replace(heavy, tally=replace(sample.tally, **times))
    grains = jg.own_grains(np.ones(GRAINS), 4 * np.ones(GRAINS))
    for other in (heavy, replace(sample, area=1.1 * sample.area)):
        with refused("grains must be given"):
            measured_over_enskog(FLOW, [other])
    hollow = jg.own_grains(np.ones(GRAINS), np.where(np.arange(GRAINS) % 2, 0.03, 1))
    with refused("masses proportional to the squares of their diameters"):
        measured_over_enskog(FLOW, [sample], hollow)
    expected, _ = measured_over_enskog(FLOW, [sample])
    value, _ = measured_over_enskog(FLOW, [heavy], grains)
    for name, factor in expected.items():
        unit = 4 if name.startswith("enskog_") else 1
        np.testing.assert_allclose(value[name], unit * factor, rtol=1e-9)
