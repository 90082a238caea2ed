"""The law of a contact: arithmetic of the contacts, the solver and the flights.

These functions take numbers or arrays and have no branches on values. The engine ``Jax`` calls them
with arrays of JAX; the numba engine compiles the source of those that it shares for numbers
(``dynamics.numba_engine.compilation``). What branches, such as the search for the next contact or a
solver, is written for each engine, and tests compare them.

The rule: a pair is a contact when free flight over the look-ahead time θ·dt makes it overlap. With
s the separation, u the relative velocity in the laboratory and d the sum of the radii, the gap
along the flight is f(t) = |s + u t|² − d² = |u|² t² + 2 s·u t + |s|² − d².
"""

from typing import Any, NamedTuple

from jax.numpy import ceil, maximum, sqrt, where

from jaxgran.model.status import DEEP_OVERLAP

Number = Any  # a number, or an array of them

# Longest step length of the method of Barzilai and Borwein, in units of that of Nesterov's
LONGEST_STRIDE = 1e4
WINDOW = 100  # iterations after which the progress of that method is judged
PROGRESS = 0.5  # factor by which the best residual must have fallen within a window
# JᵀWJ over −Jᵀu⁻: 1 at a solution, and 0 where impulses grow without moving anything
JAMMED_RESPONSE = 1e-2
ABSOLUTE_RESIDUAL = 10  # roundings of the velocity γ̇σ that a residual may always keep


def gap_coefficients(
    x: Number, y: Number, ux: Number, uy: Number, reach: Number
) -> tuple[Number, Number, Number]:
    """|u|², s·u and |s|² − d², the coefficients of the gap along a flight."""
    return ux * ux + uy * uy, x * ux + y * uy, x * x + y * y - reach * reach


def gap_discriminant(squared_speed: Number, closing: Number, excess: Number) -> Number:
    """Below zero where the pair never touches."""
    return closing * closing - squared_speed * excess


def touching_time(closing: Number, excess: Number, root: Number) -> Number:
    """Time at which an approaching pair touches, from the square root of the discriminant; no
    cancellation.
    """
    return excess / (root - closing)


def first_step(time: Number, timestep: Number, fraction: Number) -> Number:
    """The activation rule in steps: the first step whose look-ahead, a fraction θ of it, reaches a
    time.
    """
    return ceil(time / timestep - fraction)


def flight_of(cx: Number, cy: Number, strain: Number, flight: Number, shear_rate: Number) -> tuple:
    """Displacements of a free flight in the frame that shears with the flow, and the peculiar
    velocity c_x after it.

    Args:
      cx, cy: peculiar velocities before; c_y stays as it is.
      strain: that of the frame before.
      flight: time.
    """
    dx = (cx - strain * cy) * flight - shear_rate * cy * flight**2
    return dx, cy * flight, cx - shear_rate * flight * cy


def kinetic_means(
    xx: Number, xy: Number, yy: Number, strain: Number
) -> tuple[Number, Number, Number]:
    """Means of c_x c_x, c_x c_y and c_y c_y over a flight of strain ``strain``, in which c_x falls
    by γ̇ c_y t.
    """
    return xx - strain * xy + strain * strain / 3 * yy, xy - strain / 2 * yy, yy


def residual_target(
    scale: Number, tolerance: Number, shear_rate: Number, epsilon: Number
) -> Number:
    """The residual at which a solve ends: relative to ‖min(u⁻, 0)‖, with an absolute part for
    rounding.

    Args:
      scale: ‖min(u⁻, 0)‖ over the contacts.
      epsilon: rounding of a number of order one.
    """
    return tolerance * scale + ABSOLUTE_RESIDUAL * epsilon * shear_rate


def relative_residual(residual: Number, scale: Number, target: Number) -> Number:
    """A residual over ‖min(u⁻, 0)‖, or over the target where that is larger; zero without shear and
    approach.
    """
    floor = maximum(scale, target)
    return residual / where(floor > 0, floor, 1)


def largest_eigenvalue(xx: Number, xy: Number, yy: Number) -> Number:
    """The larger eigenvalue of symmetric 2×2 matrices."""
    return (xx + yy + sqrt((xx - yy) * (xx - yy) + 4 * xy * xy)) / 2


class ContactTerms(NamedTuple):
    """What one contact adds to the running sums: by name, the rows of ``dynamics.tally`` for
    contacts, in their order, and xx, xy and yy of symmetric tensors.
    """

    impulse: Number
    binary_impulse: Number
    contact_moment_xx: Number
    contact_moment_xy: Number
    contact_moment_yy: Number
    binary_moment_xx: Number
    binary_moment_xy: Number
    binary_moment_yy: Number
    cluster_moment_xx: Number
    cluster_moment_xy: Number
    cluster_moment_yy: Number
    dissipation: Number
    complementarity: Number
    contacts: Number
    loaded_contacts: Number
    collisions: Number
    overlap: Number
    deep_contacts: Number
    binary_speed_moment_xx: Number
    binary_speed_moment_xy: Number
    binary_speed_moment_yy: Number
    binary_dissipation: Number


class SolvedContact(NamedTuple):
    """A contact whose impulse is known.

    nx, ny, distance: unit normal and distance of the centres, in σ.
    overlap: overlap in σ, not negative.
    approach: relative normal velocity u⁻ before the step.
    half_change: half its change by the impulses, (u⁺ − u⁻)/2.
    one_plus_alpha: 1 + α.
    impulse, binary_impulse: J = (1 + α) J₀, and the same if the collision were binary.
    clustered: the impulse J where the contact is in a cluster, otherwise 0.
    used, loaded, approaching: 1 where it is a contact, carries an impulse, approaches; otherwise 0.
    """

    nx: Number
    ny: Number
    distance: Number
    overlap: Number
    approach: Number
    half_change: Number
    one_plus_alpha: Number
    impulse: Number
    binary_impulse: Number
    clustered: Number
    used: Number
    loaded: Number
    approaching: Number


def contact_terms(contact: SolvedContact) -> ContactTerms:
    """What one contact adds to the running sums."""
    nx, ny, distance = contact.nx, contact.ny, contact.distance
    impulse, binary_impulse, clustered = contact.impulse, contact.binary_impulse, contact.clustered
    approach, half_change = contact.approach, contact.half_change
    one_plus_alpha = contact.one_plus_alpha
    xx, xy, yy = nx * nx * distance, nx * ny * distance, ny * ny * distance
    # The impulse is zero where the contact does not approach
    binary_power = -binary_impulse * approach
    return ContactTerms(
        impulse=impulse,
        binary_impulse=binary_impulse,
        contact_moment_xx=impulse * xx,
        contact_moment_xy=impulse * xy,
        contact_moment_yy=impulse * yy,
        binary_moment_xx=binary_impulse * xx,
        binary_moment_xy=binary_impulse * xy,
        binary_moment_yy=binary_impulse * yy,
        cluster_moment_xx=clustered * xx,
        cluster_moment_xy=clustered * xy,
        cluster_moment_yy=clustered * yy,
        dissipation=-impulse * (approach + half_change),
        complementarity=impulse * (one_plus_alpha / 2 * approach + half_change),
        contacts=contact.used,
        loaded_contacts=contact.loaded,
        collisions=contact.approaching,
        overlap=contact.overlap,
        deep_contacts=where(contact.overlap > DEEP_OVERLAP, contact.used, 0),
        binary_speed_moment_xx=binary_power * xx,
        binary_speed_moment_xy=binary_power * xy,
        binary_speed_moment_yy=binary_power * yy,
        binary_dissipation=(1 - one_plus_alpha / 2) * binary_power,
    )
