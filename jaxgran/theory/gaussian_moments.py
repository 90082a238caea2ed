"""Kinetic theory with anisotropic Gaussian velocities, for any size distribution.

Each size class has its own temperature tensor, in which collisions balance the work of the shear at
any restitution and beyond linear order in the shear rate. The theory neglects correlations between
the velocities of neighbours, so it fails near jamming and in dense flow at small restitution.
Units: ``steady_shear``.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.theory.mixture import ANGLES, Mixture, half_range_moments, mixture_of, uniform_mixture
from jaxgran.theory.navier_stokes import garzo_dufty
from jaxgran.theory.steady_shear import Scalar, SteadyShear, as_floats

_MAX_ITERATIONS = 40  # of Newton's method, which needs 4 to 7
_LARGEST_STEP = 1.0  # of one Newton iteration, in the logarithm of a temperature


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
      Rev. E 70, 061101 (2004). Contact values of the mixture: J. T. Jenkins and F. Mancini, J.
      Appl. Mech. 54, 27 (1987).
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
) -> SteadyShear:
    """``gaussian_moments`` of a mixture with the same number of grains in each class of diameter
    and mass.

    ================  =======  ====================================================
    name              unit     meaning
    ================  =======  ====================================================
    restitution       –        0 ≤ α < 1
    packing_fraction  –        0 < ν < 1
    shear_rate        1/t      γ̇ > 0
    diameters         σ        (classes,), of mean one
    masses            m        (classes,)
    returns                    SteadyShear
    ================  =======  ====================================================
    """
    alpha, nu, rate = as_floats(restitution, packing_fraction, shear_rate)
    fractions = jnp.full(diameters.shape, 1 / diameters.size, nu.dtype)
    guess = jnp.log(garzo_dufty(alpha, nu).granular_temperature * jnp.mean(masses))
    return steady_moments(alpha, rate, mixture_of(nu, diameters, masses, fractions), guess)


def steady_moments(
    alpha: Float[Array, ""],
    rate: Float[Array, ""],
    mixture: Mixture,
    guess: Float[Array, ""],
    length: Float[Array, ""] | float = 1.0,
) -> SteadyShear:
    """Solve the balance of the moments of a mixture, from a guess of the logarithm of its
    temperature.

    Collisions lose 1/length of the energy that they lose in Enskog's theory.
    """

    def imbalance(unknowns):
        temperatures = _temperatures(unknowns)
        return _moment_balance(temperatures, _collisions(temperatures, alpha, mixture, length))

    start = (
        jnp.stack([guess, guess, -0.3 * jnp.ones_like(guess)])[:, None]
        * jnp.ones_like(mixture.diameters)[None, :]
    )
    solution = jax.lax.custom_root(imbalance, start, _newton, _dense_linear_solve)

    # Solved at unit shear rate: there is no other time scale, so temperatures and stresses scale as
    # γ̇²
    temperatures = _temperatures(solution)
    collisions = _collisions(temperatures, alpha, mixture, length)
    xx, yy, xy = (
        jnp.sum(mixture.number_densities[None, :] * temperatures, axis=1) + collisions.stress
    )
    kinetic = jnp.sum(mixture.number_densities * (temperatures[0] + temperatures[1])) / 2
    return SteadyShear(
        granular_temperature=kinetic / jnp.sum(mixture.number_densities) * rate**2,
        pressure=(xx + yy) / 2 * rate**2,
        shear_stress=-xy * rate**2,
        collision_rate=collisions.rate,
        dissipation_rate=collisions.dissipation * rate**3,
    )


class _Collisions(NamedTuple):
    """Effects of collisions at unit shear rate; components in the order xx, yy, xy."""

    source: Float[Array, "3 classes"]  # rate of change of the temperature tensor of a class
    stress: Float[Array, "3"]  # collisional
    dissipation: Float[Array, ""]  # energy lost per unit area and time
    rate: Float[Array, ""]  # collisions per grain and unit strain


def _collisions(
    temperatures: Float[Array, "3 classes"],
    alpha: Float[Array, ""],
    mixture: Mixture,
    length: Float[Array, ""] | float = 1.0,
) -> _Collisions:
    """Enskog collision integrals of Gaussian velocities.

    Let n be the normal from grain i to grain j. The approach speed w = (v_i − v_j)·n is Gaussian,
    with mean −γ̇ d_ij n_x n_y and variance n·(T_i/m_i + T_j/m_j)·n. A collision adds −J n/m_i to
    v_i, J = (1+α) μ_ij w, so the temperature tensor of class i changes at the rate Σ_j n_j χ_ij
    d_ij ∮ dn ⟨w [J² n n/m_i − J (n c_i + c_i n)]⟩. The average is over w > 0, where ⟨w² c_i⟩ = 2⟨w⟩
    T_i·n/m_i, because c_i and w are jointly Gaussian. Of the energy (1 − α²) μ_ij w²/2 that a
    collision loses, the part 1 − 1/length is given back: to grain i the share μ_ij/m_i, to both
    directions alike.
    """
    angle = (jnp.arange(ANGLES, dtype=temperatures.dtype) + 0.5) * (jnp.pi / ANGLES)
    nx, ny = jnp.cos(angle)[None, :], jnp.sin(angle)[None, :]
    normals = jnp.stack([nx * nx, ny * ny, nx * ny])  # (3, 1, angles)
    arc = 2 * jnp.pi / ANGLES  # both halves of the circle contribute equally

    txx, tyy, txy = temperatures[:, :, None]
    push_x, push_y = txx * nx + txy * ny, txy * nx + tyy * ny  # T·n, (classes, angles)
    spread = (push_x * nx + push_y * ny) / mixture.masses[:, None]
    first, second, third = half_range_moments(
        -mixture.contact_diameters[:, :, None] * (nx * ny)[None, :, :],
        jnp.sqrt(spread[:, None, :] + spread[None, :, :]),
    )  # each (classes, classes, angles)

    impulse = (1 + alpha) * mixture.reduced_masses
    loss = arc * jnp.sum((mixture.encounters * impulse)[:, :, None] * first, axis=1)
    gain = arc * jnp.sum((mixture.encounters * impulse**2)[:, :, None] * third, axis=1)
    drag = jnp.stack([2 * nx * push_x, 2 * ny * push_y, nx * push_y + ny * push_x])
    kept = (1 - 1 / length) * (1 - alpha) / (1 + alpha) * jnp.sum(gain, axis=1)
    isotropic = jnp.array([0.5, 0.5, 0.0], kept.dtype)[:, None]
    source = (
        jnp.sum(gain[None] * normals - 2 * loss[None] * drag, axis=2) + isotropic * kept[None, :]
    )
    source = source / mixture.masses[None, :]

    per_area = mixture.number_densities[:, None] * mixture.encounters * arc
    transfer = per_area / 2 * impulse * mixture.contact_diameters  # half: each pair is summed twice
    lost = per_area / 4 * (1 - alpha**2) * mixture.reduced_masses
    per_grain = per_area / jnp.sum(mixture.number_densities)
    return _Collisions(
        source=source,
        stress=jnp.sum(
            normals * jnp.sum(transfer[:, :, None] * second, axis=(0, 1))[None, None, :],
            axis=(1, 2),
        ),
        dissipation=jnp.sum(lost[:, :, None] * third) / length,
        rate=jnp.sum(per_grain[:, :, None] * first),
    )


def _moment_balance(
    temperatures: Float[Array, "3 classes"], collisions: _Collisions
) -> Float[Array, "3 classes"]:
    """Rate of change of each temperature tensor at unit shear rate, relative to its trace."""
    txx, tyy, txy = temperatures
    shear = jnp.stack([2 * txy, jnp.zeros_like(tyy), tyy])
    return (collisions.source - shear) / (txx + tyy)[None, :]


def _temperatures(unknowns: Float[Array, "3 classes"]) -> Float[Array, "3 classes"]:
    """Temperature tensors (xx, yy, xy), positive definite for any unknowns.

    The unknowns are ln T_xx, ln T_yy and artanh(T_xy/√(T_xx T_yy)).
    """
    log_xx, log_yy, artanh_xy = unknowns
    return jnp.stack(
        [jnp.exp(log_xx), jnp.exp(log_yy), jnp.exp((log_xx + log_yy) / 2) * jnp.tanh(artanh_xy)]
    )


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
        step = _dense_linear_solve(derivative, value)
        step_size = jnp.max(jnp.abs(step))
        return unknowns - step * jnp.minimum(1, _LARGEST_STEP / step_size), step_size, iteration + 1

    infinity = jnp.full((), jnp.inf, start.dtype)
    unknowns, step_size, _ = jax.lax.while_loop(unfinished, iterate, (start, infinity, 0))
    return jnp.where(step_size <= tolerance, unknowns, jnp.nan)


def _dense_linear_solve(linear, target):
    """Solve `linear(x) = target` by forming the matrix, which has at most a few dozen columns."""
    columns = jax.vmap(linear)(jnp.eye(target.size, dtype=target.dtype).reshape(-1, *target.shape))
    matrix = columns.reshape(target.size, target.size).T
    solution = jax.lax.custom_linear_solve(
        partial(jnp.matmul, matrix),
        target.reshape(-1),
        lambda _, side: _eliminated(matrix, side),
        lambda _, side: _eliminated(matrix.T, side),
    )
    return solution.reshape(target.shape)


def _eliminated(matrix: Float[Array, "n n"], side: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution of a linear system by Gauss-Jordan elimination with partial pivoting.

    For a dozen unknowns; LAPACK would be loaded from SciPy, which takes half a second.
    """
    places = jnp.arange(side.size)

    def eliminate(k: Array, rows: Array) -> Array:
        best = jnp.argmax(jnp.where(places < k, -1, jnp.abs(rows[:, k])))
        pivot = (rows[best] / rows[best, k])[None, :]
        rows = rows.at[best].set(rows[k])
        return jnp.where((places == k)[:, None], pivot, rows - rows[:, k, None] * pivot)

    return jax.lax.fori_loop(
        0, side.size, eliminate, jnp.concatenate([matrix, side[:, None]], axis=1)
    )[:, -1]
