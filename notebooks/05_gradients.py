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
# of discs is found from a file of tracked discs, as a camera makes it. No part of this program made the file: an
# event-driven simulation did (`python -m benchmarks tracked_discs`), with α = 0.73, noise of 5 µm in the positions of
# discs of 5 mm, and of 0.5 mm/s in their velocities. 5 % of the discs are missing in each frame.

# %%
import os
from dataclasses import replace

import jax
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.analysis.sensitivity import growth
from jaxgran.inference.collision_model import Collisions
from jaxgran.inference.collisions import Noise, candidates, flights_of, with_masses
from jaxgran.inference.selection import of_two_discs, without_repeats

jax.config.update("jax_enable_x64", True)
quick = bool(os.environ.get("QUICK"))
truth = 0.73

# %%
tracks = jg.read_tracks("tracked_discs.csv")
frames, discs = tracks.positions.shape[:2]
print(f"{frames} frames, {discs} tracks, diameters {tracks.diameters.min():.1f} to {tracks.diameters.max():.1f} mm")
print(f"time between frames, found by displacements over velocities: {1e3 * np.diff(tracks.time).mean():.2f} ms")

figure, axis = plt.subplots(figsize=(4.2, 4), layout="constrained")
middle = frames // 2
for k in range(discs):
    x, y = tracks.positions[:middle, k].T
    axis.plot(x, y, color="0.6", lw=0.7)
    if np.isfinite(tracks.positions[middle, k, 0]):
        axis.add_patch(plt.Circle(tracks.positions[middle, k], tracks.diameters[k] / 2, fill=False, lw=0.8))
axis.set(xlabel="x / mm", ylabel="y / mm", aspect="equal", title="Tracks of a quarter of a second")
plt.show()

# %% [markdown]
# Two discs that collide, and no third, tell α by themselves. The fit finds such collisions. It estimates each of them
# from the frames before and after, with the noise in all of these, and takes the derivative of the misfit by α.

# %%
fit = jg.fit_restitution(tracks)
print(f"restitution {fit.restitution:.4f} ± {fit.stderr:.4f}, 95 % interval {fit.low:.4f} to {fit.high:.4f}")
print(f"{fit.collisions} collisions, {fit.rejected} rejected, misfit {fit.misfit:.2f} times the noise")
print(f"noise of positions {fit.position_noise:.4f} mm, of velocities {fit.velocity_noise:.2f} mm/s")

# %% [markdown]
# What does one collision say? Its misfit χ², with its own five unknowns at their best for each α, is nearly a parabola.
# Its least point is the α of this collision, its width the error: a slow collision tells little, as its change of
# velocity is hardly larger than the noise. All of them together tell α. The grey band is where the sum is within 3.84
# of its least value.

# %%
flights, length, duration = flights_of(tracks)
noise = Noise(fit.position_noise / length, fit.velocity_noise * duration / length, fit.diameter_noise / length)
flights = with_masses(flights, noise)
collisions = Collisions(candidates(flights, noise), noise)
best = collisions.fitted(fit.restitution)
chosen = np.flatnonzero(without_repeats(collisions, best, of_two_discs(collisions, best)))
chosen = chosen[best.misfit[chosen] < 2 * collisions.freedom[chosen]]
error = 1 / np.sqrt(best.curvature[chosen])
alone = fit.restitution - best.gradient[chosen] / best.curvature[chosen]
speed = best.normal_velocity[chosen] * length / duration

figure, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
axes[0].errorbar(speed, alone, error, fmt="o", ms=3, lw=0.8, color="0.3")
axes[0].axhspan(fit.low, fit.high, color="0.85", zorder=0)
axes[0].axhline(truth, color="C3", lw=1)
axes[0].set(xlabel="normal velocity before the collision / mm/s", ylabel="restitution of each collision", ylim=(0, 1.4))
trials = np.linspace(fit.low - 0.01, fit.high + 0.01, 7 if quick else 15)
misfits = np.array([collisions.fitted(alpha, best.unknowns).misfit[chosen] for alpha in trials])
axes[1].plot(trials, misfits - misfits.min(axis=0), color="0.75", lw=0.7)
axes[1].plot(trials, misfits.sum(axis=1) - misfits.sum(axis=1).min(), "k.-", label="sum")
axes[1].axhline(3.84, color="0.5", ls=":")
axes[1].axvline(truth, color="C3", lw=1, label="made with")
axes[1].set(xlabel="restitution", ylabel=r"$\chi^2$ above its least", ylim=(0, 12))
axes[1].locator_params(axis="x", nbins=5)
axes[1].legend(frameon=False)
plt.show()

# %% [markdown]
# What if the camera gave positions only, or fewer frames? Velocities are then estimated with the fit, from the frames
# between two collisions. With fewer frames, more collisions fall between two frames or share their flights with others.


# %%
def fitted(every: int, velocities: bool) -> jg.RestitutionFit:
    thinned = jg.read_tracks("tracked_discs.csv", stride=every)
    hidden = np.full_like(thinned.velocities, np.nan)
    return jg.fit_restitution(thinned if velocities else replace(thinned, velocities=hidden))


figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
for velocities, style, shift in ((True, "ko", -0.05), (False, "ws", 0.05)):
    for every in (1, 4) if quick else (1, 2, 3, 4):
        one = fitted(every, velocities)
        name = "positions and velocities" if velocities else "positions alone"
        print(f"each {every}. frame, {name}: {one.restitution:.3f} ± {one.stderr:.3f}, {one.collisions} collisions")
        ends = [[one.restitution - one.low], [one.high - one.restitution]]
        label = name if every == 1 else None
        axis.errorbar(every + shift, one.restitution, ends, fmt=style, mec="k", ecolor="k", ms=5, lw=1, label=label)
axis.axhline(truth, color="C3", lw=1)
axis.set(xlabel="each n-th frame is used", ylabel="restitution, 95 % interval", xticks=[1, 2, 3, 4], ylim=(0.7, 0.78))
axis.legend(frameon=False, loc="upper left")
plt.show()

# %% [markdown]
# Why single collisions, and not the whole run at once, from its first frame to its last? Because derivatives of chaotic
# motion grow exponentially: beyond the dotted line a change of α by 0.01 moves every grain by a diameter.

# %%
figure, axis = plt.subplots(figsize=(5, 3.4), layout="constrained")
for restitution, style in ((0.5, "--"), (0.9, "-")):
    flow = jg.ShearFlow(32 if quick else 64, restitution, 0.6, 1e-4)
    grown = growth(flow, jg.prepare(replace(flow, timestep=1e-3), jax.random.key(1), 2.0), 0.5 if quick else 1.0, 40)
    axis.semilogy(grown.strain, grown.derivative, style, color="0.2", label=rf"$\alpha={restitution}$")
axis.axhline(100, color="0.6", ls=":", lw=1)
axis.axvline(0.005, color="0.6", lw=1)
axis.set_xlabel("strain since the beginning (grey line: one frame of the file)")
axis.set_ylabel(r"$|\partial(\mathrm{state})/\partial\alpha|$ per grain")
axis.legend(frameon=False)
plt.show()
