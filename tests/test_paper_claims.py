"""What is read from windows, bands and instants for the properties that the paper names."""

import jax
import numpy as np
import pytest
from flows import GRAINS, flow_of

import jaxgran as jg
from benchmarks.paper_claims import deviation, impulses, quotient, ratios, snapshot, spread
from jaxgran.analysis.order import hexatic_order


def test_half_of_the_mean_mass_is_the_reduced_mass_of_equal_grains_only() -> None:
    found = []
    for width in (0.0, 0.26):
        flow = jg.ShearFlow(GRAINS, restitution=0.5, packing_fraction=0.6, timestep=1e-3, polydispersity=width)
        state = jg.prepare(flow, jax.random.key(0), equilibrate=4.0)
        _, sample = jg.sample(flow, state, 4.0, observe=impulses)
        value, _ = sample.observed(ratios)
        assert float(value["force_ratio"]) == pytest.approx(float(sample.force_ratio), rel=1e-9)
        found.append(float(value["force_ratio_with_half_of_the_mean_mass"] / value["force_ratio"]))
    assert found[0] == pytest.approx(1, rel=1e-9)
    assert abs(found[1] - 1) > 0.01


def test_windows_of_a_sample_have_its_force_ratio_if_weighted_by_their_force(flowing) -> None:
    _, sample = jg.sample(flow_of(0.75, restitution=0.1), flowing(0.75), 1.0, blocks=20)
    found = spread(sample)
    ratio = np.asarray(sample.tally.impulse / sample.tally.binary_impulse)
    assert found["windows"] == 20
    assert np.average(ratio, weights=sample.tally.binary_impulse) == pytest.approx(found["force_ratio"][0])
    low, high = found["middle_95_percent_of_windows"]
    assert ratio.min() <= low < found["mean_of_windows"] < high <= ratio.max()


def test_bands_of_pure_noise_have_a_chi_square_of_one() -> None:
    rng, bands = np.random.default_rng(0), 2000
    error = rng.uniform(0.1, 0.3, bands)
    found = deviation(error * rng.normal(size=bands), error)
    assert abs(found["chi_square_of_a_band"] - 1) < 4 * np.sqrt(2 / bands)
    assert found["rms"] == pytest.approx(found["rms_error"], rel=4 / np.sqrt(bands))


def test_error_of_a_quotient_is_its_scatter() -> None:
    rng = np.random.default_rng(1)
    value, other = rng.normal(3, 0.03, 10_000), rng.normal(2, 0.04, 10_000)
    exact, error = quotient(3.0, 0.03, 2.0, 0.04)
    assert exact == 1.5
    assert np.std(value / other) == pytest.approx(error, rel=0.05)


def test_positions_alone_have_their_hexatic_order() -> None:
    """A hexagonal lattice of 14 rows of 12, strained by less than 1 % to close in a square cell."""
    rows, columns, side = 14, 12, 12.0
    k, m = np.meshgrid(np.arange(columns), np.arange(rows))
    positions = np.stack([((k + m / 2) * side / columns).ravel(), (m * side / rows).ravel()], axis=1)
    order = hexatic_order(snapshot(positions, side, 0.0))
    np.testing.assert_allclose([order.overall.value, order.local.value], 1, atol=1e-2)
