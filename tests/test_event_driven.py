"""The event-driven reference obeys conservation laws, Enskog's rate and its own collision."""

import numpy as np
import pytest
from oracles import gaps_of

from benchmarks.independent.event_driven import Discs, Law, averages, sheared

ROUNDING = 1e-12


def lattice(
    across: int, packing_fraction: float, polydispersity: float = 0.26, seed: int = 0
) -> Discs:
    """Discs on a square lattice, with random velocities of temperature one, without momentum."""
    rng, count = np.random.default_rng(seed), across**2
    diameters = rng.permutation(1 + polydispersity * (2 * (np.arange(count) + 0.5) / count - 1))
    side = np.sqrt(np.pi / 4 * np.sum(diameters**2) / packing_fraction)
    places = (np.stack(np.divmod(np.arange(count), across), axis=-1) + 0.5) * side / across
    masses = diameters**2
    velocities = rng.normal(size=(count, 2)) / np.sqrt(masses)[:, None]
    velocities -= masses @ velocities / np.sum(masses)
    velocities *= np.sqrt(2 * count / np.sum(masses[:, None] * velocities**2))
    return Discs(diameters / 2, masses, places, velocities, np.full(count, -np.inf), side, 0.0)


def energy(discs: Discs) -> float:
    return float(np.sum(discs.masses[:, None] * discs.velocities**2) / 2)


@pytest.fixture(scope="module")
def flow() -> tuple[Discs, Discs, dict, Law]:
    """Discs before and after a strain of two with a duration of contact, and the sums over it."""
    law, before = Law(0.3, 1e-3), lattice(10, 0.5)
    return before, *sheared(before, law, 2.0), law


def test_momentum_is_kept_and_no_discs_overlap(flow) -> None:
    before, after, sums, _ = flow
    assert sums["collisions"] > 500
    np.testing.assert_allclose(after.masses @ after.velocities, 0, atol=1e-9)
    gaps = gaps_of(after.positions, after.radii, after.side, after.tilt)
    assert np.min(gaps) > -ROUNDING
    assert np.max(np.abs(after.positions - before.positions)) > 1


def test_power_of_the_shear_is_dissipated_or_heats_the_discs(flow) -> None:
    before, after, sums, law = flow
    work = averages(sums, after)["shear_stress"] * law.shear_rate * sums["duration"] * after.side**2
    assert work > 10
    np.testing.assert_allclose(
        work, sums["dissipation"] + energy(after) - energy(before), rtol=1e-10
    )


@pytest.mark.parametrize("move", [(0.0, 3.7), (1.3, -12.1)])
def test_flow_is_the_same_everywhere(move) -> None:
    """Moved by any vector, also through the boundary, discs collide at the same times."""
    law, before = Law(0.5, 1e-3), lattice(10, 0.5, seed=1)
    _, sums = sheared(before, law, 0.4, blocks=2)
    _, moved = sheared(before._replace(positions=before.positions + move), law, 0.4, blocks=2)
    for name, values in sums.items():
        np.testing.assert_allclose(moved[name], values, rtol=1e-6, atol=1e-6, err_msg=name)


def test_elastic_gas_has_the_rate_and_pressure_of_enskog() -> None:
    """ω = 2 n σ χ √(πT/m), p = nT (1 + 2νχ), with Henderson's χ, exact to 0.3 % here."""
    fraction, count = 0.3, 400
    gas, _ = sheared(lattice(20, fraction, polydispersity=0.0), Law(1.0, shear_rate=0.0), 10.0)
    gas, sums = sheared(gas, Law(1.0, shear_rate=0.0), 80.0, blocks=16)
    values = averages(sums, gas)
    np.testing.assert_allclose(values["granular_temperature"], 1, rtol=1e-9)
    chi, density = (1 - 7 * fraction / 16) / (1 - fraction) ** 2, 4 * fraction / np.pi
    rate = 2 * density * chi * np.sqrt(np.pi)
    rate *= np.sqrt(count / (count - 1))  # without total momentum
    pressure = density * (1 + 2 * fraction * chi)
    for name, value in {"collision_rate": rate, "pressure": pressure}.items():
        error = values[name].std(ddof=1) / np.sqrt(len(values[name]))
        assert error < 0.01 * value
        assert abs(values[name].mean() - value) < 4 * error + 0.003 * value
