"""The instants of a map are those of its flows, cost its numbers nothing, and survive every file."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from flows import in_batches
from synthetic import random_instant, random_replica

from jaxgran.maps import instants
from jaxgran.maps import run_replicas as run_replicas_module
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.instants import first_of_points, instant_variables
from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.results import choices_of, open_map, write_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.model.cell import minimum_image
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status

SETTINGS = MapSettings((0.5, 0.9), (0.8,), grains=32, seeds=2, timestep=5e-4, equilibrate=0.5, strain=1.6)


@pytest.fixture(scope="module", autouse=True)
def window() -> Iterator[float]:
    """A window in which some of these few grains collide."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(instants, "WINDOW", 0.02)
        yield instants.WINDOW


@pytest.fixture(scope="module")
def with_instants(window) -> dict[Key, Replica]:
    return in_batches(2, replace(SETTINGS, snapshots=True))


def test_numbers_of_a_map_are_the_same_bits_with_and_without_instants(with_instants) -> None:
    plain = in_batches(2, SETTINGS)
    assert all(replica.instant is None for replica in plain.values())
    for key, replica in with_instants.items():
        jax.tree.map(np.testing.assert_array_equal, replica._replace(instant=None), plain[key])


def test_first_good_seed_of_every_point_has_an_instant_in_any_batch(with_instants) -> None:
    assert {key for key, replica in with_instants.items() if replica.instant} == {(0, 0), (1, 0)}
    alone = run_replicas_module._run_task(replace(SETTINGS, snapshots=True), [(1, 0)])
    jax.tree.map(np.testing.assert_array_equal, dict(alone)[1, 0], with_instants[1, 0])


def test_instant_is_a_packing_of_the_flow_whose_forces_act_between_grains_that_touch(with_instants, window) -> None:
    for point, found in first_of_points(with_instants).items():
        assert np.pi * np.sum(found.radii**2) / found.side**2 == pytest.approx(0.8)
        assert found.window == pytest.approx(window)
        i, j = found.pairs.T
        apart = np.hypot(*minimum_image(found.positions[i] - found.positions[j], found.side, found.tilt).T)
        near = found.radii[i] + found.radii[j] + window * (found.speed[i] + found.speed[j] + 2)
        assert len(found.force) > 0 and np.all(found.force > 0) and np.all(apart < near), point


def test_bad_replicas_give_no_instant(with_instants) -> None:
    found = dict(with_instants)
    found[0, 0] = found[0, 0]._replace(status=int(Status.nonfinite))
    found[0, 1] = found[0, 1]._replace(instant=random_instant(3))
    assert first_of_points(found)[0].side == 10.0
    found[0, 1] = found[0, 1]._replace(status=int(Status.infeasible))
    assert set(first_of_points(found)) == {1}


def kept(settings: MapSettings) -> dict[Key, Replica]:
    """Made-up replicas of a map; one point has no instant, and they have different numbers of grains and pairs."""
    rng = np.random.default_rng(0)
    found = {(point, 0): random_instant(point, 20 + point, 3 * point) for point in (0, 1, 3)}
    return {(p, s): random_replica(rng, settings)._replace(instant=found.get((p, s))) for p in range(4) for s in (0, 1)}


def test_checkpoint_gives_back_the_instants(tmp_path: Path) -> None:
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


def test_dataset_has_the_instant_of_each_point_and_keeps_it_through_a_file_and_a_selection(tmp_path: Path) -> None:
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0, snapshots=True)
    written = kept(settings)
    whole = map_dataset(settings, written, {})
    write_dataset(whole, tmp_path / "map.nc")
    data = open_map(tmp_path / "map.nc")
    assert data["snapshots"].x.dims == ("packing_fraction", "restitution", "grain")
    assert data["snapshots"].force.dims == ("packing_fraction", "restitution", "pair")
    variables = data["snapshots"].data_vars.values()
    assert len(variables) == 11 and all(one.attrs["long_name"] and one.attrs["units"] for one in variables)
    for point, found in first_of_points(written).items():
        here = data["snapshots"].isel(packing_fraction=point // 2, restitution=point % 2)
        grains, pairs = int((here.radius > 0).sum()), int((here.pair_i >= 0).sum())
        assert (grains, pairs) == (len(found.radii), len(found.force))
        np.testing.assert_allclose(here.x[:grains], found.positions[:, 0], atol=2e-5)
        np.testing.assert_allclose(here.y[:grains], found.positions[:, 1], atol=2e-5)
        for name, values in (("radius", found.radii), ("speed", found.speed)):
            np.testing.assert_allclose(here[name][:grains], values, rtol=2.0**-12)
        np.testing.assert_allclose(here.force[:pairs], found.force, rtol=2.0**-12)
        np.testing.assert_array_equal(np.stack([here.pair_i, here.pair_j], -1)[:pairs], found.pairs)
        np.testing.assert_array_equal(here.clustered[:pairs], found.clustered)
        assert (float(here.side), float(here.tilt)) == (10.0, 0.2)
    empty = data["snapshots"].isel(packing_fraction=1, restitution=0)
    assert np.isnan(empty.side) and np.isnan(empty.x).all() and (empty.pair_i == -1).all()
    assert MapSettings(**choices_of(data)) == settings
    assert "snapshots" not in map_dataset(replace(settings, snapshots=False), written, {}).children


def test_map_of_120_points_of_a_thousand_grains_has_less_than_three_megabytes(tmp_path: Path) -> None:
    """A quarter of it is written. The rest of the dataset takes half a megabyte."""
    variables = instant_variables(PointGrid(("point",), (30,)), {k: random_instant(k, 1000, 900) for k in range(30)})
    write_dataset(xr.DataTree(xr.Dataset(variables)), tmp_path / "map.nc")
    assert 4 * (tmp_path / "map.nc").stat().st_size < 2.4e6


def test_window_has_at_least_one_time_step_and_at_most_a_thousand(monkeypatch) -> None:
    monkeypatch.setattr(instants, "WINDOW", 0.002)
    assert [instants._steps(ShearFlow(32, 0.5, 0.6, dt)) for dt in (0.01, 1e-3, 1e-5, 1e-8)] == [1, 2, 200, 1000]


def test_instant_of_a_batch_that_continues_from_its_journal_is_the_same(
    with_instants, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("jaxgran.maps.journal.SECONDS", 0.0)
    for journal_there in (False, True):
        assert (tmp_path / "journal.nc").exists() == journal_there
        done = dict(run_replicas_module._run_task(replace(SETTINGS, snapshots=True), [(1, 0)], tmp_path / "journal.nc"))
        jax.tree.map(np.testing.assert_array_equal, done[1, 0], with_instants[1, 0])
