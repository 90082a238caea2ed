"""Flows of rigid, frictionless discs in simple shear by contact dynamics, in JAX.

A grid of restitutions α and packing fractions ν as one batch:

    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import jaxgran as jg

    jg.use_cache()  # keeps compiled programs on disk
    alphas, nus = jnp.array([(0.3, 0.5), (0.9, 0.5), (0.3, 0.7), (0.9, 0.7)]).T
    flows = jg.ShearFlow(grains=64, restitution=alphas, packing_fraction=nus, timestep=1e-3)
    states = jg.prepare(flows, jax.random.split(jax.random.key(0), len(alphas)))  # until steady
    states, result = jax.vmap(jg.sample, (0, 0, None))(flows, states, 50.0)  # a strain of 50
    for row in zip(alphas, nus, result.force_ratio, result.errors()["force_ratio"], result.status):
        print("α = {:g}, ν = {:g}: {:.4f} ± {:.4f},".format(*row[:4]), jg.Status(row[4]).name)

================  ==================================================================================
flow              ShearFlow, State, Grains, own_grains, polydisperse, Status, InputError
run               prepare (or pack and heated), sample, Sample, advance, count_events, Tally, and
                  the engines Jax and Numba
frames            snapshot_series, Snapshot, write_trajectory, read_trajectory, fields_at, grid,
                  fit_trajectory, jax_md_space
map               ratio_map, open_map, merge_maps, explore
answer            validity, constitutive_law
figures           save_figures: ratio_curves, ratio_contours, theory_errors, enskog_factors,
                  cluster_shares, averages_against_grains, ratio_against_timestep; flow_figure
contact problems  solve_contacts, ContactNetwork, DelassusProblem, ProjectedMethod,
                  BarzilaiBorwein, Nesterov, Jacobi
setting up        use_cache
================  ==================================================================================

Units: mean grain diameter σ, mass m of a grain of that diameter, and t = 1/γ̇. Numbers of a batch
have a leading ``(replicas,)`` axis, arrays of grains are ``(grains, 2)`` or ``(grains,)``. Without
``engine`` the fastest one is chosen. Only ``use_cache`` changes flags of JAX. Names are loaded when
they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.3.0"
