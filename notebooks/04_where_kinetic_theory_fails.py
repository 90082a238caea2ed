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
# # Where does kinetic theory fail, and which of its assumptions first?
#
# A force ratio of one is necessary for kinetic theory, and not sufficient. The error of its stress is split here into
# what is lost by counting binary collisions alone, and what its closure loses: contact values, temperatures, molecular
# chaos. `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax
import numpy as np

import jaxgran as jg
from jaxgran.analysis.velocity_correlations import near_contact

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))
restitution = [0.3, 0.55, 0.8] if quick else [0.2, 0.35, 0.5, 0.65, 0.8]
packing_fraction = [0.5, 0.65, 0.78] if quick else [0.4, 0.5, 0.6, 0.7, 0.75, 0.79]
grains, strain, seeds = (64, 2.0, 1) if quick else (256, 8.0, 2)

# %% [markdown]
# A map holds what kinetic theory predicts beside what is measured: here the moments of an anisotropic Gaussian, with
# Enskog's collision rate.

# %%
data = jg.ratio_map(
    restitution, packing_fraction, grains=grains, seeds=seeds, strain=strain, equilibrate=2.0 if quick else None
)
ratio = (data["theory/pressure"] / data.pressure).rename("pressure, theory over measured")
ratio.attrs = {"units": "1"}  # not those of the pressure
ratio

# %% [markdown]
# The excess of the force ratio is carried by clusters of three or more grains that push at once.

# %%
jg.cluster_shares(data)

# %% [markdown]
# Molecular chaos is lost long before collisions stop being binary. Grains that are about to collide approach each other
# more slowly than independent grains would: the square of their normal velocity, over that of independent ones.

# %%
for alpha in (0.9, 0.5):
    flow = jg.ShearFlow(grains=grains, restitution=alpha, packing_fraction=0.6, timestep=1e-3)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=4.0)
    _, seen = jg.snapshot_series(flow, state, strain=2.0 if quick else 10.0, count=20 if quick else 100)
    near = near_contact(seen)
    slower, crowded = near.speed_ratio, near.contact_ratio
    print(f"α = {alpha}: squared approach {slower.value:.2f} ± {slower.error:.2f} of that of chaos,", end=" ")
    print(f"{crowded.value:.2f} ± {crowded.error:.2f} times as many pairs at contact as in equilibrium")

# %% [markdown]
# The error of the theory in pressure and shear stress (a), what binary collisions miss (b), and what the closure
# does (c).

# %%
assert np.all(np.isfinite(ratio.values))
jg.theory_errors(data)
