"""Every replica runs once, and its numbers depend on nothing but its flow and its seed."""

import inspect
import pickle
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
import xarray as xr
from command_line import made_up_replicas
from flows import in_batches
from hypothesis import given
from hypothesis import strategies as st
from synthetic import random_replica, refused, replica_id

from jaxgran.maps import ratio_map as ratio_map_module
from jaxgran.maps import run as run_module
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.batches import batches, predicted_cost, replica_ids
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.interruption import Interrupted
from jaxgran.maps.ratio_map import ratio_map
from jaxgran.maps.replica import Advance, Point, Replica, ReplicaId
from jaxgran.maps.results import open_map
from jaxgran.maps.settings import OPTIONS, MapSettings, RunOptions
from jaxgran.maps.status_report import BadPoints
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status

SETTINGS = {
    "restitution": (0.5, 0.9),
    "packing_fraction": (0.6,),
    "grains": 32,
    "seeds": 2,
    "timestep": 1e-3,
    "equilibrate": 0.5,
    "strain": 1.6,
}


MEASURED = ("wall_time_seconds", "replica_steps_per_second", "workers")


@pytest.fixture(scope="module")
def settings() -> MapSettings:
    return MapSettings(**SETTINGS)


@pytest.fixture(scope="module")
def reported() -> list[Advance]:
    """What the runs of ``results`` have reported."""
    return []


@pytest.fixture(scope="module")
def results(settings, reported) -> dict[ReplicaId, Replica]:
    """The replicas of a map, run in pairs."""
    return in_batches(2, settings, report=reported.append)


def assert_same_bits(one: dict[ReplicaId, Replica], other: dict[ReplicaId, Replica]) -> None:
    assert set(one) == set(other)
    for name, replica in one.items():
        jax.tree.map(np.testing.assert_array_equal, replica, other[name])


numbers = st.floats(0.0, 1.0)


@given(
    points=st.lists(
        st.tuples(
            st.sampled_from([64, 1000]),
            numbers,
            st.floats(0.01, 0.83),
            st.sampled_from([1e-3, 1e-5]),
        ),
        min_size=1,
        max_size=12,
    ),
    seeds=st.integers(1, 5),
)
def test_every_replica_runs_once_the_most_expensive_first_and_a_batch_has_one_number_of_grains(
    points, seeds: int
) -> None:
    flows = {Point(n, dt, nu, alpha): ShearFlow(n, alpha, nu, dt) for n, alpha, nu, dt in points}
    settings: Any = SimpleNamespace(flows=flows)
    wanted = [ReplicaId(*point, seed) for point in flows for seed in range(seeds)]
    tasks = batches(settings, wanted)
    run = [name for task in tasks for name in task]
    assert sorted(run) == sorted(wanted)
    assert all(len({name.grains for name in task}) == 1 for task in tasks)
    for first in (
        [task[0] for task in tasks],
        *([name for name in run if name.grains == n] for n in (64, 1000)),
    ):
        costs = [predicted_cost(flows[name.point]) for name in first]
        assert costs == sorted(costs, reverse=True)
    assert len(tasks) == len(run)  # on one processor; so no worker is idle


def test_cost_of_strain_grows_with_density_and_dissipation_and_less_than_the_number_of_steps() -> (
    None
):
    def cost(alpha: float, nu: float, dt: float = 1e-3) -> float:
        return predicted_cost(ShearFlow(64, alpha, nu, dt))

    assert cost(0.1, 0.8) > cost(0.5, 0.8) > cost(0.5, 0.6) > cost(0.9, 0.6)
    assert cost(0.5, 0.6) < cost(0.5, 0.6, 1e-4) < 10 * cost(0.5, 0.6)
    assert predicted_cost(ShearFlow(640, 0.5, 0.6, 1e-3)) == pytest.approx(10 * cost(0.5, 0.6))


def test_results_do_not_depend_on_the_size_company_and_order_of_the_batches(
    settings, results
) -> None:
    assert_same_bits(in_batches(1, settings), results)
    pairs = (((1, 1), (0, 0)), ((1, 0), (0, 1)))
    batches = [[replica_id(settings, *key) for key in pair] for pair in pairs]
    mixed = [replica for batch in batches for replica in run_module._run_batch(settings, batch)]
    assert_same_bits({replica.id: replica for replica in mixed}, results)


def assert_every_step_is_reported(reported: list[Advance]) -> None:
    steps = round(SETTINGS["strain"] / 1e-3) + round(SETTINGS["equilibrate"] / 1e-3)
    assert sum(np.sum(one.steps) for one in reported) == pytest.approx(4 * steps)


def test_results_do_not_depend_on_the_number_of_workers(settings, results) -> None:
    told: list[Advance] = []
    assert_same_bits(in_batches(2, settings, workers=2, report=told.append), results)
    assert_every_step_is_reported(told)


@pytest.mark.parametrize("bad", [Status.capacity, Status.nonfinite, Status.infeasible])
def test_a_replica_that_came_to_nothing_keeps_its_status_and_is_in_no_average(
    settings, bad, monkeypatch
) -> None:
    """With another time step its force ratio would be another, so it is not run again."""
    rng, calls, keys = np.random.default_rng(0), [], [(0, 0), (0, 1), (1, 0), (1, 1)]

    def measured(_, batch, *__):
        calls.append(list(batch))
        statuses = [bad if key == (0, 1) else Status.ok for key in keys]
        columns = zip(statuses, keys, strict=True)
        return [random_replica(rng, settings, status, *key) for status, key in columns]

    monkeypatch.setattr(run_module, "_measured", measured)
    wanted = replica_ids(settings)
    done = run_module._run_batch(settings, wanted)
    assert calls == [wanted] and [x.status for x in done] == [0, bad, 0, 0]
    data = map_dataset(settings, done, {})
    assert float(data.force_ratio[0, 0]) == pytest.approx(float(done[0].sample.force_ratio))


def test_a_recorder_follows_one_replica_at_a_time(settings, monkeypatch) -> None:
    """Sixty replicas are sampled in batches of four without one."""
    many, sizes = replace(settings, seeds=30), []

    def measured(settings, batch, advance, record):
        record(lambda *_: sizes.append(len(batch)))()
        return [random_replica(np.random.default_rng(0), settings) for _ in batch]

    monkeypatch.setattr(run_module, "_measured", measured)
    running = run_module.run_replicas(many, replica_ids(many), record=lambda advance: advance)
    assert len(list(running)) == 60 and sizes == [1] * 60


def test_a_batch_that_does_not_fit_into_the_memory_is_halved(
    settings, results, tmp_path, monkeypatch
) -> None:
    """Its numbers stay the same; a single replica that does not fit is an error."""
    measured, largest, sizes = run_module._measured, 1, []

    def bounded(settings, task, *rest):
        sizes.append(len(task))
        if len(task) > largest:
            raise jax.errors.JaxRuntimeError(
                "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 1 byte."
            )
        return measured(settings, task, *rest)

    monkeypatch.setattr(run_module, "_measured", bounded)
    wanted = replica_ids(settings)
    halved = run_module._run_batch(settings, wanted, tmp_path / "blocks.npz")
    assert sizes == [4, 2, 1, 1, 2, 1, 1]
    assert [replica.id for replica in halved] == wanted
    assert_same_bits({replica.id: replica for replica in halved}, results)
    largest = 0
    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"):
        run_module._run_batch(settings, wanted)


def test_a_replica_has_the_same_numbers_in_every_map_of_the_same_other_settings(
    settings, results
) -> None:
    alone = in_batches(2, replace(settings, restitution=(0.9,), seeds=1, first_seed=1))
    same = replica_id(settings, 1, 1)
    assert_same_bits(alone, {same: results[same]})


def test_ratio_map_warns_of_points_and_shows_progress(monkeypatch, capsys) -> None:
    def found(settings, *_, **__):
        yield random_replica(np.random.default_rng(0), settings, Status.deep_overlap)
        yield random_replica(np.random.default_rng(0), settings, Status.ok, 1)

    monkeypatch.setattr(ratio_map_module, "run_replicas", found)
    sentence = r"^1 of 2 points failed: deep overlap at \(restitution 0.5, packing fraction 0.6\)"
    with pytest.warns(BadPoints, match=sentence) as caught:
        ratio_map(**{**SETTINGS, "seeds": 1}, progress=True)
    assert caught[0].filename == __file__  # of the call
    assert "2/2 points" in capsys.readouterr().err


def test_few_replicas_on_an_accelerator_are_told_that_a_processor_is_faster(
    monkeypatch, capsys
) -> None:
    few = "4 replicas are few for an accelerator"
    settings, run = MapSettings(**SETTINGS), RunOptions(progress=True)
    ratio_map_module.settle(settings, run, "")
    assert few not in capsys.readouterr().err
    monkeypatch.setattr(ratio_map_module, "on_processor", lambda: False)
    ratio_map_module.settle(settings, run, "")
    assert few in capsys.readouterr().err
    ratio_map_module.settle(replace(settings, seeds=500), run, "")
    assert few not in capsys.readouterr().err


def test_a_map_that_is_cut_off_is_continued_and_written_once(
    settings, results, tmp_path, monkeypatch
) -> None:
    folder, output = tmp_path / "map.nc.unfinished", tmp_path / "map.nc"
    monkeypatch.setattr("jaxgran.maps.batches.batch_size", lambda *_: 2)

    def cut_off(_: float) -> None:
        if any(folder.glob("replica-*")):
            raise RuntimeError("cut off")

    with pytest.raises(RuntimeError, match="cut off"):
        ratio_map(**SETTINGS, workers=1, progress=cut_off, output=output)  # two could end together
    with pytest.raises(InputError, match="has an unfinished map: pass `resume=True`"):
        ratio_map(**SETTINGS, output=output)
    with pytest.raises(InputError, match=r"has solver .*0\.0001.*, not .*0\.001"):
        ratio_map(**SETTINGS, tolerance=1e-3, output=str(output), resume=True)
    data = ratio_map(**SETTINGS, output=output, resume=True)
    assert data.attrs["resumed_replicas"] == 2 and not folder.exists()
    expected = map_dataset(settings, results.values(), {})
    np.testing.assert_array_equal(data["sums/tally"], expected["sums/tally"])
    monkeypatch.setattr(ratio_map_module, "run_replicas", None)  # nothing is run
    again = ratio_map(**SETTINGS, output=output, resume=True)
    np.testing.assert_array_equal(again["sums/tally"], expected["sums/tally"])
    with pytest.raises(InputError, match="already exists and has a map with solver"):
        ratio_map(**SETTINGS, tolerance=1e-3, output=output)


def test_an_interrupted_map_raises_with_its_finished_part(tmp_path, monkeypatch) -> None:
    def some(settings, *_, **__):
        yield random_replica(np.random.default_rng(0), settings, point=1)
        raise KeyboardInterrupt

    monkeypatch.setattr(ratio_map_module, "run_replicas", some)
    with pytest.raises(Interrupted) as caught:
        ratio_map(**SETTINGS, output=tmp_path / "map.nc", attributes={"project": "mine"})
    assert np.isfinite(caught.value.data.force_ratio[0, 1]) and np.isnan(
        caught.value.data.force_ratio[0, 0]
    )
    assert caught.value.data.attrs["project"] == "mine"
    np.testing.assert_array_equal(open_map(tmp_path / "map.nc").status, caught.value.data.status)


def test_an_interrupted_map_continues_with_more_points(tmp_path, monkeypatch) -> None:
    def run(*points: int, end: type[BaseException] | None = None) -> Any:
        return made_up_replicas({(p, seed): Status.ok for p in points for seed in (0, 1)}, end)

    output, more = tmp_path / "map.nc", {**SETTINGS, "restitution": (0.5, 0.7, 0.9)}
    monkeypatch.setattr(ratio_map_module, "run_replicas", run(1, end=KeyboardInterrupt))
    with pytest.raises(Interrupted) as caught:
        ratio_map(**SETTINGS, output=output)
    with refused("already exists and has a map with restitution"):
        ratio_map(**more, output=output)
    monkeypatch.setattr(ratio_map_module, "run_replicas", run(0, 1))
    data = ratio_map(**more, output=output, resume=True)
    assert data.attrs["resumed_replicas"] == 2 and np.all(data.status >= 0)
    xr.testing.assert_equal(
        data.force_ratio.isel(restitution=2), caught.value.data.force_ratio.isel(restitution=1)
    )
    with refused("has a map with restitution 0.7, .* which this one lacks"):
        ratio_map(**SETTINGS, output=output, resume=True)


def test_what_a_cluster_is_sent_of_a_map_has_no_flows() -> None:
    few, many = (
        MapSettings(tuple(np.linspace(0.1, 0.9, count)), (0.5,), strain=2.0) for count in (2, 200)
    )
    assert pickle.loads(pickle.dumps(many)) == many
    assert len(pickle.dumps(many)) < len(pickle.dumps(few)) + 200 * 16


def test_ratio_map_is_the_dataset_of_the_replicas(settings, results) -> None:
    data = ratio_map(**SETTINGS)
    expected = map_dataset(settings, results.values(), {})
    np.testing.assert_array_equal(data["sums/tally"], expected["sums/tally"])
    np.testing.assert_array_equal(data.pressure_stderr, expected.pressure_stderr)
    of_a_run = {"automatic_choice", "resumed_replicas", *MEASURED}
    assert set(data.attrs) - set(expected.attrs) == of_a_run
    seconds, rate = (data.attrs[name] for name in MEASURED[:2])
    steps = 4 * round((SETTINGS["strain"] + SETTINGS["equilibrate"]) / 1e-3)
    assert seconds > 0 and seconds * rate == pytest.approx(steps)


def test_first_of_several_time_steps_has_the_numbers_of_a_map_at_it_alone(
    settings, results
) -> None:
    some = replace(settings, timestep=(1e-3, 5e-4))
    both = in_batches(8, some)
    first = {name: replica for name, replica in both.items() if name.point in settings.points}
    assert_same_bits(first, results)
    data = map_dataset(some, both.values(), {})
    alone = map_dataset(settings, results.values(), {})
    xr.testing.assert_equal(data.isel(timestep=0), alone)
    assert not np.any(data.force_ratio[0] == data.force_ratio[1])


def test_first_of_several_numbers_of_grains_has_the_numbers_of_a_map_at_it_alone(
    settings, results
) -> None:
    """The larger one has a larger area, and both stand at their place in the dataset."""
    several = {**SETTINGS, "grains": [32, 64], "seeds": 1}
    data = ratio_map(**several)
    assert data.force_ratio.dims == ("grains", "packing_fraction", "restitution")
    assert (
        data.grains.values.tolist() == data.attrs["grains"] == [32, 64]
        and data.grains.dtype.kind == "i"
    )
    assert {"long_name", "units"} <= set(data.grains.attrs)
    alone = map_dataset(replace(settings, seeds=1), results.values(), {})
    first = data.isel(grains=0).to_dataset()
    xr.testing.assert_equal(first, alone.to_dataset())
    assert not np.any(data.pressure[0] == data.pressure[1])
    assert set(from_attrs(data)["grains"]) == {32, 64} and from_attrs(data.sel(grains=64))[
        "grains"
    ] == (64,)


def test_the_function_has_the_arguments_of_the_table_and_says_what_they_mean() -> None:
    arguments = inspect.signature(ratio_map).parameters
    assert [*arguments] == [*OPTIONS]
    for name, option in OPTIONS.items():
        assert f"{name}: {option.help}" in str(ratio_map.__doc__)
    with pytest.raises(TypeError, match="restitutions"):
        ratio_map(restitutions=[0.5], packing_fraction=[0.6])  # type: ignore[call-arg]
