"""The rule of contact, and the time of first contact, against flights in small steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxgran.contact.network import ContactPairs, PairMotion, first_contact_time, is_contact
from jaxgran.model.grains import Grains

EPS = np.finfo(float).eps
PAIRS, INSTANTS = 256, 1001
seeds = given(st.integers(0, 2**32 - 1))
modest = settings(max_examples=20)

compiled_rule, compiled_time, compiled_network = map(
    jax.jit, (is_contact, first_contact_time, ContactPairs.network)
)


def flights(seed: int, speed: float = 10.0):
    """Pairs around contact, of any velocity: separations, relative velocities, reaches."""
    rng = np.random.default_rng(seed)
    angles, reach = rng.uniform(0, 2 * np.pi, PAIRS), rng.uniform(0.74, 1.26, PAIRS)
    distance = reach + rng.normal(size=PAIRS) * 10 ** rng.uniform(-6, -1, PAIRS)
    separations = distance[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return separations, speed * rng.normal(size=(PAIRS, 2)), reach


def motion(separations, velocities) -> PairMotion:
    """The pairs of these separations and relative velocities."""
    return PairMotion(*np.transpose(separations), *np.transpose(velocities))


def excess(separations, velocities, reach, times):
    """Squared distance less squared reach along the flight (..., pairs)."""
    return np.sum((separations + times[..., None] * velocities) ** 2, axis=-1) - reach**2


@modest
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-4, 1e-2, 0.1]))
@example(352, 0.1)  # a pair whose closest approach comes before the first instant
def test_contact_is_a_pair_that_the_flight_makes_overlap(seed, look_ahead):
    separations, velocities, reach = flights(seed)
    contact, approaching = (
        np.asarray(found)
        for found in compiled_rule(motion(separations, velocities), reach, look_ahead)
    )
    times = np.linspace(0, look_ahead, INSTANTS)
    along = excess(separations, velocities, reach, times[:, None] * np.ones(PAIRS))
    # even if the closest approach is before the next instant
    towards = np.sum(separations * velocities, axis=1) < 0
    deepest = np.where(towards, np.min(along, axis=0), along[-1])
    # between two instants the squared distance falls below both by at most (half their distance in
    # space)²
    undecided = np.sum(velocities**2, axis=1) * (look_ahead / (INSTANTS - 1) / 2) ** 2 + 8 * EPS
    decided = np.abs(deepest) > undecided
    assert np.mean(decided) > 0.9
    np.testing.assert_array_equal(contact[decided], (deepest <= 0)[decided])
    np.testing.assert_array_equal(approaching, contact & towards)


@modest
@seeds
def test_time_of_first_contact_is_exact(seed):
    separations, velocities, reach = flights(seed)
    time, closest = (
        np.asarray(found) for found in compiled_time(motion(separations, velocities), reach)
    )
    closing = np.sum(separations * velocities, axis=1)
    assert np.all((closest > 0) == (closing < 0))
    slope = closing + closest * np.sum(velocities**2, axis=1)
    rounding = 8 * EPS * np.linalg.norm(separations, axis=1) * np.linalg.norm(velocities, axis=1)
    assert np.all((np.abs(slope) <= rounding)[closing < 0])

    meets = np.isfinite(time)
    nearest = excess(separations, velocities, reach, closest)
    rounding = 32 * EPS
    assert np.all(meets[(closing < 0) & (nearest < -rounding)])
    assert not np.any(meets[(closing >= 0) | (nearest > rounding)])
    at_contact = excess(separations, velocities, reach, np.where(meets, time, 0))
    assert np.all(np.abs(at_contact[meets]) <= rounding)
    assert np.all(time[meets] <= closest[meets])
    now = excess(separations, velocities, reach, np.zeros(PAIRS))
    assert np.all((time < 0)[meets & (now < 0)]) and np.all((time > 0)[meets & (now > 0)])


@modest
@seeds
def test_rule_and_time_of_first_contact_agree(seed):
    """An approaching pair is a contact just when it meets within the look-ahead time."""
    separations, velocities, reach = flights(seed)
    time, _ = (np.asarray(found) for found in compiled_time(motion(separations, velocities), reach))
    for look_ahead in (1e-3, 1e-2):
        _, approaching = compiled_rule(motion(separations, velocities), reach, look_ahead)
        decided = ~np.isfinite(time) | (np.abs(time - look_ahead) > 64 * EPS)
        np.testing.assert_array_equal(
            np.asarray(approaching)[decided], (time <= look_ahead)[decided]
        )


@pytest.mark.parametrize("slots", [4, 16])
def test_network_holds_its_contacts_and_its_empty_slots_are_inert(slots):
    separations, velocities, _ = flights(0)
    rng = np.random.default_rng(0)
    grains = Grains(jnp.asarray(rng.uniform(0.3, 0.7, 64)), jnp.asarray(rng.uniform(0.5, 2, 64)))
    i, j = rng.integers(0, 64, (2, PAIRS))
    picked = np.array([200, 3, 77])
    index = np.concatenate([picked, np.zeros(slots - 3, int)])
    pairs = motion(separations[index], velocities[index])
    touching = ContactPairs(i[index], j[index], np.ones(slots), pairs, np.arange(slots) < 3)
    network = jax.tree.map(np.asarray, compiled_network(touching, grains))
    np.testing.assert_array_equal(network.used, np.arange(slots) < 3)
    np.testing.assert_array_equal(network.i[:3], i[picked])
    np.testing.assert_array_equal(network.j[:3], j[picked])
    distances = np.linalg.norm(separations[picked], axis=1)
    normals = separations[picked] / distances[:, None]
    np.testing.assert_allclose(network.distances[:3], distances, rtol=4 * EPS)
    np.testing.assert_allclose(network.normals[:3], normals, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(
        network.approach[:3], np.sum(normals * velocities[picked], axis=1), rtol=0, atol=1e3 * EPS
    )
    np.testing.assert_allclose(
        network.inverse_mass_i[:3], 1 / np.asarray(grains.masses)[i[picked]], rtol=2 * EPS
    )
    np.testing.assert_allclose(
        network.inverse_mass_j[:3], 1 / np.asarray(grains.masses)[j[picked]], rtol=2 * EPS
    )
    for name in ("normals", "approach", "inverse_mass_i", "inverse_mass_j"):
        assert np.all(getattr(network, name)[3:] == 0)
    assert np.all(np.isfinite(network.distances))


@modest
@seeds
def test_touching_rule_reads_the_gap_alone(seed):
    separations, velocities, reach = flights(seed)
    contact, _ = compiled_rule(motion(separations, velocities), reach, 0.0)
    gap = np.linalg.norm(separations, axis=1) - reach
    np.testing.assert_array_equal(contact, gap <= 0)


def test_grains_at_rest_to_each_other_are_judged_by_their_gap():
    separations, reach = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.9]]), np.array([1.0, 0.99, 1.0])
    contact, approaching = is_contact(
        motion(separations, np.zeros((3, 2))), reach, jnp.asarray(1e-2)
    )
    np.testing.assert_array_equal(contact, [True, False, True])
    assert not np.any(approaching)
    time, _ = first_contact_time(motion(separations, np.zeros((3, 2))), reach)
    assert np.all(np.isinf(time))
