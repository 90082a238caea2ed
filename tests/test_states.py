"""The last states of a map are those of its flows, cost no numbers, and survive files."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import jax
import numpy as np
import pytest
from flows import assert_same_bits, in_batches
from synthetic import random_replica, random_state, replica_id

from jaxgran.maps import blocks
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.replica import Replica, ReplicaId
from jaxgran.maps.results import open_map, write_dataset
from jaxgran.maps.rows import replicas_of
from jaxgran.maps.run import run_replicas
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import instant_at
from jaxgran.maps.store import Store
from jaxgran.model.cell import minimum_image
from jaxgran.model.status import Status

SETTINGS = MapSettings(
    (0.5, 0.9), (0.8,), grains=32, seeds=2, timestep=5e-4, equilibrate=0.5, strain=1.6
)


@pytest.fixture(scope="module")
def with_states() -> dict[ReplicaId, Replica]:
    return in_batches(2, replace(SETTINGS, snapshots=True))


def test_numbers_of_a_map_are_the_same_bits_with_and_without_states(with_states) -> None:
    plain = in_batches(2, SETTINGS)
    assert all(replica.state is None for replica in plain.values())
    for name, replica in with_states.items():
        jax.tree.map(np.testing.assert_array_equal, replica._replace(state=None), plain[name])


def test_forces_of_a_state_act_between_grains_that_touch(with_states) -> None:
    pairs, dt = 0, 5e-4
    for name, (*_, state) in with_states.items():
        assert np.pi * np.sum(state.grains.radii**2) / state.side**2 == pytest.approx(0.8)
        seen = instant_at(state, name.restitution, 0.8, dt, "midpoint")
        i, j = seen.pairs.T
        branch = minimum_image(seen.positions[i] - seen.positions[j], seen.side, seen.tilt)
        near = seen.radii[i] + seen.radii[j] + dt * (seen.speed[i] + seen.speed[j] + 2)
        assert np.all(seen.force > 0) and np.all(np.linalg.norm(branch, axis=-1) < near)
        pairs += len(seen.force)
    assert pairs


def test_the_state_of_a_point_is_that_of_its_first_good_seed(with_states) -> None:
    settings, first = replace(SETTINGS, snapshots=True), replica_id(SETTINGS, 0)
    bad = with_states[first]._replace(status=int(Status.nonfinite))
    side = with_states[replica_id(SETTINGS, 0, 1)].state.side
    other = bad.state.side + 1
    bad = bad._replace(state=replace(bad.state, side=other))
    for status, found in ((Status.nonfinite, side), (Status.ok, other)):
        replicas = with_states | {first: bad._replace(status=int(status))}
        data = map_dataset(settings, replicas.values(), {})
        assert data["states"].side[0, 0] == found
    lost = {name: x._replace(status=int(Status.infeasible)) for name, x in with_states.items()}
    assert np.isnan(map_dataset(settings, lost.values(), {})["states"].side).all()


FILE = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0, snapshots=True)


def made_up() -> dict[ReplicaId, Replica]:
    """Made-up replicas of different numbers of grains; one point has no state."""
    rng, made = np.random.default_rng(0), {}
    states = {(point, 0): random_state(point, 20 + point) for point in (0, 1, 3)}
    for key in product(range(4), (0, 1)):
        replica = random_replica(rng, FILE, Status.ok, *key)._replace(state=states.get(key))
        made[replica.id] = replica
    return made


def test_a_file_has_the_state_of_each_point(tmp_path: Path) -> None:
    written = made_up()
    write_dataset(map_dataset(FILE, written.values(), {}), tmp_path / "map.nc")
    data = open_map(tmp_path / "map.nc")
    assert data["states"].positions.dims == ("packing_fraction", "restitution", "grain", "axis_a")
    read = {replica.id: replica for replica in replicas_of(data, FILE)}
    assert read.keys() == written.keys()
    for name, replica in written.items():
        jax.tree.map(np.testing.assert_array_equal, read[name].state, replica.state)
    assert MapSettings(**from_attrs(data)) == FILE
    without = map_dataset(replace(FILE, snapshots=False), written.values(), {})
    assert "states" not in without.children


def test_state_of_a_batch_that_continues_from_its_blocks_is_the_same(
    with_states, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(blocks, "SECONDS", 0.0)
    settings, name = replace(SETTINGS, snapshots=True), replica_id(SETTINGS, 1)
    for kept_before in (False, True):
        assert (tmp_path / "blocks.npz").exists() == kept_before
        path = lambda _: tmp_path / "blocks.npz"  # noqa: E731
        (done,) = run_replicas(settings, [name], blocks_path=path)
        jax.tree.map(np.testing.assert_array_equal, done, with_states[name])


def test_an_unfinished_map_gives_back_the_states(tmp_path: Path) -> None:
    *replicas, _ = made_up().values()
    run = Store(tmp_path / "map.nc", FILE, resume=False, overwrite=False)
    for replica in replicas:
        run.add(replica)
    run.close()
    resumed = Store(tmp_path / "map.nc", FILE, resume=True, overwrite=False)
    resumed.close()
    assert_same_bits(list(resumed.replicas.values()), replicas)
