"""The contact stress is Enskog's times four factors, each of which is one where its assumption holds."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flows import flow_of

import jaxgran as jg
from jaxgran.dynamics.tally import Tally, empty_tally
from jaxgran.sampling.enskog_factors import FACTORS, STRESSES, stress_factors
from jaxgran.sampling.sample import BLOCKS, Sample
from jaxgran.theory.steady_shear import contact_value

TENSOR = np.array([[1.3, -0.35], [-0.35, 0.8]])
GRAINS, NU, ALPHA, AREA, DURATION, COLLISIONS = 400, 0.5, 0.6, 400 * np.pi / 4 / 0.5, 0.1, 2000
FLOW = jg.ShearFlow(GRAINS, ALPHA, NU, 1e-3, polydispersity=0.0)


def chaotic_tally(rng: np.random.Generator, pairs: float = 1.0, speed: float = 1.0, impulse: float = 1.0) -> Tally:
    """Sums of a block of collisions of equal discs at random, with independent velocities of a temperature tensor.

    The pairs at contact are so many times those of the theory, their speeds of approach and impulses so many times
    those of independent velocities and of binary collisions. Pairs are drawn, and each stands for the rate w at which
    it collides.
    """
    angle = rng.uniform(0, 2 * np.pi, COLLISIONS)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    w = rng.normal(-n[:, 0] * n[:, 1], np.sqrt(2 * np.einsum("ca,ab,cb->c", n, TENSOR, n)))
    w = speed * np.maximum(w, 0)
    rate = pairs * (GRAINS**2 / AREA / 2) * float(contact_value(NU)) * 2 * np.pi / COLLISIONS * w  # of each pair
    binary, moments = (1 + ALPHA) / 2 * w, np.einsum("ca,cb->cab", n, n)
    sums = {
        "binary_moment": np.einsum("c,cab->ab", rate * binary, moments) * DURATION,
        "binary_speed_moment": np.einsum("c,cab->ab", rate * binary * w, moments) * DURATION,
        "kinetic_moment": GRAINS * TENSOR * DURATION,
        "duration": np.float64(DURATION),
    }
    return replace(empty_tally(np.dtype(float)), contact_moment=impulse * sums["binary_moment"], **sums)


def sample_of(tallies: list[Tally], grains: int = GRAINS, area: float = AREA) -> Sample:
    blocks = jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *tallies)
    return Sample(blocks, np.float64(area), np.float64(1.0), grains)


def chaotic_sample(seed: int, **factors: float) -> Sample:
    rng = np.random.default_rng(seed)
    return sample_of([chaotic_tally(rng, **factors) for _ in range(BLOCKS)])


@pytest.mark.parametrize("packing_fraction", [0.2, 0.75])
def test_factors_times_enskog_are_the_measured_contact_stress(run, flowing, packing_fraction) -> None:
    flow, state, tallies = flow_of(packing_fraction, tolerance=1e-4), flowing(packing_fraction), []
    for _ in range(3):
        state, tally = run(flow, state, 500)
        tallies.append(tally)
    sample = sample_of(tallies, pytest.GRAINS, float(state.side) ** 2)
    value, error = stress_factors(flow, [sample])
    for stress in STRESSES:
        factors = [value[f"{stress}_{factor}"] for factor in FACTORS]
        product = np.prod(factors) * value[f"enskog_{stress}"]
        assert product == pytest.approx(float(sample.averages[f"contact_{stress}"]), rel=1e-12)
        assert all(error[f"{stress}_{factor}"] > 0 for factor in ("anisotropy", "chaos", "pairs"))


def test_factors_of_chaos_are_one() -> None:
    value, error = stress_factors(FLOW, [chaotic_sample(0), chaotic_sample(1)])
    for stress in STRESSES:
        assert value[f"{stress}_binary"] == 1
        for factor in ("chaos", "pairs"):
            off = abs(value[f"{stress}_{factor}"] - 1)
            assert off < 4 * error[f"{stress}_{factor}"] < 0.1
    assert value["pressure_anisotropy"] > 1 and value["shear_stress_anisotropy"] > 1  # T_xy < 0 adds to the shear


@pytest.mark.parametrize(("made", "times", "factor"), [("pairs", 3.0, "pairs"), ("impulse", 1.5, "binary")])
def test_pairs_and_impulses_are_found_in_their_own_factor(made: str, times: float, factor: str) -> None:
    assert_changed(made, times, {factor: times})


def test_slower_approach_is_found_as_its_square() -> None:
    assert_changed("speed", 0.5, {"chaos": 0.25})


def assert_changed(made: str, times: float, expected: dict[str, float]) -> None:
    """A change of the collisions changes these factors of both stresses and no other."""
    chaotic, failing = (stress_factors(FLOW, [chaotic_sample(2, **{made: x})])[0] for x in (1.0, times))
    for stress in STRESSES:
        for factor in FACTORS:
            change = failing[f"{stress}_{factor}"] / chaotic[f"{stress}_{factor}"]
            assert change == pytest.approx(expected.get(factor, 1.0), rel=1e-9), (stress, factor)


def test_stress_of_no_collisions_has_no_factors_but_an_enskog_stress() -> None:
    nothing = replace(empty_tally(np.dtype(float)), kinetic_moment=GRAINS * TENSOR, duration=np.float64(1.0))
    value, _ = stress_factors(FLOW, [sample_of([nothing] * 2)])
    assert np.isnan([value[f"{stress}_{factor}"] for stress in STRESSES for factor in ("chaos", "pairs")]).all()
    assert value["enskog_pressure"] > 0 and value["enskog_shear_stress"] > 0


@pytest.mark.slow
def test_all_assumptions_hold_in_dilute_nearly_elastic_flow() -> None:
    data = jg.ratio_map([0.95], [0.1], grains=400, timestep=2e-4, equilibrate=40.0, strain=20.0)
    for factor in ("chaos", "pairs", "binary"):
        value, error = (float(data[f"theory/enskog_factor_pressure_{factor}{end}"]) for end in ("", "_stderr"))
        assert abs(value - 1) < 4 * error + 0.01, factor
