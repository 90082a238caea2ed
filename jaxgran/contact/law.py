"""TODO"""

import jax.numpy as jnp
from jaxtyping import Array


def flight_of(cx: Array, cy: Array, strain: Array, flight: Array, shear_rate: float | Array) -> tuple[Array, ...]:
    """Displacements of a free flight in the frame that shears with the flow, and the peculiar velocity c_x after it.

    Args:
      cx, cy: peculiar velocities before; c_y stays as it is.
      strain: that of the frame before.
      flight: time.
    """
    dx = (cx - strain * cy) * flight - shear_rate * cy * flight**2
    return dx, cy * flight, cx - shear_rate * flight * cy


def kinetic_means(xx: Array, xy: Array, yy: Array, turned: Array) -> tuple[Array, Array, Array]:
    """Means of c_x c_x, c_x c_y and c_y c_y over a flight of strain ``turned``, in which c_x falls by γ̇ c_y t."""
    return xx - turned * xy + turned**2 / 3 * yy, xy - turned / 2 * yy, yy


def overlaps_within(squared_speed: Array, closing: Array, excess: Array, look_ahead: float | Array) -> tuple:
    """The rule of ``is_contact`` for pairs of any shape: whether they are contacts, and whether they approach.

    Args:
      squared_speed, closing, excess: |u|², s·u and |s|² − d², see ``gap_coefficients``.
      look_ahead: θ·dt.
    """
    approaching = closing < 0
    before_closest = -closing < squared_speed * look_ahead
    t = jnp.where(approaching & before_closest, -closing / jnp.where(approaching, squared_speed, 1), look_ahead)
    return excess + t * (2 * closing + t * squared_speed) <= 0, approaching


def time_to_touch(squared_speed: Array, closing: Array, excess: Array) -> tuple:
    """The times of ``first_contact_time`` from the numbers that ``overlaps_within`` takes."""
    discriminant = closing * closing - squared_speed * excess
    touches = (closing < 0) & (discriminant >= 0)
    time = excess / (jnp.sqrt(jnp.where(touches, discriminant, 1)) - jnp.where(touches, closing, 0))
    closest = -closing / jnp.where(closing < 0, squared_speed, 1)
    return jnp.where(touches, time, jnp.inf), closest


def gap_coefficients(x: Array, y: Array, ux: Array, uy: Array, reach: Array) -> tuple[Array, Array, Array]:
    """|u|², s·u and |s|² − d², the coefficients of |s + u t|² − d²."""
    return ux * ux + uy * uy, x * ux + y * uy, x * x + y * y - reach**2
