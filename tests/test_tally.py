"""Tally: what joins two samples, and the one table from which the places of the sums follow."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.contact.law import SolvedContact, contact_terms
from jaxgran.dynamics.tally import (
    CONTACT,
    EXTREMES,
    LAYOUT,
    NUMBERS,
    TABLE,
    Tally,
    empty_tally,
    flat_tally,
    span_of,
    tally_from_flat,
)
from jaxgran.model.status import DEEP_OVERLAP, Status


def random_tally(seed: int) -> Tally:
    rng = np.random.default_rng(seed)
    empty = empty_tally(jnp.dtype(float))
    return jax.tree.map(lambda leaf: jnp.asarray(rng.integers(0, 7, leaf.shape), leaf.dtype), empty)


def test_joined_sample_has_the_sums_and_the_larger_of_each_extreme():
    for seed in range(5):
        one, two = random_tally(seed), random_tally(seed + 100)
        joined = one + two
        for name in TABLE:
            expected = np.maximum if name in EXTREMES else np.add
            np.testing.assert_array_equal(
                getattr(joined, name), expected(getattr(one, name), getattr(two, name))
            )
            assert getattr(joined, name).dtype == getattr(one, name).dtype


def test_tally_of_no_time_is_neutral():
    empty = empty_tally(jnp.dtype(float))
    jax.tree.map(np.testing.assert_array_equal, random_tally(0) + empty, random_tally(0))
    assert empty.status == Status.ok and empty.status.dtype == np.int32


def test_sums_of_a_users_function_are_joined_and_stored_with_the_others():
    one, two = (
        replace(random_tally(seed), observed={"a": np.float64(seed), "b": np.ones(3)})
        for seed in (4, 5)
    )
    joined = one + two
    assert joined.observed["a"] == 9
    np.testing.assert_array_equal(joined.observed["b"], [2, 2, 2])
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), one.observed)
    stored = np.append(flat_tally(one, ()), 7.0)  # a number of something else behind it
    again = tally_from_flat(stored[None], np.dtype(float), shapes)
    jax.tree.map(
        np.testing.assert_array_equal, again, jax.tree.map(lambda x: np.asarray(x)[None], one)
    )


def test_running_sums_follow_each_other_without_a_gap():
    places = sorted(LAYOUT.values(), key=lambda place: place.start)
    assert [place.start for place in places] == [0, *(place.stop for place in places[:-1])]
    assert places[-1].stop == NUMBERS


def test_terms_of_a_contact_stand_where_the_table_says():
    rng = np.random.default_rng(0)
    angle, distance, overlap, approach, half_change, one_plus_alpha, p, binary, clustered = (
        rng.uniform(0.1, 1, 9)
    )
    nx, ny = np.cos(angle), np.sin(angle)
    numbers = (nx, ny, distance, overlap, approach, half_change, one_plus_alpha, p, binary)
    terms = contact_terms(SolvedContact(*numbers, clustered, 1, 2, 3))
    moment = distance * np.array([nx * nx, nx * ny, ny * ny])
    after = approach + 2 * half_change
    expected = {
        "impulse": p,
        "binary_impulse": binary,
        "contact_moment": p * moment,
        "binary_moment": binary * moment,
        "cluster_moment": clustered * moment,
        "dissipation": -p * (approach + after) / 2,
        "complementarity": p * (after + (one_plus_alpha - 1) * approach) / 2,
        "contacts": 1,
        "loaded_contacts": 2,
        "collisions": 3,
        "overlap": overlap,
        "deep_contacts": overlap > DEEP_OVERLAP,
        "binary_speed_moment": -approach * binary * moment,
        "binary_dissipation": -approach * binary * (2 - one_plus_alpha) / 2,
    }
    begin = span_of(CONTACT).start
    assert len(terms) == span_of(CONTACT).stop - begin
    assert {name for name, row in TABLE.items() if row["kind"] == CONTACT} == set(expected)
    for name, value in expected.items():
        found = np.squeeze(terms[LAYOUT[name].start - begin : LAYOUT[name].stop - begin])
        np.testing.assert_allclose(found, value, rtol=1e-14, err_msg=name)
