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
# # Where are collisions binary?
#
# Kinetic theory knows collisions of two grains. The force ratio ⟨F⟩/⟨F_bc⟩ is one where that is all there is, and grows
# where clusters push. A map over restitution α and packing fraction ν says which flow is which (Lois, Lemaître and
# Carlson, *Momentum transport in granular flows*). `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax

import jaxgran as jg

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))
restitution = [0.2, 0.5, 0.8] if quick else [0.2, 0.35, 0.5, 0.65, 0.8]
packing_fraction = [0.6, 0.7, 0.78] if quick else [0.5, 0.6, 0.65, 0.7, 0.75, 0.79]
grains, strain, seeds = (64, 2.0, 1) if quick else (256, 8.0, 2)

# %% [markdown]
# Every point of the map is a few independent flows, its seeds; each is packed, sheared until it is steady, and sampled.

# %%
data = jg.ratio_map(
    restitution, packing_fraction, grains=grains, seeds=seeds, strain=strain, equilibrate=2.0 if quick else None
)
data.force_ratio

# %% [markdown]
# A point where something went wrong keeps its value and has a status. What the numbers are worth stands beside them.

# %%
good = data.status == jg.Status.ok
print(f"{int(good.sum())} of {good.size} points without remarks")
print(f"largest standard error of the force ratio: {float((data.force_ratio_stderr / data.force_ratio).max()):.1%}")

# %% [markdown]
# The force ratio (a) and the shear-stress ratio (b) against the packing fraction, a curve for each restitution. They
# depend on the time step, which the figure names: isolated collisions become binary as dt → 0.

# %%
jg.ratio_curves(data)

# %% [markdown]
# All numbers of the map as a page: point at the plane to see them, and click to see the curves through a point.

# %%
jg.explore(data)

# %% [markdown]
# The same as contours of the excess ⟨F⟩/⟨F_bc⟩ − 1. Below the lowest line kinetic theory can hold; above it cannot.

# %%
jg.ratio_contours(data)
