"""jaxgran: flows of rigid, frictionless discs in simple shear by contact dynamics, in JAX.

    import jaxgran as jg
    flow = jg.ShearFlow(grains=256, restitution=0.5, packing_fraction=0.76, timestep=1e-4)
    state = jg.prepare(flow, jax.random.key(0))          # packed, heated and sheared to the steady state
    state, sample = jg.sample(flow, state, strain=5.0)
    sample.force_ratio, sample.errors()["force_ratio"]

Axes: arrays of grains are ``(grains, 2)`` or ``(grains,)``, of near pairs ``(pairs,)``, of contacts ``(contacts,)``.
Every function of an engine is written for one replica. A batch adds a leading ``(replicas,)`` axis, with ``jax.vmap``
and ``axis_name="replica"``, or with ``jax.lax.map``.

Units: mean grain diameter σ, mass m of a grain of that diameter, and the time unit t of the shear rate (t = 1/γ̇ at the
default γ̇ = 1).

Importing this package is quick and changes no flag of JAX. Names are loaded when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.2.0"
