"""The start of a flow: a random packing of grains with Gaussian velocities."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.dynamics.batch import run_batch, stack
from jaxgran.model.checks import InputError, is_traced, key_shape, require, require_key
from jaxgran.model.flow import ShearFlow, flow_of_replica
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.sampling.packing import pack, require_room

_UNCOMPILED = (
    "{} cannot be transformed by jax.jit, jax.vmap or jax.grad, since it decides in Python: call "
    "it before, with a "
    "batch of keys for many states, and pass its state to what is transformed."
)


def heated(
    flow: ShearFlow, key: Array, temperature: float = 1.0, grains: Grains | None = None
) -> State:
    """A random packing with Gaussian velocities of a given granular temperature; or many of them at
    once.

    A start for free cooling, or for a flow that you equilibrate yourself.

    Args:
      flow: parameters of one flow, sheared or not; or numbers (replicas,) of several flows.
      key: JAX random key; the same key gives the same state. Keys (replicas,) make a batch, as in
        ``prepare``.
      temperature: exact value of Σ m c²/(2N), in mσ²/t², of all replicas or (replicas,). Grains of
        every mass have this temperature on average. The total momentum is zero.
      grains: given discs, see ``own_grains`` and ``prepare``; None for diameters uniform in σ ±
        ``polydispersity``.

    Raises:
      InputError: (a ValueError) the temperature is not a positive number, ``pack`` does not accept
        the grains, or this function is called within ``jax.jit``, ``jax.vmap`` or a derivative.
      RuntimeError: no packing was found.
    """
    require_uncompiled("heated", flow, key, temperature, grains)
    flows, keys, discs, single = replicas_of_keys(flow, key, grains)

    def accepted(x: np.ndarray) -> Any:
        return (x > 0) & np.isfinite(x) & (x.shape in ((), (len(keys),) if not single else ()))

    require("temperature", temperature, accepted, "a positive number")
    temperatures = jnp.broadcast_to(jnp.asarray(temperature, float), len(keys))
    state, packed = run_batch(heat_replica, (flows, keys, temperatures, discs))
    if not np.all(packed):
        raise RuntimeError(
            "no packing without overlap was found: the packing fraction is too high for these "
            "grains."
        )
    return jax.tree.map(lambda x: jnp.asarray(x[0] if single else x), state)


def require_uncompiled(name: str, *arguments: Any) -> None:
    """Raise an InputError if JAX traces the arguments of a function, or compiles its caller."""
    if is_traced(arguments, jnp.zeros(())):  # zeros are traced inside of ``jax.jit``
        raise InputError(_UNCOMPILED.format(name))


def replicas_of_keys(
    flow: ShearFlow, key: Array, grains: Grains | None
) -> tuple[ShearFlow, Array, Grains | None, bool]:
    """Flows, keys and given grains with a leading (replicas,) axis, and whether they are those of
    one replica.

    Raises:
      InputError: the key is not one or several, or the others do not suit it.
    """
    shape = key_shape(key)
    if shape is None or len(shape) > 1 or shape == (0,):
        require_key(key)
    single, count = shape == (), 1 if not shape else shape[0]
    flows = [flow_of_replica(flow, k, count) for k in range(count)]
    keys = key[None] if single else key
    if grains is None:
        return stack(flows), keys, None, single
    batched = not single and isinstance(grains, Grains) and np.ndim(grains.radii) == 2
    discs = [
        jax.tree.map(lambda x, k=k: np.asarray(x)[k], grains) if batched else grains
        for k in range(count)
    ]
    for replica in zip(flows, discs, strict=True):
        require_room(*replica)
    return (
        stack(flows),
        keys,
        jax.tree.map(lambda *x: jnp.asarray(np.stack(x), float), *discs),
        single,
    )


@persistent_jit
def heat_replica(
    flow: ShearFlow, key: Array, temperature: Array, grains: Grains | None
) -> tuple[State, Bool[Array, ""]]:
    """A packing with Gaussian velocities of a given temperature and no total momentum; False if
    none was found.
    """
    if key.dtype == jnp.uint32:
        key = jax.random.wrap_key_data(key, impl="threefry2x32")
    pack_key, heat_key = jax.random.split(key)
    state, packed = pack(flow, pack_key, grains)
    masses = state.grains.masses[:, None]
    velocities = jax.random.normal(heat_key, state.positions.shape, masses.dtype) / jnp.sqrt(masses)
    velocities = velocities - jnp.sum(masses * velocities, axis=0, keepdims=True) / jnp.sum(masses)
    drawn = jnp.sum(masses * velocities**2) / (2 * flow.grains)
    return replace(state, velocities=velocities * jnp.sqrt(temperature / drawn)), packed
