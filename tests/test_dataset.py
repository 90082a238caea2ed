"""The dataset holds every promised name, survives the disc, and is never left half written."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from made_up_maps import with_variables
from synthetic import random_replica, refused, replica_id

from jaxgran.cli.summary import summary_of
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.replica import Replica
from jaxgran.maps.results import open_map, write_dataset
from jaxgran.maps.rows import measured_ids
from jaxgran.maps.schema import flattened, path_of
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.variables import NOT_RUN, PREDICTED
from jaxgran.model.status import Status
from jaxgran.sampling.budget import SIZE_LAWS, large_system
from jaxgran.sampling.enskog_factors import LENGTHS, measured_over_enskog
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.sample import BLOCKS
from jaxgran.theory.assumptions import ASSUMPTIONS
from jaxgran.theory.gaussian_moments import gaussian_moments

ALPHAS, NUS, SEEDS = (0.5, 0.9), (0.5, 0.6), 3
FEW = ("force_ratio", "force_ratio_stderr", "status", "sums/status")
RUN = {"command": "jaxgran map", "wall_time_seconds": 12.0, "replica_steps_per_second": 1e5}


@pytest.fixture(scope="module")
def settings() -> MapSettings:
    return MapSettings(ALPHAS, NUS, grains=64, seeds=SEEDS, timestep=5e-4, strain=2.0)


@pytest.fixture(scope="module")
def results(settings) -> dict[tuple[int, int], Replica]:
    """All replicas but two of the last point, a bad one, and one that is jammed."""
    rng = np.random.default_rng(0)
    keys = [(point, seed) for point in range(4) for seed in range(SEEDS)][:-2]
    statuses = {(0, 1): Status.iteration_limit, (1, 2): Status.infeasible}
    return {key: random_replica(rng, settings, statuses.get(key, Status.ok), *key) for key in keys}


@pytest.fixture(scope="module")
def data(settings, results) -> xr.DataTree:
    return map_dataset(settings, results.values(), RUN)


@pytest.fixture(scope="module")
def few(data) -> xr.DataTree:
    """The main variables of the map, which are written in no time."""
    return with_variables(data, *FEW)


def test_every_observable_has_its_dimensions_and_errors(data) -> None:
    data = flattened(data)
    for name, row in OBSERVABLES.items():
        path = path_of(name)
        assert data[path].dims == ("packing_fraction", "restitution", *row.axes)
        assert (f"{path}_stderr" in data) == (row.group != "diagnostics")
        linked = data[path].attrs["ancillary_variables"].split()
        assert linked[-1] == ("status" if row.group == "/" else "/status")
        if row.group != "diagnostics":
            assert data[f"{path}_stderr"].dims == data[path].dims and f"{name}_stderr" in linked


def test_seeds_that_were_given_up_add_no_samples(settings) -> None:
    rng, one = np.random.default_rng(1), replace(settings, seeds=1)
    good = [random_replica(rng, settings, Status.ok, point, 0) for point in range(4)]
    jammed = [random_replica(rng, settings, Status.infeasible, point, 1) for point in range(4)]
    both = summary_of(map_dataset(replace(settings, seeds=2), good + jammed, RUN))
    alone = summary_of(map_dataset(one, good, RUN))
    for name in ("pressure", "granular_temperature"):
        samples = both[name].effective_samples, alone[name].effective_samples
        np.testing.assert_allclose(*samples, rtol=1e-9)


def test_a_file_of_another_format_is_refused_in_a_sentence(few, tmp_path: Path) -> None:
    older, oldest = few.copy(), few.copy()
    older.attrs["format_version"] = 3
    del oldest.attrs["format_version"]
    for other in (older, oldest):
        write_dataset(other, tmp_path / "map.nc")
        with refused("and this version of jaxgran reads format_version 5"):
            open_map(tmp_path / "map.nc")


def test_everything_has_a_long_name_and_numbers_have_units(data) -> None:
    data = flattened(data)
    assert all(data[name].attrs["long_name"] for name in data.variables)
    without = {name for name in data.variables if "units" not in data[name].attrs}
    assert without == {"axis_a", "axis_b", "error_source", "observable", "status", "sums/status"}
    by_hand = {
        "timestep": "1 / shear rate",
        "pressure": "m / t^2",
        "pressure_stderr": "m / t^2",
        "granular_temperature": "m sigma^2 / t^2",
        "diagnostics/max_overlap": "sigma",
    }
    assert {name: data[name].attrs["reduced_unit"] for name in by_hand} == by_hand


def test_every_average_has_the_strain_of_an_independent_sample(data) -> None:
    strains = data["diagnostics/correlation_strain"]
    assert set(strains.observable.values) == {
        name for name, row in OBSERVABLES.items() if not (row.tensor or row.extreme)
    }
    block = data["sums/strain"].mean("seed") / BLOCKS  # made-up blocks are independent
    lengths = (strains.sel(observable="force_ratio") / block).values[0]
    assert np.all((lengths > 0.8) & (lengths < 4))


def test_prediction_stands_beside_what_is_measured(data) -> None:
    for name in PREDICTED:
        predicted = data["theory"][name]
        measured = data[path_of(name)]
        assert predicted.dims == measured.dims
        assert predicted.attrs.get("reduced_unit") == measured.attrs.get("reduced_unit")
        for value in predicted.stack(point=measured.dims).transpose("point"):
            theory = gaussian_moments(float(value.restitution), float(value.packing_fraction))
            assert float(value) == pytest.approx(float(getattr(theory, name)), rel=1e-9)


def test_factors_and_lengths_are_those_of_the_samples_of_a_point(settings, data, results) -> None:
    samples = [results[0, seed].sample for seed in range(SEEDS)]
    value, error = measured_over_enskog(settings.flows[settings.points[0]], samples)
    point = data["theory"].sel(packing_fraction=NUS[0], restitution=ALPHAS[0])
    stored = {f"enskog_factor_pressure_{factor}": f"pressure_{factor}" for factor in ASSUMPTIONS}
    stored |= {name: name for name in (*LENGTHS, "enskog_pressure")}
    assert set(stored.values()) <= set(value)
    for path, name in stored.items():
        for ending in ("", "_stderr"):
            assert data["theory"][path + ending].dims == ("packing_fraction", "restitution")
        np.testing.assert_array_equal(
            [point[path], point[f"{path}_stderr"]], [value[name], error[name]]
        )


def test_elastic_flow_has_no_prediction() -> None:
    """Nothing balances the shear at α = 1."""
    data = map_dataset(MapSettings((0.5, 1.0), (0.6,), timestep=1e-5, equilibrate=1.0), [], RUN)
    for name in PREDICTED:
        assert np.isnan(data["theory"][name].values).tolist() == [[False, True]]


def test_values_stand_at_their_point_and_seed(data, results) -> None:
    for (point, seed), replica in results.items():
        there = data["sums"].isel(packing_fraction=point // 2, restitution=point % 2, seed=seed)
        assert there.status == replica.status
        assert there.strain == pytest.approx(replica.sample.tally.duration.sum())
        assert there.equilibration_strain == replica.strain


def test_point_is_the_ratio_of_the_sums_of_its_seeds_that_were_not_given_up(data, results) -> None:
    for point in range(4):
        tallies = [
            replica.sample.tally
            for (place, _), replica in results.items()
            if place == point and replica.status != Status.infeasible
        ]
        flow = data.isel(packing_fraction=point // 2, restitution=point % 2)
        ratio = sum(t.impulse.sum() for t in tallies) / sum(t.binary_impulse.sum() for t in tallies)
        assert flow.force_ratio == pytest.approx(ratio)
        moment = sum(t.contact_moment.sum(axis=0) for t in tallies)
        volume = sum(t.duration.sum() for t in tallies) * results[point, 0].sample.area
        np.testing.assert_allclose(flow["stresses"].contact_stress, moment / volume)
        assert flow["diagnostics"].max_overlap == max(t.largest_overlap.max() for t in tallies)


def test_worst_status_wins_and_is_a_cf_flag(data) -> None:
    np.testing.assert_array_equal(
        data.status, [[Status.iteration_limit, Status.infeasible], [Status.ok, NOT_RUN]]
    )
    expected = {-1: "not_run", **{s.value: s.name for s in Status}}
    for status in (data.status, data["sums/status"]):
        values, meanings = status.flag_values, status.flag_meanings.split()
        assert dict(zip(values.tolist(), meanings, strict=True)) == expected
        assert status.dtype == values.dtype


def test_the_error_that_is_asked_for_is_that_of_all_seeds_together() -> None:
    """One imprecise seed is none of the point, unless another is missing or all are imprecise."""
    settings = MapSettings((0.2, 0.5), (0.6,), grains=64, seeds=2, timestep=1e-4, error=0.4)
    rng = np.random.default_rng(0)
    replicas = [random_replica(rng, settings, Status.imprecise, point) for point in range(2)]
    replicas.append(random_replica(rng, settings, Status.ok, 0, 1))
    assert map_dataset(settings, replicas, RUN).status.values.tolist() == [[Status.ok, NOT_RUN]]
    finer = replace(settings, error=0.001)
    assert map_dataset(finer, replicas, RUN).status[0, 0] == Status.imprecise


def test_replicas_that_were_given_up_have_failed(settings, results) -> None:
    lost = Replica(replica_id(settings, 0), None, Status.failed, np.nan)
    given_up = map_dataset(settings, {**results, (0, 0): lost}.values(), RUN)
    assert given_up["sums/status"][0, 0, 0] == given_up.status[0, 0] == Status.failed
    assert np.isfinite(given_up.force_ratio[0, 0])
    assert {*measured_ids(given_up)} == {x.id for x in results.values()} - {lost.id}


def test_a_jammed_point_has_no_value(settings, results) -> None:
    jammed = results | {
        key: results[key]._replace(status=int(Status.infeasible)) for key in results if key[0] == 1
    }
    point = map_dataset(settings, jammed.values(), RUN).isel(packing_fraction=0, restitution=1)
    assert point.status == Status.infeasible
    for name in ("force_ratio", "pressure_stderr", "pressure_large_system_ci95"):
        assert np.isnan(point[name]).all()


def test_missing_replicas_are_nan_and_not_run(settings, data) -> None:
    missing = data["sums"].isel(packing_fraction=1, restitution=1, seed=[1, 2])
    assert (missing.status == NOT_RUN).all()
    nothing = map_dataset(settings, [], {})
    for name, row in OBSERVABLES.items():
        assert np.isnan(nothing[path_of(name)]).all(), name
        if row.group != "diagnostics":
            assert np.isnan(nothing[f"{path_of(name)}_stderr"]).all(), name
    assert (nothing.status == NOT_RUN).all()


def test_dataset_survives_the_disc(data, tmp_path: Path) -> None:
    write_dataset(data, tmp_path / "map.nc")
    again = open_map(tmp_path / "map.nc")
    assert again.equals(data)
    assert (again.force_ratio.grains, again.force_ratio.timestep) == (64, 5e-4)  # coordinates
    stored, made = flattened(again), flattened(data)
    for name in made.variables:
        assert set(stored[name].attrs) == set(made[name].attrs), name
        for key, value in made[name].attrs.items():
            np.testing.assert_array_equal(stored[name].attrs[key], value)
    for key, value in data.attrs.items():
        np.testing.assert_array_equal(again.attrs[key], value)
    assert [path.name for path in tmp_path.iterdir()] == ["map.nc"]


def test_files_without_a_checksum_are_read_and_every_flipped_bit_of_others_is_found(
    few, tmp_path: Path
) -> None:
    path, rng = tmp_path / "map.nc", np.random.default_rng(0)
    few.to_netcdf(path, engine="netcdf4")
    assert open_map(path).equals(few)
    write_dataset(few, path)
    whole = path.read_bytes()
    for place in rng.integers(len(whole) - 40, size=50):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        with pytest.raises(ValueError, match="damaged"):
            open_map(path)


def test_errors_of_a_point_are_those_of_its_own_flow(settings, data) -> None:
    flat = flattened(data)
    for alpha, nu in product(ALPHAS, NUS):
        point = flat.sel(packing_fraction=nu, restitution=alpha)
        numbers = {
            path.split("/")[-1]: float(x)
            for path, x in point.items()
            if x.ndim == 0 and "theory" not in path
        }
        errors = {name: numbers.get(f"{name}_stderr", np.nan) for name in numbers}
        numbers["contact_stress"] = point["stresses/contact_stress"].values
        flow = alpha, nu, *settings.grains, *settings.timestep
        estimates = large_system(numbers, errors, *flow, settings.solver.tolerance)
        for name, estimate in estimates.items():
            path = f"{name}_large_system"
            assert float(point[path]) == pytest.approx(float(estimate.value), nan_ok=True)
            for source, half_width in {"total": estimate.total, **estimate.sources}.items():
                stored = point[f"{path}_ci95"].sel(error_source=source)
                np.testing.assert_allclose(stored, half_width, rtol=1e-6)
            assert f"{path}_ci95" in data[path].attrs["ancillary_variables"].split()


def test_grains_chosen_by_point_are_in_the_file_and_change_the_error(tmp_path: Path) -> None:
    by_point = (64, 256, 256, 1024)
    given = {"seeds": 1, "timestep": 5e-4, "error": 0.1, "grains_by_point": by_point}
    chosen = MapSettings(ALPHAS, NUS, grains=1024, **given)
    assert tuple(point.grains for point in chosen.points) == by_point
    rng = np.random.default_rng(0)
    replicas = [random_replica(rng, chosen, Status.ok, point) for point in range(4)]
    data = map_dataset(chosen, replicas, RUN)
    assert data.point_grains.values.ravel().tolist() == list(by_point)
    half_width = data.pressure_large_system_ci95.sel(error_source="size")
    relative = (half_width / abs(data.pressure_large_system)).values.ravel()
    points = zip(product(NUS, ALPHAS), by_point, strict=True)
    law = SIZE_LAWS["pressure"]
    expected = [float(law.error(alpha, nu, grains)) for (nu, alpha), grains in points]
    np.testing.assert_allclose(relative, expected, rtol=1e-6)
    write_dataset(with_variables(data, *FEW), tmp_path / "map.nc")
    assert MapSettings(**from_attrs(open_map(tmp_path / "map.nc"))) == chosen
