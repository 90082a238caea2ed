"""The calendar of the numba engine: its blocks find the events of a pass over all entries."""

import numpy as np
import pytest
from numba import njit

from jaxgran.dynamics.numba_engine import calendar
from jaxgran.dynamics.numba_engine.arrays import Pairs
from jaxgran.dynamics.numba_engine.layout import BEGINS, LANES, LEAST_SHIFT, NEVER, STRIKES

ENTRIES, CHANGES = 37 * LANES, 9


@njit
def events(shift, changed, entries, pairs, met, found):
    """Visit the events, each of which changes some entries; write step and contacts of each."""
    if shift > 0:
        calendar.bound_blocks(ENTRIES, shift, pairs)
    for event in range(found.shape[0]):
        k = calendar.next_contact_step(ENTRIES, shift, pairs)
        found[event, 0] = k
        if k == NEVER:
            break
        contacts = calendar.contacts_of_step(k, ENTRIES, shift, pairs, met)
        found[event, 1] = contacts
        for n in range(contacts):
            found[event, 2 + n] = met[n]
        for n in range(contacts + changed.shape[1]):  # as a prediction does
            p = met[n] if n < contacts else changed[event, n - contacts]
            for row in range(3):
                pairs.calendar[row, p] = entries[event, row, p]
            if shift > 0:
                b = p >> np.uint32(shift)
                for row in (STRIKES, BEGINS):
                    pairs.bounds[row, b] = min(pairs.bounds[row, b], pairs.calendar[row, p])


def made_up(draw: np.random.Generator, earliest: np.ndarray) -> np.ndarray:
    """Entries (..., 3, pairs): half of the pairs do not meet, a quarter meets and recedes."""
    begins = earliest + draw.integers(1, 400, (*earliest.shape[:-1], ENTRIES))
    kind = draw.random(begins.shape)
    ends = np.where(kind < 0.5, -1, begins + draw.integers(0, 40, begins.shape))
    strikes = np.where(
        kind < 0.75, NEVER, begins + draw.integers(0, 2, begins.shape) * (ends > begins)
    )
    return np.stack([strikes, np.where(kind < 0.5, NEVER, begins), ends], axis=-2).astype(np.int32)


@pytest.mark.parametrize("shift", [LEAST_SHIFT, LEAST_SHIFT + 3])
def test_blocks_find_the_events_of_a_pass_over_all_entries(shift: int) -> None:
    draw, count = np.random.default_rng(4), 300
    start = made_up(draw, np.zeros((1,), int))
    later = made_up(draw, 2 * np.arange(count)[:, None] + 400)
    changed = draw.integers(0, ENTRIES, (count, CHANGES)).astype(np.uint32)
    results = []
    for blocks in (0, shift):
        fields: dict = dict.fromkeys(Pairs._fields, np.zeros(1))
        bounds = np.zeros((2, (ENTRIES >> LEAST_SHIFT) + LANES), np.int32)
        pairs = Pairs(**fields | {"calendar": start.copy(), "bounds": bounds})
        events_found = np.full((count, 2 + ENTRIES), -1)
        events(blocks, changed, later, pairs, np.zeros(ENTRIES, np.uint32), events_found)
        results.append(events_found)
    whole, by_blocks = results
    assert np.all(np.diff(whole[:, 0]) >= 0) and len(set(whole[:, 0])) > count / 4
    assert whole[:, 1].min() >= 1 and whole[:, 1].max() > 1
    np.testing.assert_array_equal(by_blocks, whole)
