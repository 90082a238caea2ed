"""Kinetic theory with anisotropic Gaussian velocities, for any size distribution.

Each size class has its own temperature tensor, in which collisions balance the work of the shear at
any restitution and beyond linear order in the shear rate. The theory neglects correlations between
the velocities of neighbours, so it fails near jamming and in dense flow at small restitution.
Units: ``steady_shear``.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.theory.enskog import enskog_collisions
from jaxgran.theory.mixture import Mixture, mixture_of, uniform_mixture
from jaxgran.theory.navier_stokes import garzo_dufty
from jaxgran.theory.steady_shear import Scalar, SteadyShear, as_floats, of_one_flow

_MAX_ITERATIONS = 40  # of Newton's method, which needs 4 to 7
_LARGEST_STEP = 1.0  # of one Newton iteration, in the logarithm of a temperature


@of_one_flow
@partial(jax.jit, static_argnames="size_classes")
def gaussian_moments(
    restitution: Scalar,
    packing_fraction: Scalar,
    shear_rate: Scalar = 1.0,
    polydispersity: Scalar = 0.26,
    size_classes: int = 4,
) -> SteadyShear:
    """Steady shear of polydisperse discs with Gaussian velocities and a temperature tensor for each
    size class.

    ================  ====  =======================================================
    name              unit  meaning
    ================  ====  =======================================================
    restitution       –     0 ≤ α < 1
    packing_fraction  –     0 < ν < 1
    shear_rate        1/t   γ̇ > 0
    polydispersity    σ     0 ≤ Δ < 1: diameters uniform in σ ± Δ
    size_classes      –     number of Gauss-Legendre points of the size
                            distribution; static, a change recompiles
    returns                 SteadyShear; not finite at α = 1, where nothing
                            balances the work of the shear
    ================  ====  =======================================================

    In each class the second moments balance: −γ̇(δ_ax T_yb + δ_bx T_ay) + Q_ab = 0, with Q Enskog's
    collision integral including the shear across the contact. It is solved by Newton's method and
    differentiated implicitly.

    Source: J. T. Jenkins and M. W. Richman, J. Fluid Mech. 192, 313 (1988); J. F. Lutsko, Phys.
    Rev. E 70, 061101 (2004). Contact values of the mixture: J. T. Jenkins and F. Mancini, J. Appl.
    Mech. 54, 27 (1987).
    """
    alpha, nu, rate, width = as_floats(restitution, packing_fraction, shear_rate, polydispersity)
    return steady_moments(
        alpha,
        rate,
        uniform_mixture(nu, width, size_classes),
        jnp.log(garzo_dufty(alpha, nu).granular_temperature),
    )


@jax.jit
def mixture_moments(
    restitution: Scalar,
    packing_fraction: Scalar,
    shear_rate: Scalar,
    diameters: Float[Array, " classes"],
    masses: Float[Array, " classes"],
    fractions: Float[Array, " classes"],
) -> SteadyShear:
    """``gaussian_moments`` of a mixture of classes of grains.

    ================  =======  ====================================================
    name              unit     meaning
    ================  =======  ====================================================
    restitution       –        0 ≤ α < 1
    packing_fraction  –        0 < ν < 1
    shear_rate        1/t      γ̇ > 0
    diameters         σ        (classes,), of mean one
    masses            m        (classes,)
    fractions         –        (classes,), number fractions
    returns                    SteadyShear
    ================  =======  ====================================================
    """
    alpha, nu, rate = as_floats(restitution, packing_fraction, shear_rate)
    guess = jnp.log(garzo_dufty(alpha, nu).granular_temperature * masses)
    return steady_moments(alpha, rate, mixture_of(nu, diameters, masses, fractions), guess)


def steady_moments(
    alpha: Float[Array, ""],
    rate: Float[Array, ""],
    mixture: Mixture,
    guess: Float[Array, "*classes"],
    length: Float[Array, ""] | float = 1.0,
) -> SteadyShear:
    """Solve the balance of the moments of a mixture, from a guess of the logarithms of the
    temperatures of its classes, or of one for all.

    Collisions lose 1/length of the energy that they lose in Enskog's theory.
    """
    unit_rate = jnp.ones_like(rate)  # there is no other time scale, so T and stresses scale as γ̇²

    def imbalance(unknowns):
        """Rate of change of each temperature tensor, relative to its trace."""
        tensors = _temperatures(unknowns)
        (xx, xy), (_, yy) = tensors
        shear = jnp.stack([2 * xy, jnp.zeros_like(yy), yy])
        source = enskog_collisions(tensors, alpha, unit_rate, mixture, length).source
        return (source[[0, 1, 0], [0, 1, 1]] - shear) / (xx + yy)[None, :]

    of_class = jnp.broadcast_to(guess, mixture.diameters.shape)
    start = jnp.stack([of_class, of_class, jnp.full_like(of_class, -0.3)])
    solution = jax.lax.custom_root(imbalance, start, _newton, _dense_solve)

    tensors = _temperatures(solution)
    collisions = enskog_collisions(tensors, alpha, unit_rate, mixture, length)
    densities = mixture.number_densities
    kinetic = jnp.sum(densities * jnp.trace(tensors)) / 2
    stress = jnp.sum(densities[None, None, :] * tensors, axis=-1) + collisions.stress
    return SteadyShear(
        granular_temperature=kinetic / jnp.sum(densities) * rate**2,
        pressure=jnp.trace(stress) / 2 * rate**2,
        shear_stress=-stress[0, 1] * rate**2,
        collision_rate=collisions.collision_rate,
        dissipation_rate=collisions.dissipation_rate * rate**3,
    )


def _temperatures(unknowns: Float[Array, "3 classes"]) -> Float[Array, "2 2 classes"]:
    """Temperature tensors, positive definite for any unknowns.

    The unknowns are ln T_xx, ln T_yy and artanh(T_xy/√(T_xx T_yy)).
    """
    log_xx, log_yy, artanh_xy = unknowns
    xx, yy = jnp.exp(log_xx), jnp.exp(log_yy)
    xy = jnp.exp((log_xx + log_yy) / 2) * jnp.tanh(artanh_xy)
    return jnp.array([[xx, xy], [xy, yy]])


def _newton(function, start):
    """Root of `function` by Newton's method with a bounded step.

    It stops after the first step below the square root of machine epsilon, as convergence is
    quadratic. The root is NaN if no step is below it.
    """
    tolerance = jnp.finfo(start.dtype).eps ** 0.5

    def unfinished(carry):
        _, step_size, iteration = carry
        return (step_size > tolerance) & (iteration < _MAX_ITERATIONS)

    def iterate(carry):
        unknowns, _, iteration = carry
        value, derivative = jax.linearize(function, unknowns)
        step = _dense_solve(derivative, value)
        step_size = jnp.max(jnp.abs(step))
        return unknowns - step * jnp.minimum(1, _LARGEST_STEP / step_size), step_size, iteration + 1

    infinity = jnp.full((), jnp.inf, start.dtype)
    unknowns, step_size, _ = jax.lax.while_loop(unfinished, iterate, (start, infinity, 0))
    return jnp.where(step_size <= tolerance, unknowns, jnp.nan)


def _dense_solve(linear, side):
    """Solve ``linear(x) = side`` for a dozen unknowns, by the inverse of the matrix.

    It is found by Gauss-Jordan elimination with partial pivoting: ``persistent_jit`` does not keep
    programs that call LAPACK, as ``jnp.linalg`` does.
    """
    size = side.size
    places = jnp.arange(size)

    def eliminate(k: Array, rows: Array) -> Array:
        best = jnp.argmax(jnp.where(places < k, -1, jnp.abs(rows[:, k])))
        pivot = (rows[best] / rows[best, k])[None, :]
        swapped = rows.at[best].set(rows[k])
        return jnp.where((places == k)[:, None], pivot, swapped - swapped[:, k, None] * pivot)

    matrix = jax.jacobian(linear)(side).reshape(size, size)
    start = jnp.concatenate([matrix, jnp.eye(size, dtype=side.dtype)], axis=1)
    inverse = jax.lax.fori_loop(0, size, eliminate, start)[:, size:]
    return jnp.sum(inverse * side.reshape(1, size), axis=1).reshape(side.shape)
