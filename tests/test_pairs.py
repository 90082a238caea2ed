"""Neighbour lists against brute force: complete while valid, never silently short."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import build, listed_pairs, move, pairs_within

from jaxgran.contact import near_pairs
from jaxgran.contact.near_pairs import (
    Frame,
    PairLists,
    consumed_skin,
    pair_lists,
    present,
    refresh,
    separations_now,
)
from jaxgran.model.cell import displacement
from jaxgran.model.grains import Grains

EPS = np.finfo(float).eps


@jax.jit
def both_separations(hood: PairLists, side):
    positions, tilt = present(hood, side)
    listed = hood.near
    direct = displacement(positions[listed.i], positions[listed.j], side, tilt)
    return separations_now(listed, hood.frame), direct


@pytest.mark.parametrize(("motion", "shear"), [(0.03, 0.02), (0.0, 0.05), (0.05, 0.0)])
@pytest.mark.parametrize("packing_fraction", [0.2, 0.75])
def test_valid_list_holds_every_touching_pair_under_motion_and_shear(
    packed, packing_fraction, motion, shear
):
    """Random motion and shear over several remaps of the tilt, with the pairs of brute force."""
    state, rng = packed(packing_fraction), np.random.default_rng(5)
    side, radii = float(state.side), np.asarray(state.grains.radii)
    hood = build(state.positions, state.grains, state.side, state.tilt)
    touching = rebuilds = remaps = 0
    for _ in range(120):
        before = float(hood.tilt + hood.frame.strain)
        moves = motion * rng.normal(size=state.positions.shape)
        hood, rebuilt, positions, tilt = move(
            hood, state.grains, state.side, moves, jnp.asarray(shear)
        )
        assert not (hood.near.overflow | hood.outer.overflow)
        touch = pairs_within(0, positions, radii, side, tilt)
        assert touch <= listed_pairs(hood.near)
        touching, rebuilds, remaps = (
            touching + len(touch),
            rebuilds + bool(rebuilt),
            remaps + bool(abs(before - tilt) > 0.4),
        )
        if rebuilt:
            assert pairs_within(
                float(hood.near.skin) - 1e-12, positions, radii, side, tilt
            ) <= listed_pairs(hood.near)
        frozen, direct = (np.asarray(x) for x in both_separations(hood, state.side))
        short = np.linalg.norm(direct, axis=-1) < 0.49 * side
        filled = np.asarray(hood.near.reach) > 0
        np.testing.assert_allclose(
            frozen[filled & short], direct[filled & short], rtol=0, atol=64 * EPS * side
        )
        assert np.all(np.linalg.norm(frozen, axis=-1)[~filled] > 2 * side)
    assert rebuilds >= 2
    assert touching > 30 or motion == 0
    assert remaps >= round(abs(120 * shear)) - 1


def test_lists_are_built_for_every_tilt(packed):
    state = packed(0.8)
    for tilt in (-0.5, -0.2, 0.3, 0.49999):
        hood = build(state.positions, state.grains, state.side, jnp.asarray(tilt))
        for listed in (hood.outer, hood.near):
            assert not listed.overflow and listed.skin > 0
            near = pairs_within(
                float(listed.skin) - 1e-12, state.positions, state.grains.radii, state.side, tilt
            )
            assert near <= listed_pairs(listed)


def test_lists_of_a_dilute_flow_reach_far(packed):
    """The skin grows with the free path, up to half of the cell."""
    dilute, dense = (
        build(s.positions, s.grains, s.side, s.tilt).near.skin for s in (packed(0.1), packed(0.8))
    )
    assert dilute > 4 * dense > 0


def clustered(count: int, side: float, seed: int) -> np.ndarray:
    return 1 + np.random.default_rng(seed).uniform(0, side / 3, (count, 2))


@pytest.mark.parametrize("buffer", ["NEAR_PAIRS_PER_GRAIN", "OUTER_PAIRS_PER_GRAIN"])
def test_pairs_left_out_are_flagged(packed, monkeypatch, buffer):
    """A list is complete, or says that it is not: by its flag or a skin used up."""
    state, flags = packed(0.7), []
    monkeypatch.setattr(near_pairs, buffer, 2)
    tiny = jax.jit(lambda *arguments: pair_lists(*arguments))
    heaps = [clustered(len(state.positions), float(state.side), seed) for seed in range(1, 6)]
    for places in (state.positions, *heaps):
        hood = tiny(places, state.grains, state.side, state.tilt)
        touch = pairs_within(0, places, state.grains.radii, state.side, state.tilt)
        flags.append(bool(hood.near.overflow) or float(hood.near.skin) < 0)
        assert flags[-1] or touch <= listed_pairs(hood.near)
    assert any(flags)
    assert bool(hood.near.overflow)


def test_flag_of_the_outer_list_reaches_the_near_one(packed, monkeypatch):
    monkeypatch.setattr(near_pairs, "OUTER_PAIRS_PER_GRAIN", 1)
    monkeypatch.setattr(near_pairs, "NEAR_PAIRS_PER_GRAIN", 10)
    state = packed(0.7)
    places = clustered(len(state.positions), float(state.side), 0)
    hood = jax.jit(lambda *arguments: pair_lists(*arguments))(
        places, state.grains, state.side, state.tilt
    )
    assert hood.outer.overflow and hood.near.overflow


def test_an_overfull_cell_of_the_search_reaches_the_lists():
    """More grains than a cell holds, whose pairs within the narrowest skin would fit."""
    rng, count = np.random.default_rng(0), 600
    grains = Grains(jnp.full(count, 0.5), jnp.ones(count))
    side = np.sqrt(count * np.pi / 4 / 0.2)
    positions = rng.uniform(size=(count, 2)) * side
    assert not build(
        jnp.asarray(positions), grains, jnp.asarray(side), jnp.asarray(0.0)
    ).outer.overflow
    positions[:140] *= 0.135
    lists = build(jnp.asarray(positions), grains, jnp.asarray(side), jnp.asarray(0.0))
    assert lists.outer.overflow and lists.near.overflow


@pytest.mark.parametrize("strain", [-1.0, 0.0, 0.3])
def test_motion_in_a_sheared_frame_consumes_the_skin_by_which_it_closes_gaps(strain):
    """Two grains move towards each other along the direction that the shear stretches most."""
    shear = np.array([[1, strain], [0, 1]])
    moves = 0.1 * np.outer([1, -1], np.linalg.svd(shear)[2][0])
    still, moved = (Frame(jnp.asarray(x), jnp.asarray(strain)) for x in (0 * moves, moves))
    closed = np.linalg.norm(shear @ (moves[0] - moves[1]))
    assert closed * (1 - 4 * EPS) <= consumed_skin(moved, still, jnp.asarray(1.0)) < 1.3 * closed


def test_near_list_filtered_after_large_shear_holds_every_pair_within_its_skin():
    """In dilute flow the skin is wider than a grain: shear brings in pairs from farther away."""
    rng, count = np.random.default_rng(0), 256
    grains = Grains(jnp.full(count, 0.5), jnp.ones(count))
    side = jnp.sqrt(count * jnp.pi / 4 / 0.1)
    sheared = jax.jit(lambda hood, stale: refresh(hood, grains, side, stale))
    for _ in range(2):
        positions = jnp.asarray(rng.uniform(size=(count, 2))) * side
        hood = build(positions, grains, side, jnp.asarray(0.0))
        for strain in (0.2, 0.5, 1.0):
            hood = replace(
                hood,
                frame=Frame(jnp.zeros_like(positions), jnp.asarray(strain) + 0 * hood.frame.strain),
            )
            hood = sheared(hood, jnp.asarray(True))
            now, tilt = present(hood, side)
            assert not (hood.near.overflow | hood.outer.overflow)
            skin = float(hood.near.skin) - 1e-12
            assert pairs_within(
                skin, now, np.asarray(grains.radii), float(side), float(tilt)
            ) <= listed_pairs(hood.near)
