"""User sums: what a user's function observes in every time step, summed while the flow advances.

The engine jumps over the steps in which no contact approaches. Such a flight is observed once, in
its middle and without contacts, and counts as the number of its steps. A step whose contacts act is
observed with their network and impulses, before they act, and counts as one. So the weights add up
to the number of steps.

What contacts do is summed exactly. What the flying grains do is summed to second order in the
strain of a flight, by which peculiar velocities change, and which ends with the next collision
anywhere in the cell. At the beginning of their flights, just after a collision, grains would be too
cold, by 2 % in a dilute flow of 64.
"""

import traceback
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran.contact.network import MOST_CONTACTS, Contacts
from jaxgran.dynamics.snapshot import Snapshot, snapshot_of
from jaxgran.model.checks import InputError, refused, short_repr
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.model.status import Status

_NUMBERS = (bool, int, float, np.generic, np.ndarray, jax.Array)
_NEEDS_VALUES = (jax.errors.JAXTypeError, jax.errors.JAXIndexError)
Observe = Callable[[Snapshot], Any]  # returns a pytree of arrays to average
# What is found now, with the contacts of a step and their impulses
ObserveNow = Callable[[Contacts, Array], Any]


class Observed(NamedTuple):
    """Sums over the time steps so far, a pytree of arrays, and whether the contacts of the present
    step are in them.
    """

    sums: Any
    step_observed: Float[Array, ""]


def observe_at(observe: Observe, flow: ShearFlow, state: State) -> ObserveNow:
    """What a user's function finds in a state of a flow.

    Raises:
      InputError: when it is called, if the function needs the values of what JAX traces.
    """

    def observe_now(contacts: Contacts, impulses: Array) -> Any:
        snapshot = snapshot_of(flow, state, contacts, impulses, jnp.int32(Status.ok))
        try:
            return observe(snapshot)
        except _NEEDS_VALUES as error:
            raise InputError(
                "observe must compute with jax.numpy, because JAX traces its snapshot, and "
                f"{_line_of(observe, error)} needs concrete values: jnp.sum and jnp.where take the "
                "place of functions of NumPy, float() and if."
            ) from None

    return observe_now


def _line_of(observe: Observe, error: Exception) -> str:
    """The line of a user's function that raised an error; "it" where that is not known."""
    file = getattr(getattr(observe, "__code__", None), "co_filename", "")
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return f"line {lines[-1].lineno}, {short_repr(lines[-1].line)}," if lines else "it"


def uses_traced_values(observe: Observe, flow: ShearFlow, state: State) -> bool:
    """Whether a function uses values from outside that JAX traces."""

    def observation(flow: ShearFlow, state: State) -> Any:
        return without_contacts(observe_at(observe, flow, state), state.positions.dtype)

    # First what it returns is judged: other things than numbers cannot be traced.
    slots = MOST_CONTACTS * flow.grains
    nothing_observed(observe_at(observe, flow, state), slots, state.positions.dtype)
    return any(isinstance(x, Tracer) for x in jax.make_jaxpr(observation)(flow, state).consts)


def nothing_observed(observe_now: ObserveNow, slots: int, dtype: jnp.dtype) -> Observed:
    """The sums of no time at all.

    Raises:
      InputError: what is found is no pytree of arrays, or their shapes follow the number of slots
        for contacts.
    """

    def returned(slots: int) -> Any:
        def numbers() -> Any:
            values = observe_now(_no_contacts(slots, dtype), jnp.zeros(slots, dtype))
            if not jax.tree.leaves(values):
                raise refused("observe", values, "must return at least one number")
            for x in jax.tree.leaves(values):
                type_of_x = jnp.asarray(x).dtype if isinstance(x, _NUMBERS) else None
                if getattr(type_of_x, "kind", "O") not in "biuf":  # random keys have none
                    raise refused("observe", x, "must return real numbers")
            return jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), dtype), values)

        return jax.eval_shape(numbers)

    few, many = returned(1), returned(slots)
    if few != many:
        raise InputError(
            "observe must return arrays whose shapes do not depend on the number of slots for "
            "contacts, which varies: sum over the contacts."
        )
    return Observed(jax.tree.map(lambda x: jnp.zeros(x.shape, dtype), few), jnp.zeros((), dtype))


def middle_of_flight(user_sums: Observed, steps: Array) -> Float[Array, ""]:
    """The time step in the middle of that part of a flight of so many steps which is not in the
    sums.
    """
    return (steps.astype(user_sums.step_observed.dtype) + user_sums.step_observed) / 2


def with_flight(user_sums: Observed, observe_now: ObserveNow, steps: Array) -> Observed:
    """The sums with a flight of so many steps, which is observed in its middle; where the contacts
    of its first step acted, that step is in already.
    """
    dtype = user_sums.step_observed.dtype
    weight = jnp.maximum(steps.astype(dtype) - user_sums.step_observed, 0)
    observables = without_contacts(observe_now, dtype)
    return Observed(
        added(user_sums.sums, observables, weight), jnp.zeros_like(user_sums.step_observed)
    )


def with_contacts(
    user_sums: Observed, observe_now: ObserveNow, network: Contacts, impulses: Array
) -> Observed:
    """The sums with the present step, whose contacts act."""
    weight = jnp.ones_like(user_sums.step_observed)
    return Observed(added(user_sums.sums, observe_now(network, impulses), weight), weight)


def added(sums: Any, observables: Any, weight: Array) -> Any:
    """The sums with observables that hold for so many steps."""
    return jax.tree.map(
        lambda old, x: old + weight * jnp.asarray(x).astype(old.dtype), sums, observables
    )


def without_contacts(observe_now: ObserveNow, dtype: jnp.dtype) -> Any:
    """What is found in a step without contacts."""
    return observe_now(_no_contacts(1, dtype), jnp.zeros(1, dtype))


def _no_contacts(slots: int, dtype: jnp.dtype) -> Contacts:
    zeros, grains = jnp.zeros(slots, dtype), jnp.zeros(slots, jnp.int32)
    return Contacts(
        i=grains,
        j=grains,
        normals=jnp.zeros((slots, 2), dtype),
        distances=jnp.ones(slots, dtype),
        approach=zeros,
        inverse_mass_i=zeros,
        inverse_mass_j=zeros,
        used=jnp.zeros(slots, bool),
    )
