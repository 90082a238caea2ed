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
# # How much does a trajectory tell about the grains?
#
# A simulation that can be differentiated can be turned round: from how grains move, what are they? Here the restitution
# of discs is found from noisy frames of their flow.

# %%
import os
from dataclasses import replace

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.analysis.sensitivity import growth

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))

# %% [markdown]
# An observation: 60 frames over a strain of 0.3, with 1 % of noise in the velocities. Whoever fits it does not know α.

# %%
alpha, strain, frames = (0.7, 0.1, 20) if quick else (0.7, 0.3, 60)
flow = jg.ShearFlow(grains=32 if quick else 64, restitution=alpha, packing_fraction=0.6, timestep=1e-3, tolerance=1e-9)
state = jg.prepare(flow, jax.random.key(0), equilibrate=2.0)
_, series = jg.snapshot_series(flow, state, strain, frames)
seen = series.state
noise = 0.01 * np.sqrt(np.mean(np.square(seen.velocities)))
random = np.random.default_rng(0)
seen = replace(seen, velocities=seen.velocities + noise * random.normal(size=seen.velocities.shape))
strains = strain * np.arange(1, frames + 1) / frames

# %% [markdown]
# Two discs that collide, and no third, tell α by themselves. The fit finds such collisions. It estimates each of them
# from the frames before and after, with the noise in all of these, and takes the derivative of the misfit by α.

# %%
fit = jg.fit_restitution(jg.tracks_of_states(strains, seen))
print(f"restitution {fit.restitution:.4f} ± {fit.stderr:.4f}, 95 % interval {fit.low:.4f} to {fit.high:.4f}")
print(f"{fit.collisions} collisions; noise of the velocities {fit.velocity_noise:.4f} (made with {noise:.4f})")

# %% [markdown]
# Why single collisions, and not the whole run at once? Because derivatives of chaotic motion grow exponentially: beyond
# the dotted line a change of α by 0.01 moves every grain by a diameter.

# %%
figure, axis = plt.subplots(figsize=(5, 3.4), layout="constrained")
for restitution, style in ((0.5, "--"), (0.9, "-")):
    flow = jg.ShearFlow(32 if quick else 64, restitution, 0.6, 1e-4, tolerance=1e-9)
    grown = growth(flow, jg.prepare(replace(flow, timestep=1e-3), jax.random.key(1), 2.0), 0.5 if quick else 1.0, 40)
    axis.semilogy(grown.strain, grown.derivative, style, color="0.2", label=rf"$\alpha={restitution}$")
axis.axhline(100, color="0.6", ls=":", lw=1)
axis.axvline(strain / frames, color="0.6", lw=1)
axis.set_xlabel("strain since the beginning (grey line: one frame)")
axis.set_ylabel(r"$|\partial(\mathrm{state})/\partial\alpha|$ per grain")
axis.legend(frameon=False)
plt.show()
