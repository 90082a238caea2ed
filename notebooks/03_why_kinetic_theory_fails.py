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
# # Why does kinetic theory fail, and what corrects it?
#
# Clusters are the obvious suspect, but kinetic theory fails long before they carry the stress. We
# take the measured stress apart, factor by factor, and put what we find back into the theory.
# `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.model.display import with_error
from jaxgran.theory.corrected_shear import MEASURED_LAWS, corrected_shear, correlation_length

jax.config.update("jax_enable_x64", True)
jg.use_cache()
plt.rcParams.update({"font.size": 8, "figure.dpi": 150, "figure.constrained_layout.use": True})
quick = bool(os.environ.get("QUICK"))
restitution = [0.3, 0.55, 0.8] if quick else [0.2, 0.4, 0.6, 0.8, 0.95]
packing_fraction = [0.5, 0.65, 0.75] if quick else [0.3, 0.5, 0.6, 0.7, 0.78]
grains = 64 if quick else 400
colours = plt.cm.viridis(np.linspace(0, 0.85, len(restitution)))

# %% [markdown]
# ## Five factors
#
# The measured contact pressure is Enskog's, at the measured granular temperature, times five
# factors. Each replaces an assumption by a measurement: the temperature relative to the flow nearby
# (`local_temperature`), its `anisotropy`, the speeds at which colliding grains approach (`chaos`),
# the `pairs` at contact, and the impulses (`binary`).

# %%
data = jg.ratio_map(restitution, packing_fraction, grains=grains, seeds=1, timestep=3e-4)
names = ["local_temperature", "anisotropy", "chaos", "pairs", "binary"]


def text(data, name):
    """A variable and its standard error as text."""
    return with_error(float(data[name]), float(data[f"{name}_stderr"]))


point = data.sel(restitution=restitution[2], packing_fraction=packing_fraction[1])
print(
    f"α = {restitution[2]}, ν = {packing_fraction[1]}, N = {grains}, dt = 3e-4, ± one standard "
    "error"
)
for name in names:
    print(f"{name:18s} {text(point, f'theory/enskog_factor_pressure_{name}')}")
product = np.prod([float(point[f"theory/enskog_factor_pressure_{name}"]) for name in names])
contact = point["stresses/contact_stress"].values
whole = float(np.trace(contact) / 2 / point["theory/enskog_pressure"])
print(
    f"measured over Enskog's contact pressure: {whole:.4f}; product of the factors: {product:.4f}"
)

# %% [markdown]
# The product is an identity. Chaos fails first as grains become dissipative, and pairs as flows
# become dense, and the two compensate each other. The binary assumption fails last. In a shorter
# time step it fails less, and chaos and pairs more: a cluster is then a succession of collisions.

# %%
jg.enskog_factors(data)

# %% [markdown]
# ## The correlation length
#
# The dissipation rate goes with the cube of the speed of approach, the stress with its square. In
# extended kinetic theory (Jenkins 2006) a length L accounts for the loss of dissipation. L′ is
# Enskog's dissipation rate over his pressure, divided by the measured quotient; where collisions
# are binary it is chaos^(−1/2).

# %%
length, error = (
    data[f"theory/correlation_length_from_pressure{end}"].values for end in ("", "_stderr")
)
chaos, binary = (
    data[f"theory/enskog_factor_pressure_{name}"].values for name in ("chaos", "binary")
)
chaos_error = data["theory/enskog_factor_pressure_chaos_stderr"].values
isolated = abs(binary - 1) < 0.01
product = (length * np.sqrt(chaos))[isolated]
print(f"N = {grains}, dt = 3e-4: L′ √chaos is {product.min():.3f} to {product.max():.3f}", end=" ")
print(f"at the {isolated.sum()} of {isolated.size} points whose binary factor is one within 1 %;")
print(f"standard errors of L′ there at most {np.max((error / length)[isolated]):.1%},", end=" ")
print(f"of √chaos {np.max((chaos_error / chaos)[isolated]) / 2:.1%}")

# %%
figure, axes = plt.subplots(figsize=(3.35, 3.0))
smooth = np.linspace(packing_fraction[0], packing_fraction[-1], 80)
for k, alpha in enumerate(restitution):
    axes.errorbar(
        packing_fraction,
        length[:, k],
        error[:, k],
        fmt="os^Dv"[k],
        ms=4,
        color=colours[k],
        label=alpha,
    )
    axes.plot(smooth, correlation_length(MEASURED_LAWS, alpha, smooth), color=colours[k], lw=0.8)
axes.set(xlabel=r"packing fraction $\nu$", ylabel=r"correlation length $L^\prime/\sigma$")
axes.legend(title=r"restitution $\alpha$", title_fontsize=7, fontsize=7, frameon=False)
plt.show()

# %% [markdown]
# Lines: a law of α and ν fitted to the reference map (dt = 1e-4).
#
# ## The theory, corrected
#
# With too much dissipation the flow of the theory is too cold, which is most of its error in the
# stress. `corrected_shear` divides the dissipation by L′, multiplies the pairs at contact by a
# measured factor, and solves the balance of the moments as before. Nothing is adjusted to T, p or
# τ.

# %%
alphas, nus = np.meshgrid(restitution, packing_fraction)
corrected = jax.vmap(corrected_shear)(alphas.ravel(), nus.ravel())
pairs = {
    "granular_temperature": ("local_granular_temperature", r"local $T$ / $m\sigma^2\dot\gamma^2$"),
    "pressure": ("pressure", r"pressure $p$ / $m\dot\gamma^2$"),
    "shear_stress": ("shear_stress", r"shear stress $\tau$ / $m\dot\gamma^2$"),
}
figure, panels = plt.subplots(1, 3, figsize=(6.7, 2.7))
print(f"N = {grains}, dt = 3e-4, {alphas.size} points, rms of ln(predicted/measured):")
for axes, (name, (column, label)) in zip(panels, pairs.items(), strict=True):
    measured, error = data[column].values.ravel(), data[f"{column}_stderr"].values.ravel()
    moments, from_laws = data[f"theory/{name}"].values.ravel(), np.asarray(getattr(corrected, name))
    bars = np.asarray(getattr(corrected, f"{name}_stderr"))
    before, after = (np.sqrt(np.mean(np.log(x / measured) ** 2)) for x in (moments, from_laws))
    noise = np.sqrt(np.mean((error / measured) ** 2))
    print(
        f"{column:27s} moments {before:.2f}, corrected {after:.2f}, standard error of the measured "
        f"ones {noise:.2f}"
    )
    axes.errorbar(
        measured,
        moments,
        xerr=error,
        fmt="o",
        mfc="white",
        color="0.55",
        ms=4,
        lw=0.8,
        label="moments",
    )
    axes.errorbar(measured, from_laws, bars, error, fmt="ko", ms=3, lw=0.8, label="corrected")
    axes.axline((1, 1), (2, 2), color="0.4", lw=0.8)
    axes.set(xscale="log", yscale="log", title=label)
    axes.title.set_size(8)
    axes.set_xlabel("measured")
panels[0].set_ylabel("predicted")
panels[0].legend(fontsize=7, frameon=False)
plt.show()

# %% [markdown]
# Vertical bars: the scatter of the laws in flows that were not fitted.
#
# **Kinetic theory fails because colliding grains approach more slowly than independent ones, and
# because more pairs are at contact than in equilibrium.** A law of each, of α and ν alone, corrects
# most of it, but not nearly elastic, dense flow, which is more viscous than in Enskog's theory.
