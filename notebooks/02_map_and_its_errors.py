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
# # Where are collisions binary, and how sure is that?
#
# A map of the force ratio over restitution α and packing fraction ν (Lois, Lemaître and Carlson,
# *Momentum transport in granular flows*) with its errors, beside `jg.validity`, which needs no
# simulation. `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr

import jaxgran as jg
from jaxgran.model.display import with_error

jax.config.update("jax_enable_x64", True)
jg.use_cache()
plt.rcParams.update({"font.size": 8, "figure.dpi": 150, "figure.constrained_layout.use": True})
quick = bool(os.environ.get("QUICK"))
restitution = [0.2, 0.5, 0.8] if quick else [0.1, 0.3, 0.5, 0.7, 0.9]
packing_fraction = [0.6, 0.7, 0.78] if quick else [0.4, 0.5, 0.6, 0.7, 0.75, 0.79]
timestep = 5e-4
run = {"grains": 64, "seeds": 1} if quick else {"grains": 256, "seeds": 2}

# %% [markdown]
# ## The map
#
# A point is one or more flows (seeds), sheared until they are steady and sampled over six
# correlation strains. If something goes wrong, it keeps its value and has a status.

# %%
data = jg.ratio_map(restitution, packing_fraction, timestep=timestep, **run)
print(f"{int((data.status == jg.Status.ok).sum())} of {data.status.size} points have the status ok")
print(
    f"force ratio ± one standard error, N = {run['grains']}, dt = {timestep:g}; a column for each "
    "α:"
)
xr.apply_ufunc(with_error, data.force_ratio, data.force_ratio_stderr, vectorize=True).to_pandas()

# %% [markdown]
# The force ratio (a) and the shear-stress ratio (b):

# %%
jg.ratio_curves(data)

# %% [markdown]
# Contours of the force ratio less one:

# %%
jg.ratio_contours(data)

# %% [markdown]
# ## The parts of the total error
#
# The standard error is that of sampling. The map also estimates averages of a large system with
# exact collisions, with half-widths of 95 % intervals and their parts. The force ratio has no error
# from dt, as it means nothing without its dt. In per cent, at one point:

# %%
names = ["force_ratio", "pressure", "shear_stress", "granular_temperature"]
point = data.to_dataset().isel(restitution=1, packing_fraction=1)
print(
    f"α = {point.restitution:g}, ν = {point.packing_fraction:g}, N = {run['grains']}, dt = "
    f"{timestep}"
)
large = {name: point[f"{name}_large_system"] for name in names}
change = {f"{name}": f"{100 * (x / point[name] - 1).item():+.1f} %" for name, x in large.items()}
print("large system over this one:", change)
xr.Dataset(
    {name: 100 * point[f"{name}_large_system_ci95"] / x for name, x in large.items()}
).to_dataframe()[names].round(2)

# %% [markdown]
# The largest part says what to do: more strain or seeds for sampling, more grains for the
# correction.

# %% [markdown]
# ## Beside the reference map
#
# `jg.validity` reads a map of up to 16,000 grains at dt = 1e-4, for a large system. Pressures
# should agree within the combined intervals; force ratios need not, as dt differs.

# %%
alphas, nus = np.meshgrid(restitution, packing_fraction)
reference = jg.validity(alphas, nus)
measured = data.pressure_large_system.values
error = data.pressure_large_system_ci95.sel(error_source="total").values
pressure = reference.measured["pressure"]
inside = abs(measured - pressure.value) <= np.hypot(error, pressure.ci95)
print(f"pressure: {inside.sum()} of {inside.size} differences within the combined 95 % intervals")

# %%
figure, axes = plt.subplots(figsize=(3.35, 3.0))
fine = np.linspace(min(packing_fraction), max(packing_fraction), 60)
for k, alpha in enumerate(restitution):
    line = jg.validity(alpha, fine)
    middle, half = line.measured["pressure"]
    shade = plt.cm.viridis(0.85 * k / (len(restitution) - 1))
    axes.fill_between(fine, middle - half, middle + half, color=shade, alpha=0.3, lw=0)
    axes.errorbar(
        packing_fraction,
        measured[:, k],
        error[:, k],
        fmt="os^Dv"[k],
        ms=3.5,
        color=shade,
        label=alpha,
    )
axes.set(yscale="log", xlabel=r"packing fraction $\nu$", ylabel=r"pressure $p$ / $m\dot\gamma^2$")
axes.legend(title=r"restitution $\alpha$", title_fontsize=7, fontsize=7, frameon=False)
plt.show()

# %% [markdown]
# Bands: the reference map. Points: the map above.
#
# ## Does kinetic theory hold where collisions are binary?
#
# Not necessarily: binary collisions need not be independent. The best of three theories, moments of
# an anisotropic Gaussian (Jenkins and Richman 1988), against the reference map:

# %%
for alpha, nu in [(0.9, 0.6), (0.8, 0.75), (0.5, 0.4), (0.2, 0.5)]:
    print(f"α = {alpha}, ν = {nu}: {jg.validity(alpha, nu).verdict()}\n")

# %%
relative, interval = reference.error["pressure"]
ratio = reference.measured["force_ratio"].value
near = ratio < 1.05
print(
    f"{near.sum()} of {near.size} points have a force ratio below 1.05 (dt = 1e-4); at",
    end=" ",
)
print(f"{(near & (abs(relative) < 0.1)).sum()} of these the theory's pressure is within 10 %")

# %%
figure, axes = plt.subplots(figsize=(3.35, 3.0))
axes.axhspan(-10, 10, color="0.9", zorder=0)
for k, alpha in enumerate(restitution):
    shade = plt.cm.viridis(0.85 * k / (len(restitution) - 1))
    style = {"fmt": "os^Dv"[k] + "-", "ms": 4, "lw": 0.8, "color": shade, "mfc": "white"}
    axes.errorbar(
        packing_fraction, 100 * relative[:, k], 100 * interval[:, k], label=alpha, **style
    )
    axes.plot(
        nus[near[:, k], k], 100 * relative[near[:, k], k], "os^Dv"[k], ms=4, color=shade, zorder=4
    )
axes.set(xlabel=r"packing fraction $\nu$", ylabel="theory's error of the pressure (%)")
keys = {
    "title": r"restitution $\alpha$",
    "title_fontsize": 7,
    "fontsize": 7,
    "frameon": False,
    "columnspacing": 0.8,
}
figure.legend(loc="outside upper center", ncols=len(restitution), handletextpad=0.2, **keys)
plt.show()

# %% [markdown]
# Filled: force ratio below 1.05. Grey: 10 %. Bars: 95 % intervals.
#
# **Collisions are binary in loose or nearly elastic flows; every force ratio has a standard error,
# every average of a large system a 95 % interval.** Kinetic theory fails well below the lowest
# contour; the next notebook says why.
