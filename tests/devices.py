"""Advance a batch from a file on all devices of JAX, here or of two hosts, and write what comes
out.

python devices.py START.npz OUTPUT.npz GRAINS [lockstep | COORDINATOR HOST]
"""

import sys
from types import SimpleNamespace

import jax
import numpy as np

start, output, grains, *host = sys.argv[1:]
jax.config.update("jax_enable_x64", True)

from jaxgran.dynamics import engine  # noqa: E402

if host == ["lockstep"]:
    engine.default_device = lambda: SimpleNamespace(platform="accelerator")
elif host:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(host[0], 2, int(host[1]))

from jaxgran.dynamics.engine import Numerics  # noqa: E402
from jaxgran.model.flow import ShearFlow  # noqa: E402
from jaxgran.model.grains import Grains  # noqa: E402
from jaxgran.model.state import State  # noqa: E402
from jaxgran.sampling.observe import advance_batch  # noqa: E402

like = (ShearFlow(int(grains), 0.5, 0.6, 1e-3), Numerics(), State(Grains(0, 0), 0, 0, 0, 0), 0)
with np.load(start) as arrays:
    leaves = [arrays[name] for name in arrays.files]
state, tally = advance_batch(*jax.tree.unflatten(jax.tree.structure(like), leaves))
np.savez(output, *[np.asarray(leaf) for leaf in jax.tree.leaves((state, tally))])
