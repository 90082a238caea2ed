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
# We shear rigid discs that lose energy when they collide, and look at the forces between them.
# `QUICK=1` in the environment makes everything smaller.

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
# The restitution α is the normal velocity after a collision over that before, the packing fraction
# ν the area of the grains over that of the cell. Units are the mean diameter σ, the mass m of a
# grain of that diameter, and the shear rate γ̇.

# %%
flow = jg.ShearFlow(grains=grains, restitution=0.3, packing_fraction=0.76, timestep=1e-3)
flow

# %% [markdown]
# ## From a packing to a steady flow
#
# `heated` gives packed discs random velocities. Shear then heats the grains and collisions cool
# them, until the two balance:

# %%
start = jg.heated(flow, jax.random.key(0), temperature=4.0)
_, transient = jg.sample(flow, start, 6.0, blocks=60)
blocks = averages(transient.tally, transient.area, grains, transient.flow.shear_rate)

# %%
figure, axes = plt.subplots(2, 1, figsize=(3.35, 3.6), sharex=True)
middle = 0.1 * (np.arange(60) + 0.5)
axes[0].plot(middle, blocks["granular_temperature"], "k-")
axes[0].set(ylabel=r"temperature $T$ / $m\sigma^2\dot\gamma^2$", ylim=0)
axes[1].plot(middle, blocks["pressure"], "k-")
axes[1].set(xlabel=r"strain $\dot\gamma t$", ylabel=r"pressure $p$ / $m\dot\gamma^2$", ylim=0)
plt.show()

# %% [markdown]
# `prepare` does all of this, until neither temperature nor pressure drifts:

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
# Over twenty time steps, lines join grains that push each other. Red pairs collide alone, black
# ones are in clusters of three or more grains.

# %%
steps = 20
state, snapshots = jg.snapshot_series(flow, state, strain=steps * flow.timestep, count=steps)
jg.flow_figure(snapshots)

# %% [markdown]
# ## The force ratio
#
# The force ratio is the sum of all impulses J over the sum of the binary impulses, (1 + α)
# m<sub>ij</sub> max(0, −u⁻), of the same contacts, with the reduced mass m<sub>ij</sub> and the
# relative normal velocity u⁻ before the step (Lois, Lemaître and Carlson, *Momentum transport in
# granular flows*). By hand and by `jg.sample`, with solves to a tolerance at which both are one
# trajectory:

# %%
steps = 50 if quick else 500
exact = jg.BarzilaiBorwein(tolerance=1e-10, max_steps=20_000)
after, _ = jg.snapshot_series(flow, state, flow.timestep, 1)  # where the first snapshot is taken
_, over_steps = jg.sample(flow, after, steps * flow.timestep, solver=exact)
_, snapshots = jg.snapshot_series(flow, state, steps * flow.timestep, steps, solver=exact)
contacts, impulse = snapshots.contacts, np.asarray(snapshots.impulses)
reduced = 1 / np.where(contacts.used, contacts.inverse_mass_i + contacts.inverse_mass_j, np.inf)
binary = (1 + flow.restitution) * reduced * np.maximum(0, -contacts.approach)
print(f"N = {grains}, dt = {flow.timestep:g}, {steps} steps:", end=" ")
print(f"{impulse.sum() / binary.sum():.5f} by hand, {over_steps.force_ratio:.5f} by jg.sample")

# %% [markdown]
# Binary collisions lie on the diagonal, most contacts in clusters above it. Receding contacts have
# no binary impulse and are not drawn.

# %%
share = cluster_share(snapshots)
print(
    f"N = {grains}, dt = {flow.timestep:g}, {steps} time steps, ± one standard error; in clusters "
    "are"
)
print(
    f"{with_error(*share.contacts)} of the loaded contacts, {with_error(*share.force)} of the force"
)
loaded = contacts.used & (impulse > 0)
time, slot = np.nonzero(loaded)
clustered = clusters(snapshots).sizes[time, contacts.i[time, slot]] > 2
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
    ylabel=r"impulse $J$ / $m\sigma\dot\gamma$",
    aspect="equal",
)
axes.set(xlim=(1e-4, 10), ylim=(1e-4, 10))
axes.legend(frameon=False, markerscale=4)
plt.show()

# %% [markdown]
# ## The time step
#
# A force ratio means nothing without its time step. In a shorter one a cluster is a succession of
# collisions of the same grains, so the force ratio falls while the stress stays.

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
    texts = [
        with_error(samples.averages[name][k], errors[name][k])
        for name in ("force_ratio", "pressure")
    ]
    print(f"N = {grains}, dt = {timestep:.0e}: force ratio {texts[0]}, pressure {texts[1]}")

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
# ## A map with `jax.vmap`
#
# The same function for every restitution and packing fraction at once: the shear stress over that
# of the same contacts as binary collisions.

# %%
alphas, nus = np.meshgrid([0.3, 0.9] if quick else [0.1, 0.3, 0.5, 0.7, 0.9], [0.5, 0.6, 0.7, 0.76])
flows = jg.ShearFlow(grains, alphas.ravel(), nus.ravel(), timestep=1e-3)
keys = jax.random.split(jax.random.key(2), alphas.size)
states = jg.prepare(flows, keys, 2.0 if quick else None)
_, samples = jax.vmap(jg.sample, (0, 0, None))(flows, states, 2 * strain)
ratio, error = samples.stress_ratio[:, 0, 1], samples.errors()["stress_ratio"][:, 0, 1]

# %%
figure, axes = plt.subplots(figsize=(3.35, 2.4))
for nu, marker in zip(np.unique(nus), "os^D", strict=True):
    at = nus.ravel() == nu
    axes.errorbar(
        alphas.ravel()[at], ratio[at], error[at], fmt=f"{marker}-", ms=4, label=rf"$\nu={nu:g}$"
    )
axes.axhline(1, color="0.6", lw=0.8)
axes.set(xlabel=r"restitution $\alpha$", ylabel="shear stress over that\nof binary collisions")
axes.legend(frameon=False, ncols=2)
plt.show()

# %% [markdown]
# **Contacts carry it, and in dissipative flow clusters of grains that push at once carry much of
# it.** The force ratio says how much more these push than the same pairs would alone, at the given
# time step.
