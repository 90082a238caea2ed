"""jaxgran: flows of rigid, frictionless discs in simple shear by contact dynamics, in JAX.

    import jaxgran as jg
    flow = jg.ShearFlow(grains=256, restitution=0.5, packing_fraction=0.76, timestep=1e-4)
    state = jg.prepare(flow, jax.random.key(0))  # packed, heated and sheared to the steady state
    state, sample = jg.sample(flow, state, strain=5.0)
    sample.force_ratio, sample.errors()["force_ratio"]

Many flows are one batch: numbers and states get a leading ``(replicas,)`` axis. A grid of α and ν,
as in the README:

    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import jaxgran as jg

    jg.use_cache()  # compiled programs are kept on disk
    alphas, nus = jnp.array([(a, n) for n in (0.5, 0.6, 0.7) for a in (0.3, 0.6, 0.9)]).T
    flows = jg.ShearFlow(grains=64, restitution=alphas, packing_fraction=nus, timestep=1e-3)
    states = jg.prepare(flows, jax.random.split(jax.random.key(0), len(alphas)))  # until steady
    states, samples = jg.sample(flows, states, strain=5.0)  # or jax.vmap(jg.sample, (0, 0, None))
    for row in zip(alphas, nus, samples.force_ratio, samples.errors()["force_ratio"]):
        print("α = {:.1f}, ν = {:.1f}: {:.3f} ± {:.3f}".format(*row))

``sample``, ``advance`` and ``snapshot_series`` take a batch directly, also by ``jax.vmap`` and
``jax.lax.map``; ``prepare`` and ``heated`` take a batch of keys. Leave ``engine`` out: on a
processor the numba engine is then chosen, also under ``vmap``, and nothing is faster there.

Axes: arrays of grains are ``(grains, 2)`` or ``(grains,)``, of near pairs ``(pairs,)``, of contacts
``(contacts,)``.

Units: mean grain diameter σ, mass m of a grain of that diameter, and the time unit t of the shear
rate (t = 1/γ̇ at the default γ̇ = 1).

Importing this package is quick. Only ``jg.use_cache()`` changes flags of JAX, so that later
processes need not compile. Names are loaded when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.2.0"
