"""jax-md's functions on our states: pairs, structure, stresses, and where its space is wrong."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS
from test_docs import python_of

import jaxgran as jg
from jaxgran.model.cell import displacement
from jaxgran.model.state import State

# of jax-md's lists
pytestmark = pytest.mark.filterwarnings("ignore:scatter inputs have incompatible types")
TILTS = (-0.5, 0.3)
CUTOFF = 1.6  # σ
EPS = np.finfo(float).eps
FLOW = jg.ShearFlow(GRAINS, 0.5, 0.6, 1e-3, polydispersity=0.0)


@pytest.fixture(scope="module", autouse=True)
def their_promotion():
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture(scope="module")
def state() -> State:
    return jg.heated(FLOW, jax.random.key(0))


def all_separations(state: State) -> np.ndarray:
    positions = state.positions
    return np.asarray(displacement(positions[:, None], positions[None], state.side, state.tilt))


def pairs_within(state: State, cutoff: float) -> set[tuple[int, int]]:
    near = np.linalg.norm(all_separations(state), axis=-1) < cutoff
    return {(int(i), int(j)) for i, j in np.argwhere(np.tril(near, -1))}


def pairs_of(neighbours) -> set[tuple[int, int]]:
    pairs = np.sort(np.asarray(neighbours.idx).T, axis=1)
    return {(int(j), int(i)) for i, j in pairs if j < GRAINS}


@pytest.mark.parametrize("tilt", TILTS)
def test_neighbour_lists_of_jax_md_have_our_pairs(tilt: float, state: State) -> None:
    from jax_md import partition, space

    here = replace(state, tilt=jnp.asarray(tilt))
    ours, _, box = jg.jax_md_space(here)
    sparse = partition.OrderedSparse
    of_ours = partition.neighbor_list(ours, box, CUTOFF, 0.0, disable_cell_list=True, format=sparse)
    assert pairs_of(of_ours.allocate(here.positions)) == pairs_within(here, CUTOFF) != set()
    fractions = here.positions @ jnp.linalg.inv(box).T % 1
    theirs = space.periodic_general(box)[0]
    of_theirs = partition.neighbor_list(
        theirs, box, CUTOFF, 0.0, fractional_coordinates=True, format=sparse
    )
    assert pairs_of(of_theirs.allocate(fractions)) == pairs_within(here, CUTOFF)


@pytest.mark.parametrize("tilt", TILTS)
def test_stress_and_temperature_of_jax_md_are_ours(tilt: float, state: State) -> None:
    """Of discs with the energy ½ (d − r)², the stress is −Σ f ⊗ r over the area."""
    from jax_md import quantity, smap

    here = replace(state, tilt=jnp.asarray(tilt))
    space = jg.jax_md_space(here)
    energy = smap.pair(
        lambda r, **_: jnp.where(r < CUTOFF, (CUTOFF - r) ** 2 / 2, 0),
        jg_metric(space.displacement),
    )
    found = quantity.stress(energy, here.positions, space.box)
    separations = all_separations(here)
    distances = np.linalg.norm(separations, axis=-1) + np.eye(GRAINS)
    force = (
        np.where((distances < CUTOFF) & ~np.eye(GRAINS, dtype=bool), CUTOFF - distances, 0)
        / distances
    )
    expected = (
        np.einsum("ij,ija,ijb->ab", force, separations, separations) / 2 / float(here.side) ** 2
    )
    np.testing.assert_allclose(
        found, expected, rtol=0, atol=64 * EPS * GRAINS * np.max(np.abs(expected))
    )
    masses, velocities = here.grains.masses[:, None], here.velocities
    np.testing.assert_allclose(
        quantity.temperature(velocity=velocities, mass=masses), 1, rtol=64 * EPS
    )


def jg_metric(displacement):
    from jax_md import space

    return space.metric(displacement)


def test_derivatives_with_respect_to_the_box_are_those_of_differences() -> None:
    to, origin, side, dt = jnp.asarray([1.0, 9.0]), jnp.asarray([2.0, 1.0]), 10.0, 1e-6
    ours = jg.jax_md_space(
        State(None, None, None, jnp.asarray(side), jnp.asarray(0.0))
    ).displacement

    def apart(tilt):
        return ours(
            to,
            origin,
            box=jnp.asarray([[side, 0.0], [0.0, side]]) + tilt * jnp.asarray([[0, side], [0, 0]]),
        )

    np.testing.assert_allclose(
        (apart(0.1 + dt) - apart(0.1 - dt)) / (2 * dt), [-side, 0], atol=1e-6
    )
    np.testing.assert_allclose(jax.jacfwd(apart)(0.1), [-side, 0], atol=64 * EPS * side)


def test_grains_that_are_shifted_stay_in_the_cell(state: State) -> None:
    _, shift, box = jg.jax_md_space(replace(state, tilt=jnp.asarray(0.3)))
    moved = shift(state.positions, jnp.asarray([5.0, 7.0]))
    lattice = np.asarray((moved - state.positions - np.array([5.0, 7.0])) @ np.linalg.inv(box).T)
    np.testing.assert_allclose(lattice, np.round(lattice), atol=64 * EPS)
    assert np.all((moved >= 0) & (moved < box[0, 0]))


def test_batch_is_refused_and_vmap_applies(state: State) -> None:
    several = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    with pytest.raises(jg.InputError, match="state must be one State"):
        jg.jax_md_space(several)
    distances = jax.vmap(lambda one: jg.jax_md_space(one).displacement(*one.positions[:2]))(several)
    np.testing.assert_array_equal(
        distances[0], jg.jax_md_space(state).displacement(*state.positions[:2])
    )


def test_simulator_from_parts_has_the_impulses_of_a_sample() -> None:
    """Over the 40 steps of its page, to ten tolerances of the solver; later, flows diverge."""
    names: dict = {}
    exec("\n".join(python_of("how-to/jax-md.md")), names)
    tally, sums = names["samples"].tally, names["sums"]
    expected = np.concatenate([tally.impulse, tally.binary_impulse], axis=1)
    np.testing.assert_allclose(sums[:, :2], expected, rtol=10 * names["solver"].tolerance)
    assert np.all(expected > 0) and not np.any(sums[:, 2])
