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
# # What does a force ratio above one prove?
#
# That the collisions of one time step are not binary. Does it also prove that kinetic theory fails because collisions
# are not binary? This notebook takes the stress of a flow apart, at several time steps, numbers of grains and points of
# the plane. `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax
import xarray as xr

import jaxgran as jg

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))
grains, seeds = (64, 1) if quick else (256, 2)
chosen = {"equilibrate": 4.0, "strain": 4.0} if quick else {}
timesteps = [1e-3, 3e-4] if quick else [1e-3, 3e-4, 1e-4, 3e-5]

# %% [markdown]
# ## The time step is a duration of contact
#
# Collisions within one time step act together. So the ratio belongs to its time step, as it would to the duration of
# contact of real grains. Two flows at ν = 0.6, from a coarse time step to a fine one:

# %%
flows = jg.ratio_map([0.2, 0.5], [0.6, 0.65], timestep=timesteps, grains=grains, seeds=seeds, **chosen)
table = flows.to_dataset()[["force_ratio", "force_ratio_stderr"]].sel(packing_fraction=0.6)
table.round(4).to_dataframe().reset_index().drop(columns="packing_fraction")

# %% [markdown]
# ## The stress, taken apart
#
# Enskog's theory has a contact pressure at the measured temperature. Five factors lead from it to the measured one: the
# temperature of neighbours in place of that of all grains, its anisotropy, the speeds at which grains approach (one if
# velocities are independent: molecular chaos), the pairs that are there, and the impulses (one if collisions are
# binary). Their product is exact.

# %%
factors = ["local_temperature", "anisotropy", "chaos", "pairs", "binary"]
loss = {name: flows[f"theory/enskog_factor_pressure_{name}"].sel(packing_fraction=0.6) for name in factors}
whole = (flows["stresses/contact_pressure"] / flows["theory/enskog_pressure"]).sel(packing_fraction=0.6)
split = xr.Dataset(loss).assign(product=whole)
split.round(3).to_dataframe().reset_index().drop(columns="packing_fraction")

# %% [markdown]
# The identity holds to rounding. The binary factor falls towards one as dt → 0. The product hardly moves: what clusters
# lose goes over into more pairs that approach more slowly.

# %%
error = abs(whole / split[factors].to_array().prod("variable") - 1)
assert float(error.max()) < 1e-9
print("product at the finest over that at the coarsest time step, α = 0.2 and 0.5:")
print((whole.isel(timestep=-1) / whole.isel(timestep=0)).values.round(3))

# %% [markdown]
# Against the number of grains: long waves of velocity heat the granular temperature, not the collisions. So the factor
# of the local temperature falls with N, and chaos does not.

# %%
sizes = [64, 128] if quick else [100, 400, 1600]
grown = jg.ratio_map([0.5], [0.6], grains=sizes, seeds=1, **chosen).isel(packing_fraction=0, restitution=0)
both = {name: grown[f"theory/enskog_factor_pressure_{name}"] for name in ("local_temperature", "chaos")}
xr.Dataset(both).to_dataframe().round(3)

# %% [markdown]
# ## Where which assumption fails
#
# The same over a part of the plane: each panel is one factor, dotted where it is one within its error. Chaos fails
# first, as grains bounce less; the binary assumption fails where flows are dense and dissipative.

# %%
alphas = [0.2, 0.5, 0.8] if quick else [0.1, 0.3, 0.5, 0.7, 0.9]
fractions = [0.5, 0.65, 0.75] if quick else [0.3, 0.5, 0.6, 0.7, 0.75, 0.79]
plane = jg.ratio_map(alphas, fractions, timestep=5e-4, grains=grains, seeds=1, **chosen)
jg.enskog_factors(plane)
