"""Soft discs in JAX, as a user of jax-md would write them: its spaces, its dense neighbour lists, a compiled loop.

The law is that of the LAMMPS peer: damped springs, integrated by velocity Verlet, here for the peculiar velocities
(SLLOD) and fractional coordinates that move with the sheared cell. Every step gathers the up to a dozen neighbours of
every disc in one dense array, and computes each pair twice rather than scatter. jax-md's own test for rebuilding a list
knows nothing of the shear, so the list is rebuilt after as many steps as no pair can cross its skin in.
"""

import warnings
from contextlib import ExitStack
from functools import partial
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from benchmarks.peers.problem import Discs, Flow, Run, Stress, closing_speed, damping_ratio, soft_timestep

CURVES = {"jax-md, dense": (1e4, 1e5, 1e6)}
STEPS_PER_CONTACT = 10
SKIN = 0.4
_programs: dict[tuple, tuple] = {}  # compiled once for cells of one shape


def missing() -> str | None:
    return None if find_spec("jax_md") else "The jax-md peer is left out: pip install jax-md installs it."


def begin(discs: Discs, flow: Flow, curve: str, stiffness: float, duration: float) -> Run:
    """A run at one stiffness."""
    steps = max(1, round(duration / soft_timestep(discs, flow.restitution, stiffness, STEPS_PER_CONTACT)))
    law = {
        "stiffness": stiffness,
        "damping": 2 * damping_ratio(flow.restitution) * np.sqrt(stiffness),
        "timestep": duration / steps,
        "shear_rate": flow.shear_rate,
    }
    cutoff = float(2 * discs.radii.max() + SKIN)
    with _lenient_promotions():
        allocate, advanced = _program(float(discs.side), cutoff)
        y = discs.positions[:, 1] / discs.side
        places = jnp.asarray(np.stack([discs.positions[:, 0] / discs.side - discs.tilt * y, y], axis=-1) % 1.0)
        near = allocate(places, box=_box(discs.side, 0.5), extra_capacity=2)  # the smallest cells of a tilt
    radii, masses = jnp.asarray(discs.radii), jnp.asarray(discs.masses)
    state = places, jnp.asarray(discs.velocities), jnp.asarray(np.float64(discs.tilt))

    def advance() -> Stress:
        nonlocal state
        every = max(1, int(SKIN / (closing_speed(current(), flow.shear_rate) * law["timestep"])))
        with _lenient_promotions():
            state, moments, overflow = jax.block_until_ready(
                advanced(state, near, radii, masses, law, jnp.int32(steps), jnp.int32(every))
            )
        if overflow:
            raise RuntimeError("a neighbour list of jax-md overflowed: allocate a larger one.")
        xx, xy, yy = np.asarray(moments) / (steps * discs.side**2)
        return Stress(float(xx + yy) / 2, float(-xy))

    def current() -> Discs:
        (s, c), tilt = (np.array(x) for x in state[:2]), float(state[2])
        positions = discs.side * np.stack([s[:, 0] + tilt * s[:, 1], s[:, 1]], axis=-1)
        return discs._replace(positions=positions, velocities=c, tilt=tilt)

    return Run(advance, current)


def _lenient_promotions():
    """jax-md mixes types and ranks, which stricter settings of JAX forbid or warn of."""
    stack = ExitStack()
    stack.enter_context(jax.numpy_dtype_promotion("standard"))
    stack.enter_context(jax.numpy_rank_promotion("allow"))
    stack.enter_context(warnings.catch_warnings())
    warnings.simplefilter("ignore", FutureWarning)
    return stack


def _box(side, tilt):
    return side * jnp.array([[1.0, tilt], [0.0, 1.0]])


def _program(side: float, cutoff: float) -> tuple:
    """Allocation of the neighbour list and the compiled advance, for one cell."""
    if (side, cutoff) in _programs:
        return _programs[side, cutoff]
    from jax_md import partition, space

    displacement, shift = space.periodic_general(_box(side, 0.5), fractional_coordinates=True)
    lists = partition.neighbor_list(
        displacement, _box(side, 0.5), cutoff, 0.0, fractional_coordinates=True, format=partition.Dense
    )

    def pair_sums(places, velocities, box, pairs, law):
        """Forces (discs, 2) and their moments xx, xy, yy."""
        j, touch, damping = pairs
        d = space.map_neighbor(partial(displacement, box=box))(places, places[j])
        u = velocities[j] - velocities[:, None]  # jax-md's displacements point to the neighbour
        dx, dy = d[..., 0], d[..., 1]
        ux, uy = u[..., 0] + law["shear_rate"] * dy, u[..., 1]
        distance = jnp.sqrt(dx * dx + dy * dy)
        overlap = touch - distance
        push = law["stiffness"] * overlap - damping * (ux * dx + uy * dy) / distance
        push = jnp.where(overlap > 0, push / distance, 0.0)
        fx, fy = -push * dx, -push * dy
        moments = -jnp.stack([jnp.sum(fx * dx), jnp.sum(fx * dy), jnp.sum(fy * dy)]) / 2
        return jnp.stack([jnp.sum(fx, axis=1), jnp.sum(fy, axis=1)], axis=-1), moments

    @jax.jit
    def advanced(state, near, radii, masses, law, steps, every):
        dt, shear_rate = law["timestep"], law["shear_rate"]

        def rates(forces, c):
            return forces / masses[:, None] - shear_rate * jnp.stack([c[:, 1], jnp.zeros_like(c[:, 1])], axis=-1)

        def step(_, now, pairs):
            places, c, tilt, forces, sums = now
            c = c + dt / 2 * rates(forces, c)
            box = _box(side, tilt + shear_rate * dt / 2)
            places, tilt = shift(places, c * dt, box=box), tilt + shear_rate * dt
            forces, moments = pair_sums(places, c, _box(side, tilt), pairs, law)
            c = c + dt / 2 * rates(forces, c)
            kinetic = masses @ jnp.stack([c[:, 0] ** 2, c[:, 0] * c[:, 1], c[:, 1] ** 2], axis=-1)
            return places, c, tilt, forces, sums + moments + kinetic

        def segment(now):
            done, near, (places, c, tilt, forces, sums) = now
            back = tilt >= 0.5  # the same lattice, less tilted
            places = jnp.where(back, jnp.stack([(places[:, 0] + places[:, 1]) % 1.0, places[:, 1]], axis=-1), places)
            tilt = jnp.where(back, tilt - 1.0, tilt)
            near = lists.update(places, near, box=_box(side, tilt))
            real = near.idx < len(radii)
            j = jnp.where(real, near.idx, jnp.arange(len(radii))[:, None])  # itself, which it cannot touch
            reduced = masses[:, None] * masses[j] / (masses[:, None] + masses[j])
            pairs = j, jnp.where(real, radii[:, None] + radii[j], 0.0), law["damping"] * jnp.sqrt(reduced)
            forces = jnp.where(done == 0, pair_sums(places, c, _box(side, tilt), pairs, law)[0], forces)
            count = jnp.minimum(every, steps - done)
            end = lax.fori_loop(0, count, partial(step, pairs=pairs), (places, c, tilt, forces, sums))
            return done + count, near, end

        places, c, tilt = state
        start = jnp.int32(0), near, (places, c, tilt, jnp.zeros_like(c), jnp.zeros(3))
        _, near, (places, c, tilt, _, sums) = lax.while_loop(lambda now: now[0] < steps, segment, start)
        bad = near.did_buffer_overflow | near.cell_size_too_small
        return (places, c, tilt), sums, bad

    _programs[side, cutoff] = lists.allocate, advanced
    return _programs[side, cutoff]
