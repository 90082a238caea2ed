"""Structure of known point sets, networks and forces is found again, and that of a flow obeys the laws of shear."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flows import GRAINS
from synthetic import SNAPSHOTS, assert_within_errors, snapshot_of

from jaxgran.analysis.force_chains import (
    cluster_share,
    cluster_sizes,
    clusters,
    fabric,
    force_distribution,
    loaded_contacts,
)
from jaxgran.analysis.order import coordination, hexatic_order, pair_correlation, profiles
from jaxgran.analysis.series import series
from jaxgran.analysis.velocity_correlations import near_contact
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.snapshots import Snapshot, snapshot_series
from jaxgran.model.flow import ShearFlow


@pytest.fixture(scope="module")
def flow() -> ShearFlow:
    return ShearFlow(GRAINS, 0.5, 0.75, 1e-3)


@pytest.fixture(scope="module")
def seen(flow, flowing) -> Snapshot:
    return series(snapshot_series(flow, flowing(0.75), 200.0, SNAPSHOTS, solver=BarzilaiBorwein(1e-8))[1])


CHAIN_AND_PAIR = [(0, 1, 2.0), (2, 1, 1.0), (3, 4, 1.0), (4, 5, 0.0)]
ROW = np.array([[1.0, 1], [2, 1], [3, 1], [1, 5], [1, 6], [1, 7], [20, 20]])


def test_a_chain_of_three_and_a_pair() -> None:
    seen = snapshot_of(ROW[None], [CHAIN_AND_PAIR])
    found = clusters(seen)
    np.testing.assert_array_equal(found.sizes, [[3, 3, 3, 2, 2, 1, 1]])
    assert len(set(found.labels[0, :3])) == 1 and found.labels[0, 3] == found.labels[0, 4] != found.labels[0, 0]
    sizes, share, _ = cluster_sizes(seen)
    np.testing.assert_array_equal(sizes, [2, 3])
    np.testing.assert_allclose(share, [0.5, 0.5])
    np.testing.assert_allclose(cluster_sizes(seen, [2, 4, 8]).value, [0.5, 0])
    carried = cluster_share(seen)
    np.testing.assert_allclose(carried.contacts.value, 2 / 3)
    np.testing.assert_allclose([carried.force.value, carried.pressure.value], 3 / 4)


def test_shares_of_shear_stress_follow_the_directions_of_contacts() -> None:
    slanted = np.array([[1, 1], [1.6, 0.2], [2.2, -0.6], [5, 5], [5.6, 5.8]])
    share = cluster_share(snapshot_of(slanted[None], [[(0, 1, 1.0), (1, 2, 1.0), (3, 4, 0.5)]]))
    np.testing.assert_allclose(share.shear_stress.value, 2 / 1.5)  # the pair is loaded the other way
    np.testing.assert_allclose(share.pressure.value, 2 / 2.5)


def test_times_are_apart_and_errors_come_from_their_blocks() -> None:
    both = snapshot_of(np.stack([ROW, ROW]), [CHAIN_AND_PAIR, [(0, 1, 1.0)]])
    np.testing.assert_array_equal(clusters(both).sizes[1], [2, 2, 1, 1, 1, 1, 1])
    assert np.isfinite(cluster_share(both).force.error)
    one = jax.tree.map(lambda x: x[0], both)
    share = cluster_share(one)
    assert share.force.value == 0.75 and np.isnan(share.force.error)


def dimers(force, times=200, pairs=20):
    """Pairs far apart, in contact at random directions, with forces of ``force(rng, pairs)``."""
    rng = np.random.default_rng(1)
    angle = rng.uniform(0, 2 * np.pi, (times, pairs))
    first = rng.uniform(0, 40, (times, pairs, 2))
    positions = np.stack([first, first + np.stack([np.cos(angle), np.sin(angle)], axis=-1)], axis=2)
    forces = [force(rng, a) for a in angle]
    contacts = [[(2 * k, 2 * k + 1, f) for k, f in enumerate(here)] for here in forces]
    return snapshot_of(positions.reshape(times, -1, 2), contacts, tilt=0.3)


def test_exponential_forces_have_an_exponential_distribution() -> None:
    seen = dimers(lambda rng, angle: rng.exponential(3.0, angle.size))
    edges = np.linspace(0, 12, 25)
    found = force_distribution(seen, edges)
    exact = -np.diff(np.exp(-edges)) / np.diff(edges)
    assert_within_errors(found, exact, least=2e-3)
    np.testing.assert_allclose(np.sum(found.value * np.diff(edges)), 1)


def test_fabric_of_a_known_density_of_directions_and_forces() -> None:
    contact, force, at, force_at = 0.5, 0.4, -0.7, -0.5

    def forces(rng, angle):
        """Forces of the wanted mean at an angle; directions of the wanted density by rejection, as a zero force."""
        accepted = rng.uniform(0, 1 + contact, angle.size) < 1 + contact * np.cos(2 * (angle - at))
        return accepted * rng.exponential(1 + force * np.cos(2 * (angle - force_at)))

    found = fabric(dimers(forces, times=600))
    assert_within_errors(found.anisotropy, contact)
    assert_within_errors(found.direction, at)
    assert_within_errors(found.force_anisotropy, force)
    assert_within_errors(found.force_direction, force_at)
    np.testing.assert_allclose(np.trace(found.tensor.value), 1)
    # the product of both has the mean 1 + a_c a_n cos 2(θ_c − θ_n)/2, and their modes add as vectors
    turn = 2 * (at - force_at)
    exact = np.abs(contact + force * np.exp(1j * turn)) / (2 + contact * force * np.cos(turn))
    assert_within_errors(found.stress_anisotropy, exact)


def test_points_at_random_have_no_structure() -> None:
    rng = np.random.default_rng(3)
    radii = rng.uniform(0.37, 0.63, 60)
    seen = snapshot_of(rng.uniform(0, 10, (150, 60, 2)), radii=radii, side=10.0, tilt=-0.4)
    assert_within_errors(pair_correlation(seen, np.linspace(0, 3.9, 14)), 1.0)
    order = hexatic_order(seen)
    assert order.overall.value < 0.1 and order.local.value < 0.5
    assert coordination(seen).loaded.value == 0


def test_a_crystal_has_full_hexatic_order_and_six_neighbours() -> None:
    """The cell is square, so the crystal is the lattice a(1, 0), a(½, ½√3) strained by less than 1 % to close in it."""
    rows, columns = 14, 12
    side = 12.0
    k, m = np.meshgrid(np.arange(columns), np.arange(rows))
    height = side / rows
    positions = np.stack([(k + m / 2) * side / columns, m * height], axis=-1).reshape(1, -1, 2)
    seen = snapshot_of(positions, side=side, tilt=0.0, radii=0.5 * side / columns)
    order = hexatic_order(seen)
    np.testing.assert_allclose([order.overall.value, order.local.value], 1, atol=1e-2)
    found = coordination(seen, tolerance=0.02)
    np.testing.assert_allclose([found.touching.value, found.touching_without_rattlers.value], 6)
    radii = np.full(rows * columns, 0.5 * side / columns)
    radii[5] = 0.3  # a rattler
    found, left = coordination(snapshot_of(positions, side=side, radii=radii), tolerance=0.02), 6 * rows * columns - 12
    np.testing.assert_allclose(found.touching.value, left / (rows * columns))
    np.testing.assert_allclose(found.touching_without_rattlers.value, left / (rows * columns - 1))


@pytest.mark.parametrize("change", ["wrapped", "moved", "tilted"])
def test_results_are_those_of_the_periodic_flow(seen, change: str) -> None:
    few = jax.tree.map(lambda x: x[:25], seen)
    state = few.state
    side = state.side[:, None, None]
    lattice = side * np.stack([np.broadcast_to([1.0, 0.0], (25, 2)), np.stack([state.tilt, np.ones(25)], 1)], axis=1)
    if change == "wrapped":
        images = np.random.default_rng(5).integers(-2, 3, state.positions.shape)
        state = replace(state, positions=state.positions + images @ lattice)
    elif change == "moved":
        state = replace(state, positions=state.positions + np.array([1.3, -2.7]))
    else:
        state = replace(state, tilt=state.tilt + np.where(np.arange(25) % 2, 1.0, -1.0))
    other = replace(few, state=state)
    bins = np.linspace(0.2, 2.6, 7)
    for measure in (
        lambda s: pair_correlation(s, bins),
        hexatic_order,
        coordination,
        near_contact,
    ):
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-9), measure(few), measure(other))
    if change != "moved":
        np.testing.assert_allclose(profiles(few, 4).density.value, profiles(other, 4).density.value)


def test_profiles_of_known_fields() -> None:
    rng, side = np.random.default_rng(6), 10.0
    positions = rng.uniform(0, side, (50, 400, 2))
    velocities = np.stack([np.sin(2 * np.pi * positions[..., 1] / side), positions[..., 1]], axis=-1)
    found = profiles(snapshot_of(positions, velocities=velocities, side=side, shear_rate=2.0), bins=8)
    assert_within_errors(found.density, 4.0)
    edges = np.linspace(0, 2 * np.pi, 9)
    exact = -np.diff(np.cos(edges)) / np.diff(edges)
    assert_within_errors(found.peculiar_velocity, exact)
    assert_within_errors(found.laboratory_velocity, exact + 2.0 * found.laboratory_velocity.at)


# A real flow: polydisperse, dense, with clusters


def test_the_flow_is_uniform_in_density_and_shear(seen) -> None:
    found = profiles(seen, bins=5)
    density = GRAINS / float(seen.state.side[0]) ** 2
    assert_within_errors(found.density, density, least=0.1 * density)
    assert np.all(found.density.error < 0.1 * density)
    assert_within_errors(found.peculiar_velocity, 0.0)
    assert np.all(found.peculiar_velocity.error < 0.3)


def test_the_flow_does_not_crystallise(seen) -> None:
    first, second = (hexatic_order(jax.tree.map(lambda x, h=h: x[h], seen)) for h in (np.s_[:500], np.s_[500:]))
    for order in (first, second):
        assert order.overall.value < 0.25 and order.local.value < 0.6
    spread = np.hypot(first.overall.error, second.overall.error)
    assert abs(second.overall.value - first.overall.value) < 4 * spread


def test_clusters_of_two_are_binary_collisions(flow, seen) -> None:
    load, sizes = loaded_contacts(seen), clusters(seen).sizes
    slot = np.nonzero(seen.contacts.used & (seen.impulses > 0))
    contacts = seen.contacts
    reduced = 1 / (contacts.inverse_mass_i[slot] + contacts.inverse_mass_j[slot])
    binary = (1 + flow.restitution) * reduced * -contacts.approach[slot] / flow.timestep
    alone = sizes[load.time, load.i] == 2
    assert alone.sum() > 100 and (~alone).sum() > 100
    np.testing.assert_allclose(load.force[alone], binary[alone], rtol=1e-4, atol=1e-6 * binary.mean())
    share = cluster_share(seen)
    excess = load.force[~alone].sum() / binary[~alone].sum() - 1
    assert excess > 0.1 and 0.2 < share.force.value < 0.95


def test_stress_follows_from_fabric_and_force(seen) -> None:
    found = fabric(seen)
    contact, force = found.anisotropy.value, found.force_anisotropy.value
    expected = (contact + force) / (2 + contact * force)
    assert_within_errors(found.stress_anisotropy, expected, least=0.05)
    assert_within_errors(found.direction, -np.pi / 4, least=0.15)  # the axis of compression
