"""The last states of a map are those of its flows, cost its numbers nothing, and survive every
file.
"""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flows import in_batches
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
    pairs = 0
    for name, (*_, state) in with_states.items():
        assert np.pi * np.sum(state.grains.radii**2) / state.side**2 == pytest.approx(0.8)
        instant = instant_at(state, name.restitution, 0.8, 5e-4, "midpoint")
        i, j = instant.pairs.T
        apart = np.hypot(
            *minimum_image(
                instant.positions[i] - instant.positions[j], instant.side, instant.tilt
            ).T
        )
        near = (
            instant.radii[i] + instant.radii[j] + 5e-4 * (instant.speed[i] + instant.speed[j] + 2)
        )
        assert np.all(instant.force > 0) and np.all(apart < near)
        pairs += len(instant.force)
    assert pairs


def test_forces_of_a_state_are_the_same_whatever_the_precision_of_the_session(with_states) -> None:
    for name, (*_, state) in with_states.items():
        state = jax.tree.map(np.asarray, state)
        flow = name.restitution, 0.8, 5e-4, "midpoint"
        with jax.enable_x64(False):
            single = instant_at(state, *flow)
        jax.tree.map(np.testing.assert_array_equal, single, instant_at(state, *flow))
        assert single.force.dtype == np.float64 and single.force.size


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


def kept(settings: MapSettings) -> dict[ReplicaId, Replica]:
    """Made-up replicas of a map; one point has no state, and they have different numbers of
    grains.
    """
    rng = np.random.default_rng(0)
    states = {(point, 0): random_state(point, 20 + point) for point in (0, 1, 3)}
    replicas = (
        random_replica(rng, settings, point=p, seed=s)._replace(state=states.get((p, s)))
        for p in range(4)
        for s in (0, 1)
    )
    return {replica.id: replica for replica in replicas}


def test_a_file_has_the_state_of_each_point(tmp_path: Path) -> None:
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0, snapshots=True)
    written = kept(settings)
    write_dataset(map_dataset(settings, written.values(), {}), tmp_path / "map.nc")
    data = open_map(tmp_path / "map.nc")
    assert data["states"].positions.dims == ("packing_fraction", "restitution", "grain", "axis_a")
    assert all(
        variable.attrs["long_name"] and variable.attrs["units"]
        for variable in data["states"].data_vars.values()
    )
    read = {replica.id: replica for replica in replicas_of(data, settings)}
    assert read.keys() == written.keys()
    for name, replica in written.items():
        jax.tree.map(np.testing.assert_array_equal, read[name].state, replica.state)
    assert MapSettings(**from_attrs(data)) == settings
    without = map_dataset(replace(settings, snapshots=False), written.values(), {})
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
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0, snapshots=True)
    written = kept(settings)
    run = Store(tmp_path / "map.nc", settings, resume=False, overwrite=False)
    for name in list(written)[:-1]:
        run.add(written[name])
    run.close()
    resumed = Store(tmp_path / "map.nc", settings, resume=True, overwrite=False)
    resumed.close()
    assert list(resumed.replicas) == list(written)[:-1]
    for name, replica in resumed.replicas.items():
        jax.tree.map(np.testing.assert_array_equal, replica, written[name])
