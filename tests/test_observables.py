"""Averages are the means of the contacts and grains that were tallied."""

import numpy as np
import pytest
from synthetic import random_tally

from jaxgran.dynamics.tally import Tally, empty_tally
from jaxgran.sampling.averages import averages
from jaxgran.sampling.observables import OBSERVABLES

GRAINS, AREA, SHEAR_RATE, TIMESTEP = 20, 31.0, 2.0, 1e-2


@pytest.fixture(scope="module")
def microscopic() -> dict[str, list[np.ndarray]]:
    """Arrays over the contacts of each of a few time steps, and the velocities of each."""
    rng = np.random.default_rng(0)
    counts = [7, 0, 5, 9, 0, 0, 3]
    return {
        "impulses": [rng.gamma(2.0, 0.1, n) * rng.integers(0, 2, n) for n in counts],
        "binary": [rng.gamma(2.0, 0.1, n) * rng.integers(0, 2, n) for n in counts],
        "branches": [rng.normal(size=(n, 2)) for n in counts],
        "velocities": [rng.normal(size=(GRAINS, 2)) for _ in counts],
        "masses": [rng.uniform(0.5, 1.5, GRAINS)],
        "iterations": [np.array(float(n)) for n in counts],
    }


@pytest.fixture(scope="module")
def tally(microscopic) -> Tally:
    def moment(impulses: str) -> np.ndarray:
        total = np.zeros((2, 2))
        for p, branch in zip(microscopic[impulses], microscopic["branches"], strict=True):
            for k in range(len(p)):
                total += p[k] * np.outer(branch[k], branch[k]) / np.linalg.norm(branch[k])
        return total

    masses = microscopic["masses"][0]
    kinetic = sum(
        np.einsum("i,ia,ib->ab", masses, c, c) * TIMESTEP for c in microscopic["velocities"]
    )
    impulses, binary = (np.concatenate(microscopic[name]) for name in ("impulses", "binary"))
    steps = len(microscopic["impulses"])
    return Tally(
        duration=np.float64(steps * TIMESTEP),
        steps=np.float64(steps),
        impulse=impulses.sum(),
        binary_impulse=binary.sum(),
        contact_moment=moment("impulses"),
        binary_moment=moment("binary"),
        binary_speed_moment=0.4 * moment("binary"),
        cluster_moment=0.3 * moment("impulses"),
        kinetic_moment=kinetic,
        local_kinetic=np.float64(0.7 * steps * TIMESTEP),
        wave_kinetic=np.float64(2.1 * steps * TIMESTEP),
        deep_contacts=np.float64(0),
        dissipation=np.float64(0.3),
        binary_dissipation=np.float64(0.2),
        complementarity=np.float64(0.02),
        energy_change=np.float64(-0.1),
        contacts=np.float64(len(impulses)),
        loaded_contacts=np.float64(np.sum(impulses > 0)),
        collisions=np.float64(np.sum(binary > 0)),
        solves=np.float64(4.0),
        iterations=np.float64(24.0),
        unconverged=np.float64(1.0),
        overlap=np.float64(6e-3),
        largest_overlap=np.float64(3e-3),
        worst_residual=np.float64(0.02),
        momentum_drift=np.float64(1e-15),
        status=np.int32(0),
    )


@pytest.fixture(scope="module")
def measured(tally) -> dict[str, np.ndarray]:
    values = averages(tally, np.float64(AREA), GRAINS, np.float64(SHEAR_RATE))
    return {name: np.asarray(value) for name, value in values.items()}


def stress_over_steps(microscopic, impulses: str) -> np.ndarray:
    """Σ^{ab} = (1/A) Σ σ^a F^b with F = J n / dt, averaged over the time steps."""
    stresses = []
    for p, branch in zip(microscopic[impulses], microscopic["branches"], strict=True):
        force = (p / TIMESTEP)[:, None] * branch / np.linalg.norm(branch, axis=1, keepdims=True)
        stresses.append(np.einsum("ca,cb->ab", branch, force) / AREA)
    return np.mean(stresses, axis=0)


def test_the_force_ratio_is_that_of_the_means_over_contacts(microscopic, measured) -> None:
    forces, binary = (
        np.concatenate(microscopic[name]) / TIMESTEP for name in ("impulses", "binary")
    )
    assert measured["force_ratio"] == pytest.approx(forces.mean() / binary.mean())


def test_stresses_are_time_averages_over_the_cell(microscopic, measured) -> None:
    contact, binary = (stress_over_steps(microscopic, name) for name in ("impulses", "binary"))
    masses = microscopic["masses"][0]
    kinetic = np.mean(
        [(masses[:, None] * c).T @ c / AREA for c in microscopic["velocities"]], axis=0
    )
    for name, stress in (("contact", contact), ("binary", binary), ("kinetic", kinetic)):
        np.testing.assert_allclose(measured[f"{name}_stress"], stress, rtol=1e-12)
    total = contact + kinetic
    assert measured["pressure"] == pytest.approx(np.trace(total) / 2)
    assert measured["shear_stress"] == pytest.approx(-total[0, 1])
    assert measured["macroscopic_friction"] == pytest.approx(-total[0, 1] / (np.trace(total) / 2))
    assert measured["inertial_number"] == pytest.approx(SHEAR_RATE / np.sqrt(np.trace(total) / 2))
    np.testing.assert_allclose(measured["stress_ratio"], contact / binary, rtol=1e-12)


def test_share_of_clusters_is_theirs_of_the_contact_stress(measured) -> None:
    assert measured["cluster_pressure_share"] == pytest.approx(0.3)
    assert measured["cluster_shear_share"] == pytest.approx(0.3)


def test_temperature_is_kinetic_energy_over_2n(microscopic, measured) -> None:
    masses = microscopic["masses"][0]
    energies = [np.sum(masses[:, None] * c**2) / (2 * GRAINS) for c in microscopic["velocities"]]
    assert measured["granular_temperature"] == pytest.approx(np.mean(energies))


def test_energy_of_the_longest_waves_is_a_share_of_equipartition(microscopic, measured) -> None:
    """2.1 in each step, as a temperature."""
    masses = microscopic["masses"][0]
    energies = [np.sum(masses[:, None] * c**2) / (2 * GRAINS) for c in microscopic["velocities"]]
    assert measured["longwave_energy_ratio"] == pytest.approx(2.1 / np.mean(energies))


def test_counts_are_per_grain_and_step(microscopic, measured, tally) -> None:
    impulses, binary = microscopic["impulses"], microscopic["binary"]
    assert measured["coordination_number"] == pytest.approx(
        np.mean([2 * np.sum(p > 0) / GRAINS for p in impulses])
    )
    strain = SHEAR_RATE * TIMESTEP * len(impulses)
    assert measured["collision_rate"] == pytest.approx(
        2 * np.sum(np.concatenate(binary) > 0) / GRAINS / strain
    )
    assert measured["iterations"] == 6.0
    assert measured["unconverged_share"] == 0.25
    assert measured["mean_overlap"] == pytest.approx(6e-3 / sum(len(p) for p in impulses))
    assert measured["max_overlap"] == tally.largest_overlap
    assert measured["worst_residual"] == tally.worst_residual
    assert measured["momentum_drift"] == tally.momentum_drift


def test_dissipation_rates_are_per_area_and_time(tally, measured) -> None:
    assert measured["dissipation_rate"] == pytest.approx(0.3 / AREA / tally.duration)
    assert measured["binary_dissipation_rate"] == pytest.approx(0.2 / AREA / tally.duration)


def test_powers_are_shares_of_the_shear_work(tally, measured) -> None:
    work = -SHEAR_RATE * (tally.contact_moment + tally.kinetic_moment)[0, 1]
    assert measured["energy_balance_error"] == pytest.approx((work - 0.3 + 0.1) / abs(work))
    assert measured["complementarity_power"] == pytest.approx(0.02 / abs(work))


def test_leading_axes_are_kept() -> None:
    tally = random_tally(np.random.default_rng(1), 3, 4)
    values = averages(tally, np.full((3, 4), AREA), GRAINS, np.full((3, 4), SHEAR_RATE))
    for name, value in values.items():
        assert value.shape == (3, 4, *OBSERVABLES[name].tensor * (2, 2)), name


def test_quotient_of_nothing_is_nan_without_a_warning() -> None:
    values = averages(
        empty_tally(np.dtype(float)), np.float64(AREA), GRAINS, np.float64(SHEAR_RATE)
    )
    for name in (
        "force_ratio",
        "iterations",
        "mean_overlap",
        "stress_ratio",
        "cluster_pressure_share",
    ):
        assert np.isnan(values[name]).all(), name


def test_every_observable_is_measured_with_a_unit(measured) -> None:
    assert set(measured) == set(OBSERVABLES)
    for name, observable in OBSERVABLES.items():
        assert observable.meaning and observable.unit
        assert measured[name].shape == observable.tensor * (2, 2)
