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
# # What is a derivative of a flow good for?
#
# The derivative of a flow with respect to its restitution α is checked against finite differences,
# and then finds α from observations. `QUICK=1` in the environment makes everything smaller.

# %%
import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxgran as jg
from jaxgran.model.display import with_error

jax.config.update("jax_enable_x64", True)
jg.use_cache()
plt.rcParams.update({"font.size": 8, "figure.dpi": 150, "figure.constrained_layout.use": True})
quick = bool(os.environ.get("QUICK"))

# %% [markdown]
# ## A derivative, checked
#
# `jg.advance` is differentiable. Reverse mode needs the number of steps with contacts, `events`, in
# advance. The derivative of the kinetic energy after 50 steps, beside central differences:

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
    end, _ = jg.advance(later, state, steps, solver=solver, engine=jg.Jax(events=events))
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
# Left: rounding and the tolerance of the solver. Right: the truncation of the difference.
#
# ## A derivative, used
#
# What is the restitution of grains that were observed twice, the second time with noise?
# `jg.fit_trajectory` minimises the misfit by optax, in reverse mode.

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
    observed = replace(end, positions=positions, velocities=velocities)
    return jg.fit_trajectory(
        replace(flow, restitution=guess), starts, observed, steps, position_noise, velocity_noise
    )


fits = {}
for strain in (0.02, 0.05, 1.0) if quick else (0.02, 0.05, 0.1, 0.2, 0.4, 1.0):
    try:
        fits[strain] = fitted(strain)
        print(
            f"strain {strain}: α = {with_error(fits[strain].restitution, fits[strain].stderr)}, "
            f"made with {truth}"
        )
    except jg.InputError as error:
        print(f"strain {strain}: refused, {error}")

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
axes[1].set_xticks(list(fits), [f"{strain:g}" for strain in fits])
axes[1].minorticks_off()
plt.show()

# %% [markdown]
# Red: the true α.
#
# **A derivative fits a parameter to observations, up to a horizon.** Colliding discs are chaotic,
# so derivatives grow exponentially with the strain, and error bars shrink. Where a change of α
# leads to other collisions a derivative is of no use, and the fit refuses.
