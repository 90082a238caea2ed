"""Merged maps are those of one run to the bit; what does not belong together is refused."""

import shlex
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import xarray as xr
from command_line import in_a_process
from hypothesis import given
from hypothesis import strategies as st
from synthetic import random_replica, random_state, refused

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.maps.batches import points_of_part, predicted_cost, replica_ids
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.merge import merge_maps
from jaxgran.maps.ratio_map import ratio_map
from jaxgran.maps.replica import Replica
from jaxgran.maps.results import open_map
from jaxgran.maps.rows import measured_ids
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.status_report import bad_points
from jaxgran.model.status import Status

SETTINGS = MapSettings((0.5, 0.7, 0.9), (0.5, 0.6), grains=64, seeds=3, strain=2.0, snapshots=True)
RUN = {"wall_time_seconds": 2.0, "resumed_replicas": 0, "automatic_choice": ""}
CLUSTER = Path(__file__).parents[1] / "docs" / "how-to" / "cluster.md"


@pytest.fixture(scope="module")
def replicas() -> dict[tuple[int, int], Replica]:
    """Of all points: one that is not steady, one that is infeasible, one that is not finite."""
    bad = {(0, 1): Status.not_steady, (1, 0): Status.infeasible, (2, 2): Status.nonfinite}
    rng, made = np.random.default_rng(0), {}
    for point, seed in product(range(6), range(3)):
        replica = random_replica(rng, SETTINGS, bad.get((point, seed), Status.ok), point, seed)
        made[point, seed] = replica._replace(state=random_state(10 * point + seed))
    return made


MADE: dict[Any, xr.DataTree] = {}


def of_seeds(
    replicas: dict[tuple[int, int], Replica], first: int, count: int, **change: Any
) -> xr.DataTree:
    """The map of some of the seeds, of which one is made for all tests."""
    settings = replace(SETTINGS, first_seed=first, seeds=count, **change)
    key = (settings, tuple(replicas))
    if key not in MADE:
        own = replica_ids(settings)
        MADE[key] = map_dataset(settings, [x for x in replicas.values() if x.id in own], RUN)
    return MADE[key].copy()


def assert_one_run(merged: xr.DataTree, whole: xr.DataTree, but: tuple[str, ...] = ()) -> None:
    """All numbers to the bit, and all attributes but the times and those of the command."""
    but = ("history", "command", "wall_time_seconds", "replica_steps_per_second", "workers", *but)
    assert merged.equals(whole)
    for node in whole.subtree:
        there = merged[node.path].attrs
        assert there.keys() - set(but) == node.attrs.keys() - set(but)
        for name in node.attrs.keys() - set(but):
            np.testing.assert_array_equal(there[name], node.attrs[name], err_msg=name)


def test_the_files_of_parts_make_the_map_of_one_run(replicas, tmp_path: Path) -> None:
    whole, files = of_seeds(replicas, 0, 3), []
    for part in ("1/4", "2/4", "3/4", "4/4"):
        data = of_seeds(replicas, 0, 3, part=part)
        assert not bad_points(data).get("not_run")
        files.append(tmp_path / f"part-{part[0]}.nc")
        data.to_netcdf(files[-1])
    assert_one_run(merge_maps(files), whole)
    missing = merge_maps(files[1:])
    outside = points_of_part(replace(SETTINGS, part="1/4"))
    assert np.flatnonzero(missing.status.values.ravel() == -1).tolist() == outside
    assert len(bad_points(missing)["not_run"]) == len(outside)


def test_maps_of_other_seeds_make_the_map_of_all_seeds_with_the_scatter_between_them(
    replicas,
) -> None:
    first, rounded, second = (of_seeds(replicas, *seeds) for seeds in ((0, 1), (0, 1), (1, 2)))
    rounded.coords["restitution"] = [0.5, np.nextafter(0.7, 1), 0.9]
    for some in (first, rounded):
        merged = merge_maps([second, some])
        assert_one_run(merged, of_seeds(replicas, 0, 3))
        assert merged.attrs["wall_time_seconds"] == 4.0
        assert not merged.force_ratio_stderr.equals(first.force_ratio_stderr)


def test_a_point_of_fewer_seeds_than_others_is_measured(replicas) -> None:
    good = {key: x for key, x in replicas.items() if key[0] >= 4}  # without a bad seed
    more = of_axes(good, packing_fraction=(0.6,), restitution=(0.7,))
    fewer = of_axes(good, packing_fraction=(0.6,), restitution=(0.9,), seeds=2)
    merged = merge_maps([more, fewer])
    assert np.isin(merged.status, [s.value for s in Status]).all()
    assert (merged["sums"].status == -1).sum() == 1 and not bad_points(merged).get("not_run")


def of_axes(replicas: dict[tuple[int, int], Replica], **axes: Any) -> xr.DataTree:
    """The map at some of the points and seeds, or also at others, which nobody has measured."""
    return map_dataset(replace(SETTINGS, **axes), replicas.values(), RUN, fewer_seeds=True)


UNIONS: dict[str, Any] = {
    "lists": ({"restitution": (0.9, 0.5)}, {"restitution": (0.7,)}, {}),
    "lists that overlap": ({"restitution": (0.5, 0.7)}, {"restitution": (0.7, 0.9)}, {}),
    "points far from each other": (
        {"restitution": (0.5,), "packing_fraction": (0.5,)},
        {"restitution": (0.9,), "packing_fraction": (0.6,)},
        {"restitution": (0.5, 0.9), "packing_fraction": (0.5, 0.6)},
    ),
    "points and seeds": (
        {"restitution": (0.5,), "first_seed": 1, "seeds": 2},
        {"restitution": (0.7,), "seeds": 1},
        {"restitution": (0.5, 0.7)},
    ),
    "numbers of grains": ({}, {"grains": (64, 128)}, {"grains": (64, 128)}),
    "time steps": ({}, {"timestep": (5e-4, 1e-3)}, {"timestep": (1e-3, 5e-4)}),
}


@pytest.mark.parametrize("name", UNIONS)
def test_maps_of_other_axes_make_the_map_of_all_that_they_have(replicas, name: str) -> None:
    *parts, axes = UNIONS[name]
    maps = [of_axes(replicas, **part) for part in parts]
    seen = {x for one in maps for x in measured_ids(one)}
    whole = of_axes({key: x for key, x in replicas.items() if x.id in seen}, **axes)
    assert_one_run(merge_maps(maps), whole)


def with_other(name: str, data: xr.DataTree) -> xr.DataTree:
    """The map with another attribute, as one of another version or of other sources."""
    data.attrs[name] = "other"
    return data


def without_a_sum(data: xr.DataTree) -> xr.DataTree:
    data["sums"] = data["sums"].to_dataset().isel(quantity=slice(-1))
    return data


REFUSED: dict[str, Any] = {
    "strain is 2.0 in map 0 and 3.0 in map 1": (
        lambda x: [of_seeds(x, 0, 1), of_seeds(x, 1, 1, strain=3.0)]
    ),
    "restitution is .* in map 0 and .* in map 1": (
        lambda x: [of_axes(x, grains_by_point=(64,) * 6), of_axes(x, restitution=(0.7,))]
    ),
    "seed 1 is missing": lambda x: [of_seeds(x, 0, 1), of_seeds(x, 2, 1)],
    "by their number of seeds": (
        lambda x: [of_seeds(x, 0, 1, error=0.1), of_seeds(x, 1, 1, error=0.1)]
    ),
    "version_jax is 'other' in map 0": (
        lambda x: [with_other("version_jax", of_seeds(x, 0, 1)), of_seeds(x, 1, 1)]
    ),
    "code_digest is 'other' in map 0": (
        lambda x: [with_other("code_digest", of_seeds(x, 0, 1)), of_seeds(x, 1, 1)]
    ),
    "must have the group sums": lambda x: [of_seeds({}, 0, 1)],
    "averages of them do not": lambda x: [of_seeds(x, 0, 1).mean()],
    "the running sums of this version": lambda x: [without_a_sum(of_seeds(x, 0, 1))],
    "at least one map, a DataTree, or file, not str": lambda _: "map.nc",
    r"or file, not \['Dataset'\]": lambda x: [of_seeds(x, 0, 1).to_dataset()],
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_does_not_belong_together_is_refused(replicas, words: str) -> None:
    with refused(words):
        merge_maps(REFUSED[words](replicas))


@given(st.integers(1, 12))
def test_every_point_is_in_one_part_and_parts_cost_alike(count: int) -> None:
    settings = replace(SETTINGS, packing_fraction=(0.5, 0.6, 0.7, 0.8), timestep=5e-4)
    parts = [points_of_part(replace(settings, part=f"{k + 1}/{count}")) for k in range(count)]
    assert sorted(point for part in parts for point in part) == list(range(12))
    costs = [predicted_cost(flow) for flow in settings.flows.values()]
    totals = [sum(costs[point] for point in part) for part in parts]
    assert max(totals) - min(totals) <= max(costs)


@pytest.mark.environment
def test_an_array_job_of_the_page_makes_the_map_of_one_process(tmp_path: Path) -> None:
    """The commands of the batch script, each in a process of its own, on a map of a few grains."""
    lines = CLUSTER.read_text(encoding="utf-8").splitlines()
    task = next(line for line in lines if line.startswith("jaxgran map") and "--part" in line)
    merge = next(line for line in lines if line.startswith("jaxgran merge"))
    tiny = (
        "--restitution 0.5,0.9 --packing-fraction 0.5,0.6 --grains 16 --seeds 1 --equilibrate 0 "
        "--strain 0.32"
    )
    task = task.replace("--preset paper", tiny).replace("$SLURM_ARRAY_TASK_COUNT", "2")
    commands = [task.replace("$SLURM_ARRAY_TASK_ID", number) for number in "12"]
    commands += [merge.replace("parts/*.nc", "parts/1.nc parts/2.nc")]
    commands += [f"jaxgran map {tiny} --workers 1 --output whole.nc"]
    (tmp_path / "parts").mkdir()
    for command in commands:
        outcome = in_a_process(tmp_path, *shlex.split(command)[1:])
        assert outcome.status == 3, outcome.err  # so short a preparation is not steady
        assert "not run" not in outcome.err
    assert_one_run(open_map(tmp_path / "paper.nc"), open_map(tmp_path / "whole.nc"))


@pytest.mark.filterwarnings("ignore::jaxgran.maps.status_report.BadPoints")
def test_a_map_of_a_users_observable_is_merged_with_its_function() -> None:
    def observe(seen) -> dict[str, Any]:
        return {"side": seen.state.side, "pushes": seen.impulses.sum()}

    run = partial(ratio_map, [0.9], [0.5], grains=16, equilibrate=0.0, strain=0.32, observe=observe)
    maps = [run(seeds=1, first_seed=seed) for seed in (0, 1)]
    assert_one_run(merge_maps(maps, observe=observe), run(seeds=2))
    for other in (None, lambda _: {"a": 1.0}):
        with refused("observe must be the function of the maps, which is pushes, side: "):
            merge_maps(maps, observe=other)


def test_maps_in_double_precision_are_merged_in_it_by_a_process_that_computes_in_single(
    replicas,
) -> None:
    parts = [of_seeds(replicas, 0, 1), of_seeds(replicas, 1, 2)]
    with jax.enable_x64(False):
        merged = merge_maps(parts)
    assert_one_run(merged, of_seeds(replicas, 0, 3), but=("solver", "engine"))
    assert merged["theory"].pressure.dtype == np.float64


class Own(BarzilaiBorwein):
    """A method of the user's."""


def test_maps_of_a_users_solver_are_merged_with_it(replicas) -> None:
    solver = Own(tolerance=1e-3)
    parts = [of_seeds(replicas, 0, 1, solver=solver), of_seeds(replicas, 1, 2, solver=solver)]
    assert_one_run(merge_maps(parts, solver=solver), of_seeds(replicas, 0, 3, solver=solver))
    for other in (None, Own(), BarzilaiBorwein(tolerance=1e-3)):
        with refused("solver must be that of the maps, which is .*Own"):
            merge_maps(parts, solver=other)
