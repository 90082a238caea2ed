"""The last states of a map are those of its flows, cost its numbers nothing, and survive every
file.
"""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flows import in_batches
from synthetic import random_replica, random_state

from jaxgran.maps import run_replicas as run_replicas_module
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.results import open_map, write_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import first_of_points, instant_at, states_of
from jaxgran.model.cell import minimum_image
from jaxgran.model.status import Status

SETTINGS = MapSettings(
    (0.5, 0.9), (0.8,), grains=32, seeds=2, timestep=5e-4, equilibrate=0.5, strain=1.6
)


@pytest.fixture(scope="module")
def with_states() -> dict[Key, Replica]:
    return in_batches(2, replace(SETTINGS, snapshots=True))


def test_numbers_of_a_map_are_the_same_bits_with_and_without_states(with_states) -> None:
    plain = in_batches(2, SETTINGS)
    assert all(replica.state is None for replica in plain.values())
    for key, replica in with_states.items():
        jax.tree.map(np.testing.assert_array_equal, replica._replace(state=None), plain[key])


def test_forces_of_a_state_act_between_grains_that_touch(with_states) -> None:
    pairs = 0
    for point, state in first_of_points(with_states).items():
        assert np.pi * np.sum(state.grains.radii**2) / state.side**2 == pytest.approx(0.8)
        instant = instant_at(state, SETTINGS.restitution[point], 0.8, 5e-4, "midpoint")
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
    for point, state in first_of_points(with_states).items():
        state = jax.tree.map(np.asarray, state)
        flow = SETTINGS.restitution[point], 0.8, 5e-4, "midpoint"
        with jax.enable_x64(False):
            single = instant_at(state, *flow)
        jax.tree.map(np.testing.assert_array_equal, single, instant_at(state, *flow))
        assert single.force.dtype == np.float64 and single.force.size


def test_bad_replicas_give_no_state(with_states) -> None:
    replicas = dict(with_states)
    replicas[0, 0] = replicas[0, 0]._replace(status=int(Status.nonfinite))
    replicas[0, 1] = replicas[0, 1]._replace(state=random_state(3))
    assert first_of_points(replicas)[0].side == 10.0
    replicas[0, 1] = replicas[0, 1]._replace(status=int(Status.infeasible))
    assert set(first_of_points(replicas)) == {1}


def kept(settings: MapSettings) -> dict[Key, Replica]:
    """Made-up replicas of a map; one point has no state, and they have different numbers of
    grains.
    """
    rng = np.random.default_rng(0)
    states = {(point, 0): random_state(point, 20 + point) for point in (0, 1, 3)}
    return {
        (p, s): random_replica(rng, settings, point=p)._replace(state=states.get((p, s)))
        for p in range(4)
        for s in (0, 1)
    }


def test_a_file_has_the_state_of_each_point(tmp_path: Path) -> None:
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0, snapshots=True)
    written = kept(settings)
    write_dataset(map_dataset(settings, written, {}), tmp_path / "map.nc")
    data = open_map(tmp_path / "map.nc")
    assert data["states"].positions.dims == ("packing_fraction", "restitution", "grain", "axis_a")
    assert all(
        variable.attrs["long_name"] and variable.attrs["units"]
        for variable in data["states"].data_vars.values()
    )
    read, expected = states_of(data["states"].to_dataset(), 4), first_of_points(written)
    assert set(read) == set(expected) == {0, 1, 3}
    for point, state in expected.items():
        jax.tree.map(np.testing.assert_array_equal, read[point], state)
    assert MapSettings(**from_attrs(data)) == settings
    assert "states" not in map_dataset(replace(settings, snapshots=False), written, {}).children


def test_state_of_a_batch_that_continues_from_its_journal_is_the_same(
    with_states, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("jaxgran.maps.journal.SECONDS", 0.0)
    for journal_there in (False, True):
        assert (tmp_path / "journal.nc").exists() == journal_there
        done = dict(
            run_replicas_module._run_task(
                replace(SETTINGS, snapshots=True), [(1, 0)], tmp_path / "journal.nc"
            )
        )
        jax.tree.map(np.testing.assert_array_equal, done[1, 0], with_states[1, 0])


def test_checkpoint_gives_back_the_states(tmp_path: Path) -> None:
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0, snapshots=True)
    written = kept(settings)
    run = Checkpoint(tmp_path / "map.nc", settings, resume=False)
    run.add(written)
    run.close(finished=False)
    resumed = Checkpoint(tmp_path / "map.nc", settings, resume=True)
    resumed.close(finished=True)
    assert set(resumed.done) == set(written)
    for key, replica in written.items():
        jax.tree.map(np.testing.assert_array_equal, resumed.done[key], replica)
