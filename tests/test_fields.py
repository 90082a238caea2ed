"""Fields obey the balance equations at every point, and stresses agree by every route.

Derivatives by space and time are JAX's own, so that the laws hold to rounding. Points lie in many
images of the cell.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS
from jax import lax
from scipy.integrate import quad

from jaxgran.analysis import fields as fields_module
from jaxgran.analysis.fields import Fields, fields_at, grid
from jaxgran.contact.network import Contacts
from jaxgran.dynamics.snapshot import Snapshot, collided, free_flight
from jaxgran.dynamics.snapshots import snapshot
from jaxgran.model.cell import displacement, wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

WIDTH = 0.25  # e^-39 of the Gaussian is beyond half the side
FLOW = ShearFlow(GRAINS, 0.3, 0.78, 1e-3)

one_snapshot = jax.jit(partial(snapshot, solver=EXACT))


@pytest.fixture(scope="module")
def seen(flowing, run) -> Snapshot:
    """The first snapshot, from step 50 on, with at least four loaded contacts."""
    state, _ = run(FLOW, flowing(0.78), 50)
    for _ in range(200):
        now = one_snapshot(FLOW, state)
        if int(jnp.sum(now.impulses > 0)) >= 4:
            return now
        state, _ = run(FLOW, state, 1)
    raise AssertionError("the flow has no such contacts")


@pytest.fixture(scope="module")
def points(seen) -> jax.Array:
    """Points in images near and far, among them a grain and the middle of a branch."""
    anywhere = np.random.default_rng(0).uniform(-2, 3, (38, 2)) * float(seen.state.side)
    contact = int(jnp.argmax(seen.impulses))
    centre = seen.state.positions[seen.contacts.j[contact]]
    middle = centre + seen.contacts.normals[contact] * seen.contacts.distances[contact] / 2
    return jnp.asarray(np.stack([*anywhere, centre, middle]))


@jax.jit
def plane_flux(seen: Snapshot, heights: jax.Array) -> jax.Array:
    """Momentum (heights, 2) that crosses planes y = h upwards in the step of a snapshot, per length
    and time, in mγ̇².

    Contacts whose branch crosses the plane transfer their impulse; grains that cross it in the
    flight carry their momentum relative to the mean flow at the plane. The average over heights is
    the stress Σ^{yb}.
    """
    state, contacts = collided(seen), seen.contacts
    y, (cx, cy), area = state.positions[:, 1], state.velocities.T, state.side * seen.timestep

    def crossings(start, rise, height):
        return jnp.floor((start + rise - height) / state.side) - jnp.floor(
            (start - height) / state.side
        )

    def through(height):
        crossing_impulses = (
            crossings(y[contacts.j], contacts.normals[:, 1] * contacts.distances, height)
            * seen.impulses
        )
        crossing_masses = crossings(y, seen.timestep * cy, height) * state.grains.masses
        above = y - height
        above = above - state.side * jnp.round(above / state.side)
        velocities = jnp.stack([cx + seen.shear_rate * above, cy], axis=-1)
        return (crossing_impulses @ contacts.normals + crossing_masses @ velocities) / area

    return lax.map(through, heights, batch_size=max(1, min(heights.size, 128)))


def densities(fields: Fields) -> jax.Array:
    """Mass, momentum and energy density ρ, ρV, ρe = ρV²/2 + tr Σ_k/2, (points, 4)."""
    velocity, rho = fields.velocity, fields.density[:, None]
    trace = jnp.trace(fields.kinetic_stress, axis1=1, axis2=2)[:, None]
    energy = (rho * jnp.sum(velocity**2, axis=1, keepdims=True) + trace) / 2
    return jnp.concatenate([rho, rho * velocity, energy], axis=1)


def fluxes(fields: Fields) -> jax.Array:
    """Their fluxes ρV, ρVV + Σ, ρeV + Σ·V + J_Q, (points, 4, 2)."""
    velocity, carried = fields.velocity, densities(fields)
    work = jnp.sum(fields.stress * velocity[:, None], axis=2)
    further = [jnp.zeros_like(work)[:, None], fields.stress, (work + fields.heat_flux)[:, None]]
    return carried[:, :, None] * velocity[:, None] + jnp.concatenate(further, axis=1)


def outflow(fields_of, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Divergence (points, 4) of the fluxes of fields at points, and the dissipation."""

    def flux(points):
        fields = fields_of(points)
        return fluxes(fields), fields.dissipation

    units = jnp.zeros((2, *points.shape)).at[0, :, 0].set(1).at[1, :, 1].set(1)
    slopes, loss = jax.vmap(
        lambda unit: jax.jvp(flux, (points,), (unit,), has_aux=True)[1:], out_axes=(0, None)
    )(units)
    return slopes[0, :, :, 0] + slopes[1, :, :, 1], loss


def flight_fields_at(state: State, points: jax.Array, width: float) -> Fields:
    """Fields of grains in free flight: of a snapshot whose only slot for a contact is empty."""
    index, zero = jnp.zeros(1, int), jnp.zeros(1)
    contacts = Contacts(index, index, jnp.zeros((1, 2)), zero, zero, zero, zero, index > 0)
    one = jnp.asarray(1.0)
    return fields_at(Snapshot(state, contacts, zero, one, one, one, jnp.asarray(0)), points, width)


@jax.jit
def densities_of(state, points, width):
    return densities(flight_fields_at(state, points, width))


@jax.jit
def rate_in_flight(state, points, width):
    """∂/∂t of the densities in free flight."""
    now, unit = jnp.asarray(0.0), jnp.asarray(1.0)
    return jax.jvp(
        lambda time: densities_of(free_flight(state, 1.0, time), points, width), (now,), (unit,)
    )[1]


@jax.jit
def outflow_in_flight(state, points, width):
    return outflow(lambda r: flight_fields_at(state, r, width), points)[0]


@jax.jit
def outflow_of_step(seen, points, width):
    return outflow(lambda r: fields_at(seen, r, width), points)


def assert_balanced(rate, divergence, loss=0.0) -> None:
    scale = np.max(np.abs(divergence))
    assert scale > 0.1  # so that there was something to compare
    np.testing.assert_allclose(rate, -divergence - loss, rtol=0, atol=1e-11 * scale)


def test_mass_momentum_and_energy_are_balanced_in_flight_at_every_point(seen, points) -> None:
    """∂ρ/∂t = −∇·(ρV), ∂(ρV)/∂t = −∇·(ρVV + Σ_k), ∂(ρe)/∂t = −∇·(ρeV + Σ_k·V + J_Q)."""
    flying, width = collided(seen), WIDTH
    rate, diverging = (of(flying, points, width) for of in (rate_in_flight, outflow_in_flight))
    for k in range(4):
        assert_balanced(rate[:, k], diverging[:, k])


def test_collisions_hand_over_momentum_and_energy_along_their_branches(seen, points) -> None:
    """ρV changes by −dt ∇·Σ_s, and ρe by −dt (∇·(Σ_s·V + J_Q) + ζ); ρ stays."""
    after, width = collided(seen), WIDTH
    rate = (
        densities_of(after, points, width) - densities_of(seen.state, points, width)
    ) / seen.timestep
    diverging, loss = outflow_of_step(seen, points, width)
    diverging = diverging - outflow_in_flight(after, points, width)
    np.testing.assert_allclose(rate[:, 0], 0, atol=0)
    for k in (1, 2):
        assert_balanced(rate[:, k], diverging[:, k])
    assert np.max(np.abs(loss)) > 0.1
    assert_balanced(rate[:, 3], diverging[:, 3], loss)


def test_a_step_of_the_engine_is_balanced_to_the_order_of_its_flight(
    flowing, run, seen, points
) -> None:
    """With the fields of the snapshot to first order in dt; with fluxes of mid-flight to second."""
    width, residuals = WIDTH, []
    for timestep in (1e-3, 5e-4, 2.5e-4):
        flow = replace(FLOW, timestep=timestep)
        now = one_snapshot(flow, seen.state)
        assert jnp.sum(now.impulses > 0) >= 1  # an overlap stays one
        begin, end = (
            densities_of(x, points, width) for x in (seen.state, run(flow, seen.state, 1)[0])
        )
        diverging, loss = outflow_of_step(now, points, width)
        begun, halfway = (
            outflow_in_flight(free_flight(collided(now), 1.0, t), points, width)
            for t in (0, timestep / 2)
        )
        first = (end - begin) / timestep + diverging + loss[:, None] * jnp.asarray([[0, 0, 0, 1.0]])
        residuals.append([np.max(np.abs(x), axis=0) for x in (first, first + halfway - begun)])
    orders = -np.diff(np.log2(residuals), axis=0)
    np.testing.assert_allclose(orders[:, 0], 1, atol=0.3)
    np.testing.assert_allclose(orders[:, 1], 2, atol=0.3)


def test_averages_over_the_cell_are_the_virial_sums(seen) -> None:
    """<Σ_s> = (1/A) Σ σF; <Σ_k + ρ(V − γ̇y)²> = (1/A) Σ m c c + γ̇² w² (1/A) Σ m x̂x̂.

    An image at the height d above the point is slower by γ̇d than its peculiar velocity says.
    """
    width, area, count, tolerance = 0.3, float(seen.state.side) ** 2, 64, 1e-7
    points = grid(seen.state.side, count)
    fields = fields_at(seen, points, width)
    mean = partial(np.mean, axis=0)
    contacts, force = seen.contacts, np.asarray(seen.impulses / seen.timestep)
    normals = np.asarray(contacts.normals)
    virial = (
        np.einsum("c,ca,cb->ab", force * np.asarray(contacts.distances), normals, normals) / area
    )
    np.testing.assert_allclose(
        mean(fields.contact_stress), virial, rtol=0, atol=tolerance * np.max(np.abs(virial))
    )

    masses, c = np.asarray(seen.state.grains.masses), np.asarray(collided(seen).velocities)
    moment = np.einsum("i,ia,ib->ab", masses, c, c) / area
    moment[0, 0] += width**2 * np.sum(masses) / area
    apart = np.array(fields.velocity)
    apart[:, 0] -= np.asarray(points)[:, 1]
    flow = np.asarray(fields.density)[:, None, None] * apart[:, :, None] * apart[:, None, :]
    np.testing.assert_allclose(
        mean(fields.kinetic_stress + flow), moment, rtol=0, atol=tolerance * np.max(moment)
    )
    np.testing.assert_allclose(mean(fields.density), np.sum(masses) / area, rtol=tolerance)
    np.testing.assert_allclose(mean(fields.number_density), GRAINS / area, rtol=tolerance)
    loss = np.sum(masses[:, None] * (np.asarray(seen.state.velocities) ** 2 - c**2)) / 2
    # the shear works on the contact stress while they touch
    loss -= float(seen.timestep) * virial[0, 1] * area
    np.testing.assert_allclose(
        mean(fields.dissipation), loss / (area * float(seen.timestep)), rtol=1e-5
    )


def test_a_traced_width_that_does_not_fit_into_the_cell_makes_fields_nan(seen, points) -> None:
    """As nobody can be told; and so for a traced snapshot."""
    widest = (float(seen.state.side) / 2 - float(seen.state.grains.radii.max())) / 6
    traced = jax.jit(lambda seen, width: fields_at(seen, points, width))
    for width in (0.99 * widest, 1.01 * widest, -0.1):
        fields = traced(seen, width)
        assert all(np.isnan(x).all() == (width != 0.99 * widest) for x in jax.tree.leaves(fields))


def test_fields_are_those_of_every_image(seen, points) -> None:
    """At r + lattice vector the velocity has γ̇L more a row; images of grains are nothing."""
    width, side, tilt = 0.3, seen.state.side, seen.state.tilt
    here = fields_at(seen, points, width)
    for columns, rows in ((1, 0), (0, 1), (-3, 2)):
        shift = jnp.stack([(columns + rows * tilt) * side, rows * side])
        there = fields_at(seen, points + shift[None], width)
        moved = there.velocity - jnp.stack([rows * side, jnp.zeros(())])[None]
        assert_same(replace(there, velocity=moved), here, 1e-9)
    vectors = np.random.default_rng(1).integers(-2, 3, (GRAINS, 2)).astype(float)
    elsewhere = seen.state.positions + side * jnp.stack(
        [vectors[:, 0] + tilt * vectors[:, 1], vectors[:, 1]], axis=1
    )
    assert_same(
        fields_at(replace(seen, state=replace(seen.state, positions=elsewhere)), points, width),
        here,
        1e-9,
    )
    offset = jnp.asarray([[0.37, -1.21]])
    moved = replace(seen.state, positions=wrap(seen.state.positions + offset, side, tilt))
    there = fields_at(replace(seen, state=moved), points + offset, width)
    assert_same(replace(there, velocity=there.velocity - jnp.asarray([[-1.21, 0.0]])), here, 1e-9)


def assert_same(one: Fields, other: Fields, tolerance: float) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * max(1, np.max(np.abs(b))))


def test_blocks_out_of_reach_are_skipped_without_a_trace(seen, points, monkeypatch) -> None:
    """Grains and contacts in one block, of which none is skipped, and in blocks of four."""
    width = 0.1
    whole = fields_at(seen, points, width)
    monkeypatch.setattr(fields_module, "_BLOCK", 4)
    in_blocks = jax.jit(fields_module._fields_at.__wrapped__)(seen, points, width)
    assert_same(in_blocks, whole, 1e-14)


def test_two_discs_that_collide_have_known_fields(scene) -> None:
    """Head on along x at ±1 and drifting at (3, 2): between them, at the centre of mass."""
    state = scene([[8.5, 8.0], [7.5, 8.0]], [[2.0, 2.0], [4.0, 2.0]])
    flow = ShearFlow(GRAINS, 0.5, 0.02, 1e-3)
    seen, width = one_snapshot(flow, state), 0.3
    fields = fields_at(seen, jnp.full((40, 2), 8.0), width)
    g = np.exp(-(0.5**2) / (2 * width**2)) / (2 * np.pi * width**2)
    line = quad(lambda x: np.exp(-(x**2) / (2 * width**2)) / (2 * np.pi * width**2), -0.5, 0.5)[0]
    impulse, loss = 1.5, 0.75  # (1 + α) μ u and ½ (1 − α²) μ u² with μ = ½ and u = 2
    xx = np.array([[1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(fields.density, 2 * g)
    np.testing.assert_allclose(fields.number_density, 2 * g)
    np.testing.assert_allclose(fields.velocity[0], [3.0, 2.0], rtol=1e-10)
    np.testing.assert_allclose(
        fields.contact_stress[0], impulse / 1e-3 * line * xx, rtol=1e-10, atol=1e-9
    )
    np.testing.assert_allclose(
        fields.kinetic_stress[0], 2 * g * 0.5**2 * xx, rtol=1e-10, atol=1e-10
    )
    np.testing.assert_allclose(fields.temperature, 0.5**2 / 2, rtol=1e-10)
    np.testing.assert_allclose(fields.dissipation, loss / 1e-3 * g, rtol=1e-10)
    np.testing.assert_allclose(fields.heat_flux, 0, atol=1e-9)
    np.testing.assert_allclose(densities(fields)[:, 3], g * (0.5**2 + 3**2 + 2**2), rtol=1e-10)


@pytest.mark.parametrize("width", [0.25, 0.37])
def test_temperature_has_nothing_of_the_mean_flow_whose_share_of_the_kinetic_stress_is_known(
    seen, width: float
) -> None:
    """The mean flow is cold; other grains have the weighted variance of peculiar velocities."""
    still = replace(seen.state, velocities=jnp.zeros_like(seen.state.velocities))
    points = grid(still.side, 24)
    cold = flight_fields_at(still, points, width)
    np.testing.assert_allclose(cold.temperature, 0, atol=1e-12)
    xx = cold.kinetic_stress[:, 0, 0] + cold.density * (cold.velocity[:, 0] - points[:, 1]) ** 2
    assert jnp.mean(xx) == pytest.approx(width**2 * float(jnp.mean(cold.density)), rel=1e-4)
    drift = replace(seen.state, velocities=jnp.full_like(still.velocities, 3.0))
    np.testing.assert_allclose(flight_fields_at(drift, points, width).temperature, 0, atol=1e-12)
    point, state = points[7], seen.state
    apart = displacement(point[None], state.positions, state.side, state.tilt)
    weight = jnp.exp(-jnp.sum(apart**2, axis=1) / (2 * width**2))
    mass, c = state.grains.masses * weight, state.velocities
    mean = mass @ c / jnp.sum(mass)
    expected = jnp.sum(mass[:, None] * (c - mean[None]) ** 2) / (2 * jnp.sum(weight))
    hot = flight_fields_at(state, point[None], width).temperature
    np.testing.assert_allclose(hot, expected, rtol=1e-9, atol=1e-12)


def virial_stress(seen: Snapshot) -> np.ndarray:
    """Σ^{yb}: of the contacts, and of the grains over their flight, where c_x falls by γ̇ c_y t."""
    area, dt = float(seen.state.side) ** 2, float(seen.timestep)
    normals = np.asarray(seen.contacts.normals)
    pushed = np.asarray(seen.impulses * seen.contacts.distances) / dt
    masses, c = np.asarray(seen.state.grains.masses), np.array(collided(seen).velocities)
    c[:, 0] -= c[:, 1] * dt / 2
    return ((pushed * normals[:, 1]) @ normals + (masses * c[:, 1]) @ c) / area


def test_momentum_through_planes_of_all_heights_is_the_virial_stress(seen) -> None:
    """The flux is linear between the heights at which a branch or a flight begins or ends."""
    side, y = float(seen.state.side), np.asarray(seen.state.positions)[:, 1]
    start = y[np.asarray(seen.contacts.j)]
    rise = np.asarray(seen.contacts.normals)[:, 1] * np.asarray(seen.contacts.distances)
    flight = float(seen.timestep) * np.asarray(collided(seen).velocities)[:, 1]
    edges = np.unique(
        np.concatenate([[0, side], *(x % side for x in (start, start + rise, y, y + flight))])
    )
    flux = plane_flux(seen, jnp.asarray((edges[1:] + edges[:-1]) / 2))
    mean = np.diff(edges) @ np.asarray(flux) / side
    np.testing.assert_allclose(mean, virial_stress(seen), rtol=0, atol=1e-10 * np.max(np.abs(mean)))


def test_a_void_moves_with_the_mean_flow(scene) -> None:
    state = scene([[8.5, 8.0]], [[2.0, 2.0]])
    fields = flight_fields_at(state, jnp.asarray([[15.0, 14.0], [8.6, 8.0]]), 0.2)
    np.testing.assert_allclose(fields.velocity, [[14.0, 0.0], [2.0 + 0.0, 2.0]], rtol=1e-14)
    np.testing.assert_allclose(fields.density, [0, np.exp(-(0.5**2) / 2) / (0.08 * np.pi)])
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(fields))
    np.testing.assert_allclose(fields.temperature, 0, atol=1e-14)
