# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What carries the stress of a sheared granular flow?
#
# Discs that collide and lose energy, sheared at a constant rate in a periodic cell. This notebook makes such a flow,
# measures it, and looks at the forces between its grains. `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax
import numpy as np

import jaxgran as jg

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))
grains, strain = (64, 2.0) if quick else (324, 10.0)

# %% [markdown]
# A flow is a few numbers: the restitution α, which is the share of the normal velocity that a collision leaves, the
# packing fraction ν, and the time step. Lengths are in mean diameters σ, times in the inverse shear rate.

# %%
flow = jg.ShearFlow(grains=grains, restitution=0.1, packing_fraction=0.8, timestep=1e-3)
flow

# %% [markdown]
# `prepare` packs the grains without overlap, heats them, and shears until temperature and pressure are level. `sample`
# shears on and measures.

# %%
state = jg.prepare(flow, jax.random.key(0), equilibrate=2.0 if quick else None)
state, sample = jg.sample(flow, state, strain)
sample

# %% [markdown]
# Every average has a standard error. The force ratio compares the mean contact force with the one that the same
# contacts would have if every collision were between two grains alone: where it is well above one, clusters carry
# the stress.

# %%
errors = sample.errors()
for name in ("force_ratio", "pressure", "shear_stress", "granular_temperature", "coordination_number"):
    print(f"{name:22s}{float(sample.averages[name]):9.3f} ± {float(errors[name]):.3f}")
print("status:", jg.Status(int(sample.status)).name)

# %% [markdown]
# What does that look like? Forces over a few time steps: black where three or more grains push at once.

# %%
steps = 20
state, seen = jg.snapshot_series(flow, state, strain=steps * flow.timestep, count=steps)
assert np.all(np.isfinite(seen.state.positions))
jg.flow_figure(seen)
