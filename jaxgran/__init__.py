"""jaxgran: flows of rigid, frictionless discs in simple shear by contact dynamics, in JAX.

    import jaxgran as jg
    flow = jg.ShearFlow(grains=256, restitution=0.5, packing_fraction=0.76, timestep=1e-4)
    state = jg.prepare(flow, jax.random.key(0))          # packed, heated, sheared to its steady state
    state, sample = jg.sample(flow, state, strain=5.0)
    sample.force_ratio, sample.errors()["force_ratio"]

Axis contract: grains carry ``(grains, 2)``, near pairs ``(pairs,)``, contacts ``(contacts,)``. Every function of the
engine is written for one replica; a batch adds a leading ``(replicas,)`` axis through ``jax.vmap`` with
``axis_name="replica"`` or through ``jax.lax.map``. Units: mean grain diameter σ, mass m of a grain of that diameter,
shear rate γ̇.

Importing this package imports nothing heavy and changes no flag of JAX; names are loaded when they are first used.
"""

from importlib.metadata import version

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = version("jaxgran")
