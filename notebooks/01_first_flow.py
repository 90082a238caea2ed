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
# Rigid discs that lose energy when they collide are sheared at a constant rate in a periodic cell.
# This notebook packs them, shears them until they are steady, looks at the forces between them, and
# explains the force ratio. `QUICK=1` in the environment makes everything smaller.

# %%
import os

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.analysis.contacts import cluster_share, clusters
from jaxgran.model.display import with_error
from jaxgran.sampling.averages import averages

jax.config.update("jax_enable_x64", True)
jg.use_cache()
plt.rcParams.update({"font.size": 8, "figure.dpi": 150, "figure.constrained_layout.use": True})
quick = bool(os.environ.get("QUICK"))
grains, strain = (64, 2.0) if quick else (256, 16.0)

# %% [markdown]
# ## A flow
#
# A flow is a few numbers. The restitution α is the normal velocity after a collision over that
# before, the packing fraction ν the area of the grains over that of the cell. Lengths are in mean
# diameters σ, masses in those of a mean grain, times in the inverse shear rate 1/γ̇.

# %%
flow = jg.ShearFlow(grains=grains, restitution=0.3, packing_fraction=0.76, timestep=1e-3)
flow

# %% [markdown]
# ## From a packing to a steady flow
#
# `heated` packs the discs without overlap and gives them random velocities. The flow then forgets
# this start: the shear heats the grains, their collisions cool them, and the two come into balance.

# %%
start = jg.heated(flow, jax.random.key(0), temperature=4.0)
_, transient = jg.sample(flow, start, 6.0, blocks=60)
blocks = averages(transient.tally, transient.area, grains, transient.shear_rate)

# %%
figure, axes = plt.subplots(2, 1, figsize=(3.35, 3.6), sharex=True)
middle = 0.1 * (np.arange(60) + 0.5)
axes[0].plot(middle, blocks["granular_temperature"], "k-")
axes[0].set(ylabel=r"temperature $T$ / $m\sigma^2\dot\gamma^2$", ylim=0)
axes[1].plot(middle, blocks["pressure"], "k-")
axes[1].set(xlabel=r"strain $\dot\gamma t$", ylabel=r"pressure $p$ / $m\dot\gamma^2$", ylim=0)
plt.show()

# %% [markdown]
# Temperature and pressure, each averaged over a strain of 0.1. They level off within a strain of
# about one, and fluctuate as 256 grains do. `prepare` does all of this by itself: it packs, heats,
# and shears until temperature and pressure have no drift left.

# %%
state = jg.prepare(flow, jax.random.key(0), equilibrate=2.0 if quick else None)
state, sample = jg.sample(flow, state, strain)
errors = sample.errors()
print(f"N = {grains}, dt = {flow.timestep:g}, strain {strain:g}, ± one standard error")
for name in (
    "pressure",
    "shear_stress",
    "granular_temperature",
    "coordination_number",
    "force_ratio",
):
    print(f"{name:22s}{with_error(float(sample.averages[name]), float(errors[name]))}")
print("status:", jg.Status(int(sample.status)).name)

# %% [markdown]
# ## Contact forces
#
# A series of snapshots, one at each of twenty time steps. Lines join grains that push each other,
# and their width is the mean force. Red pairs collide alone. Black ones belong to clusters of three
# or more grains that push at once.

# %%
steps = 20
state, seen = jg.snapshot_series(flow, state, strain=steps * flow.timestep, count=steps)
jg.flow_figure(seen)

# %% [markdown]
# ## The force ratio
#
# Two grains that collide alone exchange the binary impulse (1 + α) m₁₂ u, with their reduced mass
# m₁₂ and their speed of approach u. The force ratio is the sum of all contact impulses over the sum
# of the binary impulses of the same contacts. Taken from the snapshots by hand, it is that of
# `jg.sample` over the same steps:

# %%
steps = 50 if quick else 500
state, _ = jg.snapshot_series(flow, state, flow.timestep, 1)
_, same = jg.sample(flow, state, steps * flow.timestep)
_, seen = jg.snapshot_series(flow, state, steps * flow.timestep, steps)
contacts, impulse = seen.contacts, np.asarray(seen.impulses)
reduced = 1 / np.where(contacts.used, contacts.inverse_mass_i + contacts.inverse_mass_j, np.inf)
binary = (1 + flow.restitution) * reduced * np.maximum(0, -contacts.approach)
print(f"N = {grains}, dt = {flow.timestep:g}, {steps} steps:", end=" ")
print(f"{impulse.sum() / binary.sum():.4f} by hand, {same.force_ratio:.4f} by jg.sample")

# %% [markdown]
# Contact by contact, binary collisions lie on the diagonal. Contacts in clusters transmit what
# their neighbours push, so most of them lie above. Some carry a force although their grains recede;
# these are not drawn.

# %%
share = cluster_share(seen)
print(
    f"N = {grains}, dt = {flow.timestep:g}, {steps} time steps, ± one standard error; in clusters "
    "are"
)
print(
    f"{with_error(*share.contacts)} of the loaded contacts, {with_error(*share.force)} of the force"
)
loaded = contacts.used & (impulse > 0)
time, slot = np.nonzero(loaded)
clustered = clusters(seen).sizes[time, contacts.i[time, slot]] > 2
x, y = binary[loaded], impulse[loaded]

# %%
figure, axes = plt.subplots(figsize=(3.35, 3.0))
for chosen, colour, label in (
    (clustered, "k", "in clusters"),
    (~clustered, "C3", "binary collisions"),
):
    axes.loglog(x[chosen], y[chosen], ".", color=colour, ms=2, label=label)
axes.set(
    xlabel=r"binary impulse / $m\sigma\dot\gamma$",
    ylabel=r"impulse / $m\sigma\dot\gamma$",
    aspect="equal",
)
axes.set(xlim=(1e-4, 10), ylim=(1e-4, 10))
axes.legend(frameon=False, markerscale=4)
plt.show()

# %% [markdown]
# ## A force ratio belongs to its time step
#
# In a shorter time step fewer grains push at once: what was a cluster becomes a succession of
# collisions of the same grains. So the force ratio falls, and the stress stays. A ratio above one
# says that the collisions *of one time step* are not binary, and is a result only together with dt.

# %%
flows = jg.ShearFlow(
    grains, 0.3, 0.76, timestep=[1e-3, 3e-4] if quick else [1e-3, 3e-4, 1e-4, 3e-5]
)
states = jg.prepare(
    flows, jax.random.split(jax.random.key(1), len(flows.timestep)), 2.0 if quick else None
)
_, samples = jg.sample(flows, states, strain)
errors = samples.errors()

for k, timestep in enumerate(flows.timestep):
    found = [
        with_error(samples.averages[name][k], errors[name][k])
        for name in ("force_ratio", "pressure")
    ]
    print(f"N = {grains}, dt = {timestep:.0e}: force ratio {found[0]}, pressure {found[1]}")

# %%
figure, axes = plt.subplots(2, 1, figsize=(3.35, 3.2), sharex=True)
labels = {"force_ratio": "force ratio", "pressure": r"pressure $p$ / $m\dot\gamma^2$"}
for panel, (name, label) in zip(axes, labels.items(), strict=True):
    values = samples.averages[name]
    panel.errorbar(flows.timestep, values, errors[name], fmt="ko-", ms=4)
    panel.set(ylabel=label, ylim=(0, 1.3 * np.max(values)))
axes[0].axhline(1, color="0.6", lw=0.8)
axes[1].set(xscale="log", xlabel=r"time step $\dot\gamma\,\mathrm{d}t$")
plt.show()

# %% [markdown]
# **Contacts carry it: in nearly elastic flow one pair at a time, in dissipative flow clusters that
# push at once.** The force ratio says how much more these push than the same pairs would alone. It
# falls as the time step becomes shorter, and the pressure does not.
