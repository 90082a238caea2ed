"""Kinetic theory: published and tabulated values, limits, balances and derivatives."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.theory.enskog import collisional_transfer, enskog_collisions
from jaxgran.theory.gaussian_moments import gaussian_moments
from jaxgran.theory.mixture import uniform_mixture
from jaxgran.theory.navier_stokes import garzo_dufty
from jaxgran.theory.steady_shear import SteadyShear, contact_value

PLANE = [
    axis.ravel()
    for axis in np.meshgrid(np.append(np.arange(0, 1, 0.1), 0.99), [0.01, 0.1, 0.3, 0.5, 0.7, 0.83])
]


def moments(restitution, packing_fraction, shear_rate=1.0, polydispersity=0.26) -> SteadyShear:
    """Passes all arguments always, so that the tests share one compilation."""
    return gaussian_moments(restitution, packing_fraction, shear_rate, polydispersity)


THEORIES = [garzo_dufty, moments]


@cache
def batched(theory):
    return jax.jit(jax.vmap(theory))


def numbers(shear: SteadyShear) -> np.ndarray:
    return np.array(jax.tree.leaves(shear))


def temperature_and_stresses(shear: SteadyShear) -> np.ndarray:
    return np.array([shear.granular_temperature, shear.pressure, shear.shear_stress])


@pytest.mark.parametrize(
    ("theory", "restitution", "packing_fraction", "expected"),
    [
        (garzo_dufty, 0.9, 0.4, (3.35, 4.68, 1.22)),
        (garzo_dufty, 0.5, 0.6, (0.3345, 1.32, 0.703)),
        (moments, 0.9, 0.4, (3.09, 4.30, 1.14)),
        (moments, 0.5, 0.6, (0.238, 1.20, 0.676)),
    ],
)
def test_temperature_and_stresses_agree_with_an_independent_solution(
    theory, restitution, packing_fraction, expected
):
    predicted = temperature_and_stresses(theory(restitution, packing_fraction))
    half_a_digit = [
        0.5 * 10.0 ** -len(str(value).split(".")[1].ljust(2, "0")) for value in expected
    ]
    assert np.all(np.abs(predicted - expected) <= half_a_digit)


# Event-driven hard discs, diameters uniform in 1 ± 0.26: packing fraction, restitution, pressure,
# collision rate
@pytest.mark.parametrize(
    ("packing_fraction", "restitution", "pressure", "collision_rate"),
    [(0.2, 0.9, 4.185, 4.27), (0.6, 0.9, 9.814, 18.2)],
)
def test_moments_come_close_to_event_driven_discs(
    packing_fraction, restitution, pressure, collision_rate
):
    predicted = moments(restitution, packing_fraction)
    np.testing.assert_allclose(predicted.pressure, pressure, rtol=0.06)
    np.testing.assert_allclose(predicted.collision_rate, collision_rate, rtol=0.06)


@pytest.mark.parametrize("restitution", [0.3, 0.5, 0.9])
def test_collisions_are_those_of_the_velocities_in_the_source(restitution):
    """The mean relative speed of a Maxwellian with a Sonine term, to first order in a₂."""
    nodes, weights = np.polynomial.hermite.hermgauss(16)
    c = np.stack(np.meshgrid(*[nodes] * 4, indexing="ij"))
    weight = np.prod(np.meshgrid(*[weights] * 4, indexing="ij"), axis=0)
    squared = c[0] ** 2 + c[1] ** 2
    speed = np.hypot(c[0] - c[2], c[1] - c[3])
    change = (
        2 * np.sum(weight * (squared**2 / 2 - 2 * squared + 1) * speed) / np.sum(weight * speed)
    )
    alpha, nu = restitution, 0.4
    kurtosis = (
        16 * (1 - alpha) * (1 - 2 * alpha**2) / (57 - 25 * alpha + 30 * alpha**2 * (1 - alpha))
    )
    predicted = garzo_dufty(alpha, nu)
    speed = np.sqrt(np.pi * predicted.granular_temperature)
    maxwellian = 2 * speed * 4 * nu / np.pi * contact_value(nu)
    excess = float(predicted.collision_rate / maxwellian) - 1
    assert abs(excess) > 1e-4
    # of the quadrature, whose integrand has a cusp
    assert excess == pytest.approx(change * kurtosis, rel=0.1)


@pytest.mark.parametrize("theory", THEORIES)
def test_every_number_is_finite_and_positive_over_the_plane(theory):
    predicted = numbers(batched(theory)(*PLANE))
    assert np.all(np.isfinite(predicted))
    assert np.all(predicted > 0)


@pytest.mark.parametrize("theory", THEORIES)
def test_shear_power_equals_dissipation(theory):
    predicted = batched(theory)(*PLANE)
    np.testing.assert_allclose(predicted.shear_stress, predicted.dissipation_rate, rtol=1e-12)


@pytest.mark.parametrize("theory", THEORIES)
def test_stresses_grow_with_the_square_of_the_shear_rate(theory):
    slow, fast = theory(0.8, 0.5, 1.0), theory(0.8, 0.5, 3.0)
    np.testing.assert_allclose(
        temperature_and_stresses(fast), 9 * temperature_and_stresses(slow), rtol=1e-12
    )
    np.testing.assert_allclose(fast.collision_rate, slow.collision_rate, rtol=1e-12)
    np.testing.assert_allclose(fast.dissipation_rate, fast.shear_stress * 3.0, rtol=1e-12)


@pytest.mark.parametrize("packing_fraction", [0.05, 0.4, 0.8])
def test_theories_of_one_size_agree_in_the_elastic_limit(packing_fraction):
    def distance(restitution):
        predicted = moments(restitution, packing_fraction, 1.0, 0.0)
        return np.abs(
            numbers(predicted) / numbers(garzo_dufty(restitution, packing_fraction)) - 1
        ).max()

    assert distance(1 - 1e-4) < 1e-3
    # first order in 1 − α
    np.testing.assert_allclose(distance(1 - 1e-4) / distance(1 - 1e-3), 0.1, rtol=0.05)


def test_velocities_become_isotropic_in_the_elastic_limit():
    nearly, more_nearly = (moments(alpha, 0.4) for alpha in (0.9999, 0.999999))
    friction = (
        nearly.shear_stress / nearly.pressure,
        more_nearly.shear_stress / more_nearly.pressure,
    )
    # as the square root of 1 − α
    np.testing.assert_allclose(friction[1] / friction[0], 0.1, rtol=0.01)


def test_one_size_is_the_limit_of_many():
    one_size = gaussian_moments(0.7, 0.5, polydispersity=0.0, size_classes=1)
    np.testing.assert_allclose(
        numbers(moments(0.7, 0.5, polydispersity=0.0)), numbers(one_size), rtol=1e-12
    )


def test_contact_value_starts_from_the_second_virial_coefficient():
    assert contact_value(0.0) == 1
    np.testing.assert_allclose(jax.grad(contact_value)(0.0), 25 / 16)


def test_enskogs_dissipation_vanishes_in_the_elastic_limit_as_one_minus_the_squared_restitution():
    losses = [
        collisional_transfer(jnp.eye(2), alpha, 0.5).dissipation_rate for alpha in (1.0, 0.9, 0.0)
    ]
    np.testing.assert_allclose(losses, [0, 0.19 * losses[2], losses[2]], rtol=1e-12)


def test_collisional_transfer_of_slow_shear_has_the_viscosity_of_isotropic_collisions():
    """Half of γ_b = (8/π) ν² χ (1 + α) in √(T/4π), V. Garzó and J. W. Dufty (1999)."""
    alpha, nu, rate, temperature = 0.8, 0.5, 1e-4, 2.0
    transfer = collisional_transfer(temperature * jnp.eye(2), alpha, nu, rate, 0.0)
    bulk = 8 / np.pi * nu**2 * float(contact_value(nu)) * (1 + alpha)
    np.testing.assert_allclose(
        -transfer.stress[0, 1] / rate, bulk / 2 * np.sqrt(temperature / (4 * np.pi)), rtol=1e-6
    )
    # ⟨w³⟩ / ⟨w²⟩ of a half-Gaussian of variance 2T
    speed = transfer.speed_stress[0, 0] / transfer.stress[0, 0]
    np.testing.assert_allclose(speed, 2 * np.sqrt(2 / np.pi) * np.sqrt(2 * temperature), rtol=1e-6)


def test_collision_integrals_equal_averages_over_sampled_collisions():
    """Of random pairs that follow the rule of collision, within five standard errors."""
    alpha, nu, samples = 0.6, 0.5, 100_000
    mixture = jax.tree.map(np.asarray, uniform_mixture(jnp.asarray(nu), jnp.asarray(0.26), 2))
    xx, yy, xy = np.array([[0.5, 0.7], [0.3, 0.4], [-0.1, -0.15]])  # of the two classes
    tensors = np.array([[xx, xy], [xy, yy]])
    predicted = jax.jit(enskog_collisions)(
        jnp.asarray(tensors), jnp.asarray(alpha), jnp.asarray(1.0), mixture
    )
    masses, densities = mixture.masses, mixture.number_densities
    rng = np.random.default_rng(7)

    names = "stress", "speed_stress", "dissipation_rate", "collision_rate"
    totals = {name: [] for name in ("source", *names)}
    for i in range(2):
        source = 0
        for j in range(2):
            distance = mixture.contact_diameters[i, j]
            angle = rng.uniform(0, 2 * np.pi, samples)
            normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            own, other = (
                rng.multivariate_normal([0, 0], tensors[:, :, k], samples) / np.sqrt(masses[k])
                for k in (i, j)
            )
            relative = own - other
            # the flow at the partner's centre, shear rate 1
            relative[:, 0] -= distance * normal[:, 1]
            approach = np.maximum(np.sum(relative * normal, axis=1), 0)
            weight = 2 * np.pi * mixture.encounters[i, j] * approach
            impulse = (1 + alpha) * mixture.reduced_masses[i, j] * approach
            after = own - (impulse / masses[i])[:, None] * normal
            change = masses[i] * (products(after) - products(own))
            lost = (1 - alpha**2) / 2 * mixture.reduced_masses[i, j] * approach**2
            source = source + weight[:, None, None] * change
            pair = densities[i] / 2 * weight
            moment = (pair * impulse * distance)[:, None, None] * products(normal)
            totals["stress"].append(moment)
            totals["speed_stress"].append(approach[:, None, None] * moment)
            totals["dissipation_rate"].append(pair * lost)
            totals["collision_rate"].append(2 * pair / densities.sum())
        totals["source"].append(source)

    for name in names:
        assert_mean(sum(totals[name]), getattr(predicted, name))
    for i in range(2):
        assert_mean(totals["source"][i], predicted.source[:, :, i])


def products(vectors):
    return vectors[:, :, None] * vectors[:, None, :]


def assert_mean(sample, expected):
    error = np.std(sample, axis=0) / np.sqrt(len(sample))
    assert np.all(np.abs(np.mean(sample, axis=0) - expected) < 5 * error)


# moderate, and far from elastic in dense flow: restitution, packing fraction, shear rate,
# polydispersity
@pytest.mark.parametrize("point", [(0.8, 0.5, 1.3, 0.26), (0.1, 0.78, 1.0, 0.2)])
def test_derivatives_of_the_moments_equal_finite_differences(point):
    def central_difference(direction):
        ahead, behind = (
            moments(*(np.array(point) + s * direction).tolist()) for s in (1e-5, -1e-5)
        )
        return (numbers(ahead) - numbers(behind)) / 2e-5

    expected = np.stack([central_difference(direction) for direction in np.eye(4)], axis=1)
    np.testing.assert_allclose(
        jacobian_of_moments(jnp.array(point)), expected, rtol=1e-6, atol=1e-7
    )


jacobian_of_moments = jax.jit(jax.jacrev(lambda point: jnp.stack(jax.tree.leaves(moments(*point)))))


def test_one_elastic_replica_leaves_the_others_alone():
    restitutions, packing_fractions = PLANE
    disturbed = np.where(np.arange(restitutions.size) == 5, 1.0, restitutions)
    before, after = (
        numbers(batched(moments)(alpha, packing_fractions)) for alpha in (restitutions, disturbed)
    )
    np.testing.assert_array_equal(np.delete(after, 5, axis=1), np.delete(before, 5, axis=1))


def test_moments_that_newtons_method_does_not_find_are_not_finite() -> None:
    """So close to one, rounding leaves no root: steps stay above the tolerance."""
    assert np.isnan(numbers(moments(1 - 1e-12, 0.5))).all()
    assert np.isfinite(numbers(moments(1 - 1e-6, 0.5))).all()
