"""The cell-list search finds the pairs of all images, or says that it may have missed some."""

import jax
import numpy as np
import pytest
from jax import lax
from scipy.spatial import cKDTree

from jaxgran.contact.cell_list import _cells_per_side, cell_list_pairs
from jaxgran.model.cell import wrap

TILTS = (-0.5, -0.2, 0.0, 0.31, 0.499)
PACKING_FRACTIONS = (0.1, 0.6, 0.82)
PAIRS_PER_GRAIN = 10

compiled_search = jax.jit(cell_list_pairs, static_argnames="capacity")
wrapped = jax.jit(wrap)


def search(positions, side, tilt, cutoff, capacity):
    return compiled_search(positions, *np.asarray([side, tilt, cutoff], positions.dtype), capacity)


@jax.jit
def mapped_search(positions, side, tilt, cutoff):
    capacity = PAIRS_PER_GRAIN * positions.shape[1]
    return lax.map(
        lambda replica: cell_list_pairs(*replica, capacity), (positions, side, tilt, cutoff)
    )


@jax.jit
def batched_search(positions, side, tilt, cutoff):
    capacity = PAIRS_PER_GRAIN * positions.shape[1]
    return jax.vmap(lambda *replica: cell_list_pairs(*replica, capacity))(
        positions, side, tilt, cutoff
    )


def flow_cell(count, packing_fraction, polydispersity=0.26):
    """Side of the cell, and the cutoff at which a flow fills 0.8 of the engine's buffer."""
    side = np.sqrt(np.pi / 4 * count * (1 + polydispersity**2 / 3) / packing_fraction)
    return side, side * np.sqrt(1.6 * PAIRS_PER_GRAIN / (np.pi * count)) + polydispersity


def random_positions(seed, count, side, tilt, clustered=False):
    """Independent uniform positions; clustered, 40 % of them in a fifth of the cell."""
    rng = np.random.default_rng(seed)
    fractional = rng.random((count, 2))
    if clustered:
        fractional[: 2 * count // 5] *= (0.25, 0.8)
        fractional += rng.random(2)
    positions = side * np.stack(
        [fractional[:, 0] + tilt * fractional[:, 1], fractional[:, 1]], axis=-1
    )
    return np.asarray(wrapped(positions, side, tilt))


def all_images(positions, side, tilt, cutoff):
    """Pairs i < j within the cutoff, by a tree of the nine nearest images."""
    positions = np.asarray(positions)
    images = [
        positions + side * np.array([a + b * tilt, b])
        for b in (-1, 0, 1)
        for a in (-2, -1, 0, 1, 2)
    ]
    near = cKDTree(np.concatenate(images)).query_ball_point(positions, cutoff)
    pairs = ((i, k % len(positions)) for i, images in enumerate(near) for k in images)
    return {(i, j) for i, j in pairs if i < j}


def found_pairs(i, j):
    """The pairs found, after a check that each is found once and in order."""
    i, j = np.asarray(i), np.asarray(j)
    pairs = list(zip(i[i != j].tolist(), j[i != j].tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    assert all(a < b for a, b in pairs)
    return set(pairs)


@pytest.mark.parametrize("clustered", [False, True])
def test_pairs_are_those_of_all_images(clustered):
    count = 600
    cases = [
        (*flow_cell(count, fraction), tilt) for fraction in PACKING_FRACTIONS for tilt in TILTS
    ]
    side, cutoff, tilt = (np.asarray(column) for column in zip(*cases, strict=True))
    positions = [
        random_positions(seed, count, s, t, clustered) for seed, (s, _, t) in enumerate(cases)
    ]
    expected = [all_images(r, s, t, c) for r, (s, c, t) in zip(positions, cases, strict=True)]
    for run in mapped_search, batched_search:
        i, j, missed = run(np.stack(positions), side, tilt, cutoff)
        assert not missed.any()
        for k, case in enumerate(cases):
            assert found_pairs(i[k], j[k]) == expected[k], case


def test_one_crowded_replica_leaves_the_others_of_a_batch_as_they_are():
    count, tilt = 600, 0.31
    side, cutoff = flow_cell(count, 0.6)
    cutoffs = np.array([cutoff, cutoff / 3, cutoff])
    positions = [random_positions(seed, count, side, tilt) for seed in range(3)]
    positions[1] = positions[1] * 0.35  # up to 80 grains in a cell
    same = np.ones(3)
    i, j, missed = batched_search(np.stack(positions), side * same, tilt * same, cutoffs)
    assert not missed.any()
    for k in range(3):
        assert found_pairs(i[k], j[k]) == all_images(positions[k], side, tilt, cutoffs[k])


@pytest.mark.parametrize("tilt", TILTS)
def test_grains_on_the_edges_of_cells_find_their_neighbours(tilt):
    side = 30.0
    along = np.arange(30.0)
    lattice = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    positions = np.array(wrapped(lattice + tilt * lattice[:, 1:] * [1, 0], side, tilt))
    positions[::7] = np.where(positions[::7] == 0, side, positions[::7])  # the same place
    i, j, missed = search(positions, side, tilt, 2.3, PAIRS_PER_GRAIN * 900)
    assert not missed
    assert found_pairs(i, j) == all_images(positions, side, tilt, 2.3)


def test_single_precision_misses_nothing_but_by_rounding():
    count, tilt = 2000, 0.499
    side, cutoff = flow_cell(count, 0.82)
    positions = random_positions(3, count, side, tilt).astype(np.float32)
    i, j, missed = search(positions, side, tilt, cutoff, PAIRS_PER_GRAIN * count)
    found = found_pairs(i, j)
    images = all_images(positions.astype(float), side, tilt, cutoff * (1 + 1e-4))
    assert not missed
    assert all_images(positions.astype(float), side, tilt, cutoff * (1 - 1e-6)) <= found <= images


@pytest.mark.parametrize("count", [520, 640, 1000, 5000, 100_000])
@pytest.mark.parametrize("polydispersity", [0.0, 0.26, 0.5])
def test_the_grid_holds_the_largest_cutoff_of_any_flow(count, polydispersity):
    side, cutoff = flow_cell(count, 0.83, polydispersity)
    cells = _cells_per_side(count, PAIRS_PER_GRAIN * count)
    assert cells >= 3
    assert np.hypot(1, 0.5) * cutoff * 1.001 / side < 1 / cells


def test_whatever_may_be_missing_is_flagged():
    count, tilt = 900, -0.2
    side, cutoff = flow_cell(count, 0.6)
    positions = random_positions(1, count, side, tilt)
    capacity = PAIRS_PER_GRAIN * count
    assert not search(positions, side, tilt, cutoff, capacity)[-1]
    assert search(positions, side, tilt, cutoff, 10)[-1], "a tiny buffer"
    assert search(positions, side, tilt, 0.13 * side, capacity)[-1], "cells smaller than the cutoff"
    assert search(positions, side, tilt, cutoff * np.nan, capacity)[-1], "no cutoff"
    assert search(positions * 0.1, side, tilt, cutoff / 50, capacity)[-1], "a cell too full"
    assert search(positions * 0.3, side, tilt, cutoff, capacity)[-1], (
        "more pairs than the list holds"
    )
