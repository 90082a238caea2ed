"""Advance replicas on one device and, by the recipe of the pages, on all four; the same bits.

python devices.py [lockstep]
"""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from flows import flow_of
from jax.sharding import Mesh, PartitionSpec
from test_batching import assert_same

import jaxgran as jg
from jaxgran import environment

jax.config.update("jax_enable_x64", True)
if sys.argv[1:] == ["lockstep"]:
    environment.default_device = lambda: SimpleNamespace(platform="accelerator")

alphas = jnp.asarray([0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.2, 0.4])
flows = flow_of(0.7, restitution=alphas)
states = jax.device_get(jg.heated(flows, jax.random.split(jax.random.key(0), len(alphas))))


@jax.vmap
def advanced(alpha, state):
    return jg.advance(flow_of(0.7, restitution=alpha), state, jnp.int32(100))


mesh, share = Mesh(np.asarray(jax.devices()), ("device",)), PartitionSpec("device")
on_all = jax.shard_map(advanced, mesh=mesh, in_specs=share, out_specs=share, check_vma=False)
assert jax.device_count() == 4
one, four = (jax.jit(run)(alphas, states) for run in (advanced, on_all))
assert np.all(np.asarray(one[1].collisions) > 0)
assert_same(one, four)
