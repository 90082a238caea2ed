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
# # How fast and how accurate is a run, and what are its gradients good for?
#
# The cost and the error of a time step, many flows at once by `jax.vmap` over restitution α and
# packing fraction ν, and a derivative that is checked against finite differences and then finds α.
# `QUICK=1` in the environment makes everything smaller.

# %%
import os
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.model.display import with_error
from jaxgran.sampling.timestep import stress_error

jax.config.update("jax_enable_x64", True)
jg.use_cache()
plt.rcParams.update({"font.size": 8, "figure.dpi": 150, "figure.constrained_layout.use": True})
quick = bool(os.environ.get("QUICK"))
grains, strain, seeds = (64, 2.0, 4) if quick else (256, 20.0, 8)

# %% [markdown]
# ## A time step costs less than it seems
#
# Steps without a contact are jumped over, so a run costs its collisions and not its steps. Several
# seeds of one flow from the same states, with ever shorter time steps. The first sample lets the
# contacts adapt, and compiles.

# %%
timesteps = [3e-3, 1e-3, 3e-4, 1e-4] + ([] if quick else [3e-5])
alpha, nu = 0.9, 0.7
flow = jg.ShearFlow(grains, np.full(seeds, alpha), nu, timestep=1e-3)
start = jg.prepare(flow, jax.random.split(jax.random.key(0), seeds), 2.0 if quick else None)
values, cost = {"pressure": [], "force_ratio": []}, []
for timestep in timesteps:
    finer = replace(flow, timestep=np.full(seeds, timestep))
    states, _ = jg.sample(finer, start, 0.5)
    begun = time.process_time()
    _, samples = jg.sample(finer, states, strain)
    cost.append(1e3 * (time.process_time() - begun) / (seeds * strain))
    for name, found in values.items():
        found.append(samples.averages[name])
mean = {name: np.mean(x, axis=1) for name, x in values.items()}
stderr = {name: np.std(x, axis=1, ddof=1) / seeds**0.5 for name, x in values.items()}
temperature = float(np.mean(samples.granular_temperature))
print(
    f"α = {alpha}, ν = {nu}, N = {grains}, {seeds} seeds of strain {strain:g}, ± one standard "
    "error over seeds"
)
for k, timestep in enumerate(timesteps):
    both = [f"{name} {with_error(mean[name][k], stderr[name][k])}" for name in values]
    print(f"dt = {timestep:.0e}: {cost[k]:6.2f} ms of a core per unit strain, {', '.join(both)}")

# %% [markdown]
# The bound on the error comes from how far a grain of thermal speed moves in a step, over the mean
# gap. `timestep="auto"` in a map chooses dt by it. The reference below is the shortest step, whose
# own error is in every bar.

# %%
figure, (axes, below) = plt.subplots(2, 1, figsize=(3.35, 4.0), sharex=True, height_ratios=(2, 1))
coarse, reference = np.array(timesteps[:-1]), {name: mean[name][-1] for name in mean}
bound = 100 * stress_error(coarse * temperature**0.5, nu)
axes.fill_between(coarse, -bound, bound, color="0.85", label="bound for the pressure")
for name, style, shift in (("pressure", "ko", 0.95), ("force_ratio", "C3s", 1.05)):
    off = 100 * (mean[name][:-1] / reference[name] - 1)
    bars = 100 * np.hypot(stderr[name][:-1], stderr[name][-1]) / reference[name]
    axes.errorbar(shift * coarse, off, bars, fmt=style, ms=4, label=name.replace("_", " "))
axes.axhline(0, color="0.5", lw=0.8)
axes.set(xscale="log", ylabel=f"difference from dt = {timesteps[-1]:.0e} (%)")
axes.legend(fontsize=7, frameon=False, loc="upper left")
below.plot(timesteps, cost, "ko-", ms=4)
below.set(
    xlabel=r"time step $\dot\gamma\,\mathrm{d}t$",
    ylabel="core time of a\nunit strain (ms)",
    ylim=(0, 1.3 * max(cost)),
)
plt.show()

# %% [markdown]
# The pressure at dt = 1e-3 is that of the shortest step within its noise. A force ratio belongs to
# its time step, so its difference is no error.
#
# ## Many flows at once
#
# `jax.vmap` over α and ν shares out the replicas to all cores and returns the same bits as a loop.
# A change of α, ν or dt compiles nothing.

# %%
size = 2 if quick else 4
alphas, nus = (
    x.ravel() for x in np.meshgrid(np.linspace(0.5, 0.9, size), np.linspace(0.4, 0.7, size))
)
flows = jg.ShearFlow(64, alphas, nus, timestep=1e-3)
states = jg.prepare(flows, jax.random.split(jax.random.key(1), len(alphas)))
run = jax.jit(jax.vmap(jg.sample, (0, 0, None)))


def loop(flows, states, strain):
    """The same, one flow after another."""
    return [jg.sample(flows[k], states[k], strain)[1].force_ratio for k in range(len(alphas))]


ways = {"a loop": loop, "jax.vmap": lambda *given: run(*given)[1].force_ratio}
ratios = {}
for name, way in ways.items():
    way(flows, states, 5.0)  # compiles
    begun = time.perf_counter()
    ratios[name] = np.asarray(way(flows, states, 5.0))
    steps = len(alphas) * 5.0 / 1e-3
    print(
        f"{name}: {1e6 * (time.perf_counter() - begun) / steps:.2f} µs per replica and time step "
        "(N = 64, dt = 1e-3)"
    )
assert np.array_equal(*ratios.values())

# %% [markdown]
# ## A derivative, checked
#
# `jg.advance` is differentiable: the contact solve by the implicit function theorem, the flight
# directly. Reverse mode needs the number of steps with contacts, `events`, in advance. Here the
# derivative of the kinetic energy after 50 steps with respect to α stands beside central
# differences.

# %%
solver = jg.BarzilaiBorwein(tolerance=1e-10)
flow = jg.ShearFlow(64, 0.6, 0.7, timestep=1e-3)
state = jg.prepare(flow, jax.random.key(2), 2.0)
steps = jnp.int32(50)
events = int(jg.count_events(flow, state, steps, solver=solver))


@jax.jit
def energy(restitution):
    """Peculiar kinetic energy after the steps, in mσ²γ̇²."""
    later = replace(flow, restitution=restitution)
    end, _ = jg.advance(later, state, steps, events=events, solver=solver)
    return jnp.sum(end.grains.masses[:, None] * end.velocities**2) / 2


exact = float(jax.jit(jax.grad(energy))(0.6))
print(f"N = 64, dt = 1e-3, {events} steps with contacts: dE/dα = {exact:.8f} by jax.grad")
widths = np.logspace(-8, -3, 11)
differences = np.array([float(energy(0.6 + h) - energy(0.6 - h)) / (2 * h) for h in widths])
best = int(np.argmin(abs(differences - exact)))
print(
    f"central differences agree to {abs(differences[best] / exact - 1):.0e} at h = "
    f"{widths[best]:.0e}"
)

# %%
figure, axes = plt.subplots(figsize=(3.35, 2.4))
axes.loglog(widths, abs(differences / exact - 1), "ko-", ms=4)
axes.set(
    xlabel=r"half-width $h$ of the difference in $\alpha$",
    ylabel="relative difference from jax.grad",
)
plt.show()

# %% [markdown]
# Left, rounding and the tolerance of the solver over h; right, the truncation of the difference.
#
# ## A derivative, put to use
#
# What is the restitution of grains that were seen twice? Short windows of a flow are observed at
# their start, and at their end with noise of a thousandth of a diameter in positions.
# `jg.fit_trajectory` minimises the misfit by optax, through the simulator in reverse mode.

# %%
truth, guess, windows, dt = 0.73, 0.5, (3 if quick else 6), 1e-5
position_noise, velocity_noise = 1e-3, 1e-2
flow = jg.ShearFlow(64, truth, 0.6, timestep=dt)
starts = jg.prepare(replace(flow, timestep=1e-3), jax.random.split(jax.random.key(3), windows), 2.0)


def noisy(values, noise, seed):
    return values + noise * jax.random.normal(jax.random.key(seed), values.shape)


def fitted(strain):
    """The fit of windows of this strain, from a wrong restitution."""
    steps = round(strain / dt)
    end, _ = jax.jit(jg.advance)(flow, starts, jnp.int32(steps))
    positions, velocities = (
        noisy(end.positions, position_noise, 1),
        noisy(end.velocities, velocity_noise, 2),
    )
    seen = replace(end, positions=positions, velocities=velocities)
    return jg.fit_trajectory(
        replace(flow, restitution=guess), starts, seen, steps, position_noise, velocity_noise
    )


fits = {}
for strain in (0.02, 0.05, 1.0) if quick else (0.02, 0.05, 0.1, 0.2, 0.4, 1.0):
    try:
        fits[strain] = fitted(strain)
        print(
            f"strain {strain}: α = {with_error(fits[strain].restitution, fits[strain].stderr)}, "
            f"made with {truth}"
        )
    except jg.InputError as refused:
        print(f"strain {strain}: refused, {refused}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(6.7, 2.4))
for strain, fit in fits.items():
    axes[0].semilogy(fit.misfit, lw=1, label=f"strain {strain}")
    axes[1].errorbar(strain, fit.restitution, fit.stderr, fmt="ko", ms=4)
axes[0].axhline(1, color="0.5", lw=0.8)
axes[0].set(xlabel="iteration of Adam", ylabel=r"$\chi^2$ per degree of freedom")
axes[0].legend(fontsize=7, frameon=False)
axes[1].axhline(truth, color="C3", lw=1)
axes[1].set(xscale="log", xlabel="strain of a window", ylabel=r"restitution $\alpha$")
plt.show()

# %% [markdown]
# Red: the α that the data were made with. The error bar shrinks with the strain, as derivatives
# grow exponentially: colliding discs are chaotic. Where a change of α leads to other collisions, at
# an rms of ∂(position)/∂α of one diameter, differentiation stops to be useful, and the fit refuses
# the windows. Before that, a fit that ends in a minimum with other collisions is refused by its
# misfit.
