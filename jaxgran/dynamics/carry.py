"""What the loop over the events of the engine ``Jax`` is given, and what it carries."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.contact.near_pairs import PairLists, no_lists, present
from jaxgran.contact.network import PairMotion
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.dynamics.observer import Observe, ObserveNow, nothing_observed, observe_at
from jaxgran.dynamics.tally import RunningSums, empty_sums
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State, status_at_start


class Constants(NamedTuple):
    """What does not change in an advance; the last four are static."""

    flow: ShearFlow
    grains: Grains
    side: Float[Array, ""]
    steps: Int[Array, ""]  # to fly in all
    solver: ProjectedMethod
    free_flight: bool = True  # whether steps without an approaching contact are jumped over
    # Numbers of contacts for which a solve is compiled, smallest first, beside that of all pairs;
    # none in loops for derivatives
    buffers: tuple[int, ...] = ()
    moving_contacts: bool = False  # whether derivatives include that a contact moves in time
    observe: Observe | None = None


class Carry(NamedTuple):
    """What an event changes."""

    lists: PairLists
    pairs: PairMotion  # of the near list
    slack: Float[Array, ""]  # of the near list, see ``step``
    closing_speed: Float[Array, ""]  # bound on how fast any gap closes
    velocities: Float[Array, "grains 2"]
    step: Int[Array, ""]  # steps flown
    solved: Bool[Array, ""]  # whether the contacts of the present step have been dealt with
    sums: RunningSums
    reading_interval: Float[Array, ""]  # time between readings of the velocity scales; 0 at first


def start(constants: Constants, state: State) -> Carry:
    """The carry before the first step, without lists."""
    lists, dtype = no_lists(state.positions, state.tilt), state.positions.dtype
    sums = empty_sums(dtype)._replace(status=status_at_start(constants.flow, state))
    now = Carry(
        lists=lists,
        pairs=PairMotion(*4 * [jnp.zeros_like(lists.near.reach)]),
        slack=lists.near.skin,
        closing_speed=jnp.full_like(constants.side, jnp.inf),  # so that the lists are stale
        velocities=state.velocities,
        step=jnp.int32(0),
        solved=jnp.bool_(False),
        sums=sums,
        reading_interval=jnp.zeros_like(constants.side),
    )
    observe_now = observer_of(constants, now)
    if observe_now is None:
        return now
    nothing = nothing_observed(observe_now, lists.near.reach.size, dtype)
    return now._replace(sums=sums._replace(user_sums=nothing))


def observer_of(constants: Constants, now: Carry) -> ObserveNow | None:
    """What the user observes now, given contacts and impulses; None where nothing is observed."""
    if constants.observe is None:
        return None
    return observe_at(constants.observe, constants.flow, state_of(constants, now))


def state_of(constants: Constants, now: Carry) -> State:
    positions, tilt = present(now.lists, constants.side)
    return State(constants.grains, positions, now.velocities, constants.side, tilt)
