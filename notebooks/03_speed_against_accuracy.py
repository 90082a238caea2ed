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
# # Which time step is short enough?
#
# Contact dynamics with a fixed time step dt meets grains up to half a step too early or too late. How wrong is the
# pressure for that, and what does a shorter step cost? `QUICK=1` in the environment makes everything smaller.

# %%
import os
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.sampling.timestep import automatic_timestep, expected_temperature, stress_error
from jaxgran.theory.gaussian_moments import gaussian_moments

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))
grains, strain = (64, 4.0) if quick else (256, 40.0)
timesteps = [3e-3, 1e-3, 3e-4, 1e-4] + ([] if quick else [3e-5])

# %% [markdown]
# One flow, the same start, several time steps. The numbers of a flow are traced: only the first run compiles.

# %%
flow = jg.ShearFlow(grains=grains, restitution=0.9, packing_fraction=0.78, timestep=1e-3)
start = jg.prepare(flow, jax.random.key(0), equilibrate=2.0 if quick else None)
run = jax.jit(lambda flow: jg.sample(flow, start, strain)[1])
seconds, pressure, error = [], [], []
for timestep in timesteps:
    shorter = jax.tree.map(jnp.asarray, replace(flow, timestep=timestep))
    jax.block_until_ready(run(shorter))  # compiles, once
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        sample = jax.block_until_ready(run(shorter))
        times.append(time.perf_counter() - begun)
    seconds.append(np.median(times) / strain)
    pressure.append(float(sample.pressure))
    error.append(float(sample.errors()["pressure"]))
    print(
        f"dt {timestep:7.0e}   {1e3 * seconds[-1]:6.2f} ms a unit of strain   "
        f"pressure {pressure[-1]:6.2f} ± {error[-1]:.2f}"
    )

# %% [markdown]
# Ten times shorter steps cost far less than ten times as much, because steps without a contact are never visited. The
# package bounds the error beforehand, by the share of the mean gap that a grain of thermal speed crosses in a step, and
# `jaxgran map --timestep auto` chooses by that bound.

# %%
theory = float(gaussian_moments(flow.restitution, flow.packing_fraction, 1.0, flow.polydispersity).granular_temperature)
temperature = expected_temperature(theory, flow.packing_fraction)
bound = [float(stress_error(dt * np.sqrt(temperature), flow.packing_fraction)) for dt in timesteps]
chosen = float(automatic_timestep(temperature, flow.packing_fraction, flow.activation, 0.02))
print(f"for 2 % in the stresses: dt = {chosen:.1e}")

# %% [markdown]
# Error against cost. The reference is the shortest step; its own error is part of every bar.

# %%
figure, axis = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
difference = 100 * (np.array(pressure[:-1]) / pressure[-1] - 1)
bars = 100 * np.hypot(error[:-1], error[-1]) / pressure[-1]
milliseconds = 1e3 * np.array(seconds[:-1])
axis.errorbar(milliseconds, difference, bars, fmt="ko", label="pressure, against the shortest step")
axis.plot(milliseconds, [-100 * x for x in bound[:-1]], "k_", ms=16, label="bound")
axis.plot(milliseconds, [100 * x for x in bound[:-1]], "k_", ms=16)
for x, y, dt in zip(milliseconds, difference, timesteps, strict=False):
    place = {"xytext": (10, 0), "textcoords": "offset points", "rotation": 90, "va": "center"}
    axis.annotate(f"dt = {dt:g}", (x, y), **place, fontsize="small")
axis.axhline(0, color="0.6", lw=1)
axis.margins(x=0.15)
axis.set_xlabel("time for a unit of strain (ms)")
axis.set_ylabel("error of the pressure (%)")
figure.legend(loc="outside upper center", ncols=2, frameon=False)
plt.show()
