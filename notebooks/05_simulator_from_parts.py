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
# # How much code is a simulator?
#
# About sixty lines, if its parts are public: the sheared cell of a state as a space of jax-md,
# jax-md's neighbour list, and the contact solver of jaxgran. `jax.vmap` runs them over restitutions
# α, packing fractions ν and seeds. The result is compared with `jg.sample`. `QUICK=1` in the
# environment makes everything smaller.

# %%
import os
import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax_md import partition

import jaxgran as jg
from jaxgran.model.display import with_error

jax.config.update("jax_enable_x64", True)
jg.use_cache()
warnings.filterwarnings(
    "ignore", "scatter inputs have incompatible types"
)  # of jax-md's lists, harmless
quick = bool(os.environ.get("QUICK"))
alphas, nus = ([0.3], [0.5, 0.7]) if quick else ([0.3, 0.9], [0.5, 0.6, 0.7])
steps, seeds = (40, 2) if quick else (2000, 8)
solver = jg.Jacobi(tolerance=1e-4)

# %% [markdown]
# ## Initial states
#
# Packed, heated and sheared until they are steady, as one batch with an axis of replicas.

# %%
points = [(alpha, nu) for alpha in alphas for nu in nus]
restitution, packing_fraction = np.repeat(points, seeds, axis=0).T
flows = jg.ShearFlow(64, restitution, packing_fraction, timestep=1e-3)
states = jg.prepare(flows, jax.random.split(jax.random.key(0), len(restitution)))

# %% [markdown]
# ## Neighbours, by jax-md
#
# The list is allocated for the densest flow and updated in every step. An update does not notice
# that the cell is sheared, so `dr_threshold=0` makes each one a new search.

# %%
densest = states[int(np.argmax(packing_fraction))]
cell = jg.jax_md_space(densest)
options = {"dr_threshold": 0.0, "disable_cell_list": True, "format": partition.OrderedSparse}
neighbours = partition.neighbor_list(cell.displacement, cell.box, r_cutoff=1.4, **options)
pairs = neighbours.allocate(densest.positions, extra_capacity=1)

# %% [markdown]
# ## One time step
#
# Pairs that half a step of free flight makes overlap are contacts. All contacts of the step are
# solved together. Then the grains fly straight in the laboratory frame, while the cell is sheared.
# Velocities of a state are those relative to the shear.


# %%
def contacts(flow, state):
    """The contact network, and whether the list of pairs was too short."""
    cell, radii = jg.jax_md_space(state), state.grains.radii
    near = pairs.update(state.positions, box=cell.box)
    used = near.idx[0] < flow.grains
    i, j = jnp.where(used, near.idx, jnp.array([[0], [1]]))
    separation = jax.vmap(cell.displacement)(state.positions[i], state.positions[j])
    velocity = state.velocities[i] - state.velocities[j]
    velocity = velocity.at[:, 0].add(flow.shear_rate * separation[:, 1])
    ahead = jnp.linalg.norm(separation + velocity * flow.timestep / 2, axis=1)
    touching = used & (ahead < radii[i] + radii[j])
    normals = jnp.where(touching[:, None], separation, 0) / jnp.linalg.norm(
        separation, axis=1, keepdims=True
    )
    approach = jnp.sum(normals * velocity, axis=1)
    network = jg.ContactNetwork(jnp.stack([i, j], axis=1), normals, state.grains.masses, approach)
    return network, near.did_buffer_overflow


def step(flow, state):
    """The state a time step later, and sums over its contacts: Σ p, Σ p of binary collisions,
    overflows.
    """
    network, overflow = contacts(flow, state)
    (i, j), masses = network.ends.T, network.masses
    impulses = jg.solve_contacts(network, flow.restitution, solver).impulses
    kicks = impulses[:, None] * network.normals
    momenta = jnp.zeros_like(state.velocities).at[i].add(kicks).at[j].add(-kicks)
    velocities = state.velocities + momenta / masses[:, None]
    drift = flow.shear_rate * flow.timestep
    sheared = replace(state, tilt=(state.tilt + drift + 0.5) % 1 - 0.5)
    flight = flow.timestep * velocities.at[:, 0].add(flow.shear_rate * state.positions[:, 1])
    positions = jg.jax_md_space(sheared).shift(state.positions, flight)
    velocities = velocities.at[:, 0].add(-drift * velocities[:, 1])
    reduced = masses[i] * masses[j] / (masses[i] + masses[j])
    binary = (1 + flow.restitution) * reduced * jnp.maximum(0, -network.approach)
    sums = jnp.stack([jnp.sum(impulses), jnp.sum(binary), overflow])
    return replace(sheared, positions=positions, velocities=velocities), sums


# %% [markdown]
# ## A run, and all of them
#
# `lax.scan` repeats the step, `vmap` adds the axis of replicas, and `jit` compiles.


# %%
@jax.jit
@jax.vmap
def run(flow, state):
    """Sums over all time steps."""
    return jnp.sum(jax.lax.scan(lambda now, _: step(flow, now), state, length=steps)[1], axis=0)


sums = run(flows, states)
assert not sums[:, 2].any()  # the list has held all pairs

# %% [markdown]
# ## Against `jg.sample`
#
# The engine of the package starts from the same states. Over 40 steps the sums of impulses agree to
# ten tolerances of the solver. Colliding discs are chaotic, so after that only averages compare:
# the force ratio Σ p over Σ p of binary collisions, with a standard error from the jackknife over
# seeds.

# %%
_, samples = jg.sample(flows, states, steps * flows.timestep, blocks=1)
tally = samples.tally


def force_ratio(impulses, binary):
    """The force ratio of each point, and its standard error."""
    impulses, binary = np.reshape(impulses, (-1, seeds)), np.reshape(binary, (-1, seeds))
    left_out = (impulses.sum(1, keepdims=True) - impulses) / (binary.sum(1, keepdims=True) - binary)
    return impulses.sum(1) / binary.sum(1), left_out.std(1) * (seeds - 1) ** 0.5


parts = force_ratio(sums[:, 0], sums[:, 1])
engine = force_ratio(tally.impulse, tally.binary_impulse)
print(f"N = 64, dt = 1e-3, {seeds} seeds of strain {steps * 1e-3:g}")
for (alpha, nu), *row in zip(points, *parts, *engine, strict=True):
    print(
        f"α = {alpha}, ν = {nu}: from parts {with_error(*row[:2])}, jg.sample "
        f"{with_error(*row[2:])},",
        end=" ",
    )
    print(f"difference {(row[0] - row[2]) / np.hypot(row[1], row[3]):+.1f} standard errors")

# %%
plt.rcParams.update({"font.size": 8, "figure.dpi": 150, "figure.constrained_layout.use": True})
figure, axes = plt.subplots(figsize=(3.35, 2.8))
for (ratio, error), mark, shift, name in (
    (parts, "o", -0.004, "from parts"),
    (engine, "s", 0.004, "jg.sample"),
):
    for k, alpha in enumerate(alphas):
        here = slice(k * len(nus), (k + 1) * len(nus))
        style = {
            "fmt": mark,
            "color": f"C{k}",
            "mfc": "white" if name == "jg.sample" else f"C{k}",
            "ms": 4,
        }
        axes.errorbar(
            np.add(nus, shift),
            ratio[here] - 1,
            error[here],
            label=rf"$\alpha={alpha}$, {name}",
            **style,
        )
axes.set(xlabel=r"packing fraction $\nu$", ylabel=r"force ratio − 1", yscale="log", xticks=nus)
axes.legend(fontsize=7, frameon=False, loc="upper left")
plt.show()
