"""jaxgran: flows of rigid, frictionless discs in simple shear by contact dynamics, in JAX.

Axis contract: grains carry ``(grains, 2)``, near pairs ``(pairs,)``, contacts ``(contacts,)``. Every function of the
engine is written for one replica; a batch adds a leading ``(replicas,)`` axis through ``jax.vmap`` with
``axis_name="replica"`` or through ``jax.lax.map``. Units: mean grain diameter σ, mass m of a grain of that diameter,
shear rate γ̇.
"""
