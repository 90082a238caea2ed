"""Free flight of near pairs: how far it may go, and what it does."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxgran.contact.law import first_step, flight_of, kinetic_means
from jaxgran.contact.near_pairs import Frame, PairLists, refresh, separations_now
from jaxgran.contact.network import PairMotion, first_contact_time
from jaxgran.dynamics.tally import RunningSums
from jaxgran.model.cell import relative_velocity
from jaxgran.model.control_flow import where_active
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains

LONGEST_FLIGHT = 0.05  # strain; a bound on the change of the peculiar velocities within one flight


class Carry(NamedTuple):
    """What the loop over events of the engine ``Jax`` carries."""

    lists: PairLists
    pairs: PairMotion
    slack: Array  # unused skin of the near list, of which the look-ahead of a step takes a part
    loss: Array  # bound on how fast any gap closes
    velocities: Array
    step: Array  # steps flown
    solved: Array  # whether the contacts of the present step have been dealt with
    sums: RunningSums
    counted: Array  # collisions until the last reading of the velocity scales


def pairs_now(lists: PairLists, velocities: Array, shear_rate: float | Array) -> PairMotion:
    """The near pairs with their separations and relative velocities now."""
    separations = separations_now(lists.near, lists.frame)
    u = relative_velocity(velocities, lists.near.i, lists.near.j, separations, shear_rate)
    return PairMotion(separations[:, 0], separations[:, 1], u[:, 0], u[:, 1])


def closing_speed(flow: ShearFlow, grains: Grains, velocities: Array, skin: Array) -> Float[Array, ""]:
    """Bound on how fast the gap of a pair outside of the near list closes, in σγ̇.

    A gap closes no faster than 2 max|c| from the peculiar velocities and γ̇ Δx Δy / r ≤ γ̇ r / 2 from the shear, where
    r ≤ d + skin until a pair from outside the list touches. Within a flight |c| grows by a factor 1 + γ̇ t at most.
    """
    cx, cy = lax.stop_gradient(velocities).T  # the choice of pairs has no derivative
    longest = jnp.maximum(LONGEST_FLIGHT, flow.shear_rate * flow.timestep)
    speed = jnp.sqrt(largest(cx * cx + cy * cy)) * (1 + longest)
    return 2 * speed + flow.shear_rate * (2 * jnp.max(lax.stop_gradient(grains.radii)) + skin) / 2


def is_stale(now: Carry, flow: ShearFlow) -> Bool[Array, ""]:
    """Whether the near list may miss a contact of the next step, which looks θ·dt beyond itself."""
    return ~(now.slack >= now.loss * (1 + flow.activation_fraction) * flow.timestep)


def steps_of_list(now: Carry, flow: ShearFlow) -> Float[Array, ""]:
    """Number of steps for which the near list has every contact; no more than the longest flight."""
    longest = jnp.divide(LONGEST_FLIGHT, flow.shear_rate) / flow.timestep
    return jnp.floor(jnp.minimum(now.slack / now.loss / flow.timestep - flow.activation_fraction, longest))


def with_new_lists(now: Carry, flow: ShearFlow, grains: Grains, side: Array, stale: Array) -> Carry:
    """The carry with a new near list, and a new outer one where that is used up; others of a batch keep theirs."""
    lists = refresh(now.lists, grains, side, stale)
    skin = lax.stop_gradient(lists.near.skin)
    new = now._replace(
        lists=lists,
        pairs=pairs_now(lists, now.velocities, flow.shear_rate),
        slack=skin,
        loss=closing_speed(flow, grains, now.velocities, skin),
    )
    return where_active(stale, new, now)


def steps_to_contact(pairs: PairMotion, reach: Array, flow: ShearFlow, least: Array) -> Float[Array, ""]:
    """Number of steps, at least ``least``, after which some pair first is an approaching contact; may be infinite."""
    time, closest = first_contact_time(pairs, reach)
    steps = jnp.maximum(first_step(time, flow.timestep, flow.activation_fraction), least.astype(time.dtype))
    return smallest(jnp.where(steps * flow.timestep < closest, steps, jnp.inf))


def fly(frame: Frame, velocities: Array, flight: Array, shear_rate: float | Array) -> tuple[Frame, Array]:
    """Exact free flight (SLLOD) for a time: the laboratory velocities stay as they are."""
    cy = velocities[:, 1]
    dx, dy, cx = flight_of(velocities[:, 0], cy, frame.strain, flight, shear_rate)
    moved = frame.displacements + jnp.stack([dx, dy], axis=-1)
    return Frame(moved, frame.strain + shear_rate * flight), jnp.stack([cx, cy], axis=-1)


def add_flight(
    sums: RunningSums, velocities: Array, grains: Grains, jump: Array, flight: Array, shear_rate: float | Array
) -> RunningSums:
    """The sums with the time of a flight and ∫ Σ m c ⊗ c dt along it, where c_x falls by γ̇ c_y t."""
    cx, cy = velocities[:, 0], velocities[:, 1]
    px, py = grains.masses * cx, grains.masses * cy
    xx, xy, yy = (jnp.dot(p, c, precision=lax.Precision.HIGHEST) for p, c in ((px, cx), (px, cy), (py, cy)))
    xx, xy, yy = kinetic_means(xx, xy, yy, shear_rate * flight)
    flown = jnp.stack([flight, jump.astype(flight.dtype), flight * xx, flight * xy, flight * yy])
    return sums._replace(flight=sums.flight + flown)


def largest(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Largest entry of a vector, see ``smallest``."""
    return -smallest(-values)


def smallest(values: Float[Array, " n"]) -> Float[Array, ""]:
    """Smallest entry of a vector.

    XLA's CPU backend runs a minimum over one long axis as a serial chain of comparisons; folded into rows of 32 it
    is a vector operation. The halves are folded apart so that the entries are computed once, in a loop of their own.
    """
    lanes = 32
    rows = 2 * -(-values.size // (2 * lanes))
    folded = jnp.pad(values, (0, rows * lanes - values.size), constant_values=jnp.inf).reshape(rows, lanes)
    columns = jnp.minimum(jnp.min(folded[: rows // 2], axis=0), jnp.min(folded[rows // 2 :], axis=0))
    return jnp.min(jnp.minimum(columns[: lanes // 2], columns[lanes // 2 :]))
