"""Fields obey the balance equations at every point, and stresses agree by every route.

Derivatives by space and time are JAX's own, so that the laws hold to rounding. Points lie in many
images of the cell.
"""

from dataclasses import replace
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jax import lax
from scipy.integrate import quad

from jaxgran.analysis.coarse_graining import CoarseGraining, gaussian, lucy
from jaxgran.analysis.fields import Fields, fields_at, grid
from jaxgran.contact.network import Contacts
from jaxgran.dynamics.snapshots import Snapshot, collided, flown, snapshot
from jaxgran.model.cell import wrap
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

KERNELS = {"gaussian": gaussian, "lucy": lucy}
SMOOTH = {
    "gaussian": gaussian(0.25),
    "lucy": lucy(1.9),
}  # e^-39 of the Gaussian is beyond half the side
FLOW = ShearFlow(GRAINS, 0.3, 0.78, 1e-3)

one_snapshot = jax.jit(partial(snapshot, solver=EXACT))
every_kernel = pytest.mark.parametrize("name", KERNELS)
smooth_kernels = pytest.mark.parametrize("name", SMOOTH)


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
    """Some points in images of the cell near and far, among them a grain and the middle of a
    branch.
    """
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
    """Mass, momentum and energy density, (points, 4)."""
    return jnp.concatenate(
        [fields.density[:, None], fields.momentum, fields.energy[:, None]], axis=1
    )


def fluxes(fields: Fields) -> jax.Array:
    """Their fluxes, (points, 4, 2)."""
    rows = fields.momentum[:, None], fields.momentum_flux, fields.energy_flux[:, None]
    return jnp.concatenate(rows, axis=1)


def outflow(fields_of, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Divergence (points, 4) of the fluxes of a function that gives fields at points, and the
    dissipation.
    """

    def flux(points):
        fields = fields_of(points)
        return fluxes(fields), fields.dissipation

    units = jnp.zeros((2, *points.shape)).at[0, :, 0].set(1).at[1, :, 1].set(1)
    slopes, loss = jax.vmap(
        lambda unit: jax.jvp(flux, (points,), (unit,), has_aux=True)[1:], out_axes=(0, None)
    )(units)
    return slopes[0, :, :, 0] + slopes[1, :, :, 1], loss


def flight_fields_at(state: State, points: jax.Array, graining: CoarseGraining) -> Fields:
    """Fields of grains in free flight: of a snapshot whose only slot for a contact is empty."""
    index, zero = jnp.zeros(1, int), jnp.zeros(1)
    contacts = Contacts(index, index, jnp.zeros((1, 2)), zero, zero, zero, zero, index > 0)
    one = jnp.asarray(1.0)
    return fields_at(
        Snapshot(state, contacts, zero, one, one, one, jnp.asarray(0)), points, graining
    )


@jax.jit
def densities_of(state, points, graining):
    return densities(flight_fields_at(state, points, graining))


@jax.jit
def rate_in_flight(state, points, graining):
    """∂/∂t of the densities in free flight."""
    now, unit = jnp.asarray(0.0), jnp.asarray(1.0)
    return jax.jvp(
        lambda time: densities_of(flown(state, 1.0, time), points, graining), (now,), (unit,)
    )[1]


@jax.jit
def outflow_in_flight(state, points, graining):
    return outflow(lambda r: flight_fields_at(state, r, graining), points)[0]


@jax.jit
def outflow_of_step(seen, points, graining):
    return outflow(lambda r: fields_at(seen, r, graining), points)


def assert_balanced(rate, divergence, loss=0.0) -> None:
    scale = np.max(np.abs(divergence))
    assert scale > 0.1  # so that there was something to compare
    np.testing.assert_allclose(rate, -divergence - loss, rtol=0, atol=1e-11 * scale)


@every_kernel
@pytest.mark.parametrize("width", [0.3, 1.7])
def test_coarse_graining_is_normalised_and_its_second_moment_known(name: str, width: float) -> None:
    graining = KERNELS[name](width)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    top = 2 * graining.reach if name == "gaussian" else graining.reach
    r, weights = top * (nodes + 1) / 2, top * weights / 2
    values = np.asarray(graining.value(jnp.asarray(np.stack([0.6 * r, 0.8 * r], axis=1))))
    np.testing.assert_allclose(np.sum(weights * 2 * np.pi * r * values), 1, rtol=1e-13)
    np.testing.assert_allclose(
        np.sum(weights * np.pi * r**3 * values), graining.second_moment, rtol=1e-13
    )
    beyond = graining.value(jnp.asarray([[graining.reach * 1.0001, 0.0]]))
    assert beyond[0] <= 1.6e-8 * graining.value(jnp.zeros((1, 2)))[0]


PROFILES = {
    "gaussian": lambda q: np.exp(-(q**2) / 2) / (2 * np.pi),
    "lucy": lambda q: 5 / np.pi * (1 + 3 * q) * max(1 - q, 0) ** 3,
}


def by_quadrature(name: str, width: float, middle, angle: float, length: float) -> float:
    """The mean of G over a branch, cut where it enters the support and where it passes the
    centre.
    """
    normal = np.array([np.cos(angle), np.sin(angle)])
    middle = np.asarray(middle)
    nearest = middle @ normal
    half = np.sqrt(max(KERNELS[name](width).reach ** 2 - (middle @ middle - nearest**2), 0))
    cuts = np.clip(
        [-length / 2, nearest - half, nearest, nearest + half, length / 2], -length / 2, length / 2
    )

    def along(t: float) -> float:
        return PROFILES[name](np.linalg.norm(middle - t * normal) / width) / width**2

    return sum(quad(along, a, b, epsabs=1e-12, epsrel=1e-11)[0] for a, b in pairwise(cuts)) / length


def segment(graining: CoarseGraining, middle, angle: float, length: float) -> float:
    normal = jnp.asarray([[np.cos(angle), np.sin(angle)]])
    return float(_segment(graining, jnp.asarray([middle]), normal, jnp.asarray([length]))[0])


_segment = jax.jit(CoarseGraining.segment)
coordinates = st.floats(-3, 3).map(lambda x: round(x, 6))


@every_kernel
@settings(max_examples=60)
@given(
    middle=st.tuples(coordinates, coordinates),
    angle=st.floats(0, 6.3),
    length=st.floats(0.05, 2),
    width=st.floats(0.3, 2),
)
@example(middle=(0.0, 1.0), angle=6e-3, length=1.0, width=1.0)  # it nearly grazes the disc
def test_line_integral_is_that_of_the_function(name, middle, angle, length, width) -> None:
    graining = KERNELS[name](width)
    expected = by_quadrature(name, width, middle, angle, length)
    assert segment(graining, middle, angle, length) == pytest.approx(expected, rel=1e-9, abs=1e-10)


@jax.jit
def spread(graining, d):
    """G at a separation and over a branch along x of length one."""
    over = graining.segment(d[None], jnp.asarray([[1.0, 0.0]]), jnp.asarray([1.0]))
    return graining.value(d[None])[0] + over[0]


spread_backward, spread_forward = (
    jax.jit(slope(spread, argnums=(0, 1))) for slope in (jax.grad, jax.jacfwd)
)


@smooth_kernels
@pytest.mark.parametrize(
    "middle", [(0.0, 0.0), (0.3, 0.0), (0.0, 1.9), (0.0, 1.9 - 1e-9), (0.2, 0.1)]
)
def test_derivatives_exist_everywhere(name: str, middle) -> None:
    """At the centre, on the branch and at the edge of the support, in both modes."""
    graining, d, h = (
        replace(SMOOTH[name], width=jnp.asarray(SMOOTH[name].width)),
        jnp.asarray(middle),
        1e-5,
    )

    def difference(wider: float, step: jax.Array) -> jax.Array:
        above, below = (
            spread(replace(graining, width=graining.width + s * wider), d + s * step)
            for s in (1, -1)
        )
        return (above - below) / (2 * h)

    x, y = h * jnp.eye(2)
    expected = [difference(h, 0 * x), difference(0.0, x), difference(0.0, y)]
    for slopes in (spread_backward, spread_forward):
        wide, apart = slopes(graining, d)
        np.testing.assert_allclose([wide.width, *apart], expected, rtol=1e-6, atol=1e-6)


@smooth_kernels
def test_mass_momentum_and_energy_are_balanced_in_flight_at_every_point(
    seen, points, name: str
) -> None:
    """∂ρ/∂t = −∇·(ρV), ∂(ρV)/∂t = −∇·(ρVV + Σ_k), ∂(ρe)/∂t = −∇·(ρeV + Σ_k·V + J_Q)."""
    flying, graining = collided(seen), SMOOTH[name]
    rate, diverging = (of(flying, points, graining) for of in (rate_in_flight, outflow_in_flight))
    for k in range(4):
        assert_balanced(rate[:, k], diverging[:, k])


@smooth_kernels
def test_collisions_hand_over_momentum_and_energy_along_their_branches(
    seen, points, name: str
) -> None:
    """ρV changes by −dt ∇·Σ_s, and ρe by −dt (∇·(Σ_s·V + J_Q) + ζ); ρ stays."""
    after, graining = collided(seen), SMOOTH[name]
    rate = (
        densities_of(after, points, graining) - densities_of(seen.state, points, graining)
    ) / seen.timestep
    diverging, loss = outflow_of_step(seen, points, graining)
    diverging = diverging - outflow_in_flight(after, points, graining)
    np.testing.assert_allclose(rate[:, 0], 0, atol=0)
    for k in (1, 2):
        assert_balanced(rate[:, k], diverging[:, k])
    assert np.max(np.abs(loss)) > 0.1
    assert_balanced(rate[:, 3], diverging[:, 3], loss)


def test_a_step_of_the_engine_is_balanced_to_the_order_of_its_flight(
    flowing, run, seen, points
) -> None:
    """With the fields of the snapshot to first order in dt; with the carried fluxes of mid-flight
    to second order.
    """
    graining, residuals = SMOOTH["gaussian"], []
    for timestep in (1e-3, 5e-4, 2.5e-4):
        flow = replace(FLOW, timestep=timestep)
        now = one_snapshot(flow, seen.state)
        assert jnp.sum(now.impulses > 0) >= 1  # an overlap stays one
        begin, end = (
            densities_of(x, points, graining) for x in (seen.state, run(flow, seen.state, 1)[0])
        )
        diverging, loss = outflow_of_step(now, points, graining)
        begun, halfway = (
            outflow_in_flight(flown(collided(now), 1.0, t), points, graining)
            for t in (0, timestep / 2)
        )
        first = (end - begin) / timestep + diverging + loss[:, None] * jnp.asarray([[0, 0, 0, 1.0]])
        residuals.append([np.max(np.abs(x), axis=0) for x in (first, first + halfway - begun)])
    orders = -np.diff(np.log2(residuals), axis=0)
    np.testing.assert_allclose(orders[:, 0], 1, atol=0.3)
    np.testing.assert_allclose(orders[:, 1], 2, atol=0.3)


@smooth_kernels
def test_averages_over_the_cell_are_the_virial_sums(seen, name: str) -> None:
    """<Σ_s> = (1/A) Σ σF; <Σ_k + ρ(V − γ̇y)²> = (1/A) Σ m c c + γ̇² w₂ (1/A) Σ m x̂x̂, w₂ the
    second moment of G.

    An image at the height d above the point is slower by γ̇d than its peculiar velocity says.
    """
    graining, area = (
        {"gaussian": gaussian(0.3), "lucy": lucy(2.0)}[name],
        float(seen.state.side) ** 2,
    )
    count, tolerance = (64, 1e-7) if name == "gaussian" else (96, 1e-6)
    points = grid(seen.state.side, count)
    fields = fields_at(seen, points, graining)
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
    moment[0, 0] += float(graining.second_moment) * np.sum(masses) / area
    apart = np.array(fields.velocity)
    apart[:, 0] -= np.asarray(points)[:, 1]
    flow = np.asarray(fields.density)[:, None, None] * apart[:, :, None] * apart[:, None, :]
    np.testing.assert_allclose(
        mean(fields.kinetic_stress + flow), moment, rtol=0, atol=tolerance * np.max(moment)
    )
    np.testing.assert_allclose(mean(fields.density), np.sum(masses) / area, rtol=tolerance)
    np.testing.assert_allclose(mean(fields.number_density), GRAINS / area, rtol=tolerance)
    loss = np.sum(masses[:, None] * (np.asarray(seen.state.velocities) ** 2 - c**2)) / 2
    loss -= (
        float(seen.timestep) * virial[0, 1] * area
    )  # the shear works on the contact stress while they touch
    np.testing.assert_allclose(
        mean(fields.dissipation), loss / (area * float(seen.timestep)), rtol=1e-5
    )


@every_kernel
def test_fields_are_those_of_every_image(seen, points, name: str) -> None:
    """At r + lattice vector the velocity has γ̇L more for every row; wrapping or moving grains to
    images is nothing.
    """
    graining, side, tilt = KERNELS[name](0.3), seen.state.side, seen.state.tilt
    here = fields_at(seen, points, graining)
    for columns, rows in ((1, 0), (0, 1), (-3, 2)):
        shift = jnp.stack([(columns + rows * tilt) * side, rows * side])
        there = fields_at(seen, points + shift[None], graining)
        moved = there.velocity - jnp.stack([rows * side, jnp.zeros(())])[None]
        assert_same(replace(there, velocity=moved), here, 1e-9)
    vectors = np.random.default_rng(1).integers(-2, 3, (GRAINS, 2)).astype(float)
    elsewhere = seen.state.positions + side * jnp.stack(
        [vectors[:, 0] + tilt * vectors[:, 1], vectors[:, 1]], axis=1
    )
    assert_same(
        fields_at(replace(seen, state=replace(seen.state, positions=elsewhere)), points, graining),
        here,
        1e-9,
    )
    offset = jnp.asarray([[0.37, -1.21]])
    moved = replace(seen.state, positions=wrap(seen.state.positions + offset, side, tilt))
    there = fields_at(replace(seen, state=moved), points + offset, graining)
    assert_same(replace(there, velocity=there.velocity - jnp.asarray([[-1.21, 0.0]])), here, 1e-9)


def assert_same(one: Fields, other: Fields, tolerance: float) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * max(1, np.max(np.abs(b))))


def test_two_discs_that_collide_have_known_fields(scene) -> None:
    """Head on along x at ±1 and drifting at (3, 2): between them, at the centre of mass."""
    state = scene([[8.5, 8.0], [7.5, 8.0]], [[2.0, 2.0], [4.0, 2.0]])
    flow = ShearFlow(GRAINS, 0.5, 0.02, 1e-3)
    seen, width = one_snapshot(flow, state), 0.3
    fields = fields_at(seen, jnp.full((40, 2), 8.0), gaussian(width))
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
    np.testing.assert_allclose(fields.energy, g * (0.5**2 + 3**2 + 2**2), rtol=1e-10)


def virial_stress(seen: Snapshot) -> np.ndarray:
    """Σ^{yb} of a step: of the contacts, and of the grains on average over their flight, where c_x
    falls by γ̇ c_y t.
    """
    area, dt = float(seen.state.side) ** 2, float(seen.timestep)
    normals, pushed = (
        np.asarray(seen.contacts.normals),
        np.asarray(seen.impulses * seen.contacts.distances) / dt,
    )
    masses, c = np.asarray(seen.state.grains.masses), np.array(collided(seen).velocities)
    c[:, 0] -= c[:, 1] * dt / 2
    return ((pushed * normals[:, 1]) @ normals + (masses * c[:, 1]) @ c) / area


def test_momentum_through_planes_of_all_heights_is_the_virial_stress(seen) -> None:
    """The flux is linear in the height between the heights at which a branch or a flight begins or
    ends.
    """
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


def test_branches_in_several_blocks_are_all_counted(seen, points, monkeypatch) -> None:
    graining, series = SMOOTH["lucy"], jax.tree.map(lambda x: x[None], seen)
    whole = fields_at(seen, points, graining)
    monkeypatch.setattr("jaxgran.analysis.fields._BRANCHES_AT_ONCE", 7)
    fewer = points[:-1]  # another shape, so that it is compiled anew
    cut = lax.map(lambda one: fields_at(one, fewer, graining), series)
    assert_same(jax.tree.map(lambda x: x[0], cut), jax.tree.map(lambda x: x[:-1], whole), 1e-11)


def test_a_void_moves_with_the_mean_flow(scene) -> None:
    state = scene([[8.5, 8.0]], [[2.0, 2.0]])
    fields = flight_fields_at(state, jnp.asarray([[15.0, 14.0], [8.6, 8.0]]), lucy(1.0))
    np.testing.assert_allclose(fields.velocity, [[14.0, 0.0], [2.0 + 0.0, 2.0]], rtol=1e-14)
    np.testing.assert_allclose(fields.density, [0, 5 / np.pi * 1.3 * 0.9**3])
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(fields))
    np.testing.assert_allclose(fields.temperature, 0, atol=1e-14)
