"""A map follows the CF conventions, in the judgement of their checker."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from synthetic import random_replica, random_state

from jaxgran.maps.conventions import CONVENTIONS
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.results import open_map, write_dataset
from jaxgran.maps.schema import path_of
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status
from jaxgran.sampling.observables import OBSERVABLES

# A few variables of each group: the checker takes a time that grows with the square of the number
# of variables.
KINDS = ("force_ratio", "stress_ratio", "local_granular", "max_overlap", "contact_stress")
KINDS += (
    "enskog_pressure",
    "collision_rate",
    "status",
    "correlation",
    "force",
    "x",
)
# CF 7.3.4 accepts standard names, such as time, in cell_methods; the checker knows names of
# coordinates only.
SKIPPED = ("--skip-checks", "check_cell_methods:M")


def made(**choices) -> xr.DataTree:
    """Return a map of random numbers with instants, by settings of one's own."""
    settings = MapSettings((0.5, 0.9), (0.5, 0.6), seeds=2, strain=2.0, snapshots=True, **choices)
    rng = np.random.default_rng(0)
    replicas = [
        random_replica(rng, settings, Status.ok, point, seed)._replace(state=random_state(point))
        for point in range(len(settings.points))
        for seed in range(2)
    ]
    return map_dataset(settings, replicas, {"command": "jaxgran map"})


@pytest.fixture(scope="module")
def several() -> xr.DataTree:
    """A map with all dimensions."""
    return made(grains=(64, 256), timestep=(5e-4, 1e-3))


@pytest.fixture(scope="module")
def single() -> xr.DataTree:
    """A map of one time step, whose number of grains was chosen by point."""
    return made(grains=256, timestep=5e-4, error=0.1, grains_by_point=(64, 256, 64, 256))


def as_a_file_of_its_own(data: xr.DataTree, group: str) -> xr.DataTree:
    """Return some variables of a group, with the status of the map: the checker knows no groups."""
    part = data[group].to_dataset()
    part = part[[name for name in part if name.startswith(KINDS)]].copy(deep=True)
    labels = [name for name in part.coords if part[name].dtype.kind == "U"]
    part = part.drop_vars(labels)  # the checker subtracts coordinates, and fails on names
    part = part if "status" in part else part.assign(status=data.status)
    for variable in part.data_vars.values():
        if "ancillary_variables" in variable.attrs:
            variable.attrs["ancillary_variables"] = variable.attrs["ancillary_variables"].replace(
                "/", ""
            )
    return xr.DataTree(part.assign_attrs(data.attrs))


@pytest.mark.skipif(
    find_spec("compliance_checker") is None, reason="compliance-checker is not installed"
)
def test_the_checker_of_the_conventions_finds_nothing(several, single, tmp_path: Path) -> None:
    files = []
    for data, groups in ((several, several.groups), (single, ("/",))):
        for group in groups:
            files.append(str(tmp_path / f"{len(files)}.nc"))
            write_dataset(as_a_file_of_its_own(data, group), Path(files[-1]))
    checker = [sys.executable, str(Path(sys.executable).with_name("compliance-checker"))]
    test = f"--test={CONVENTIONS.lower().replace('-', ':')}"
    done = subprocess.run(
        [*checker, test, "--criteria=strict", *SKIPPED, *files], capture_output=True, text=True
    )
    assert "exceptions" not in done.stdout + done.stderr
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("All tests passed") == len(files)


@pytest.mark.parametrize("kind", ["several", "single"])
def test_units_are_those_of_pure_numbers_and_links_lead_to_variables(kind: str, request) -> None:
    data = request.getfixturevalue(kind)
    for node in data.subtree:
        for name, variable in node.variables.items():
            flags = "flag_values" in variable.attrs or variable.dtype.kind == "U"
            assert variable.attrs.get("units", "1" if flags else None) == "1", name
            for linked in variable.attrs.get("ancillary_variables", "").split():
                group = data if linked.startswith("/") else node
                assert set(group[linked.strip("/")].dims) <= {*variable.dims, "error_source"}, name
    for name, row in OBSERVABLES.items():
        whole = data[path_of(name)].attrs
        assert whole.get("reduced_unit", "1") == row.unit
        status = "status" if row.group == "/" else "/status"
        errors = set() if row.group == "diagnostics" else {f"{name}_stderr"}
        assert {status, *errors} <= set(whole["ancillary_variables"].split())
        assert whole["cell_methods"].startswith("realization: time: ")


def test_a_number_of_grains_and_a_time_step_of_all_points_are_coordinates(
    several, single, tmp_path: Path
) -> None:
    assert {"point_grains", "timestep"} <= set(single.coords) and "grains" not in single.coords
    assert single.force_ratio.timestep.item() == 5e-4
    data = made(grains=64, timestep=5e-4)
    assert (
        data.grains.item() == 64
        and data.grains.dims == ()
        and not {"grains", "timestep"} & set(data.data_vars)
    )
    write_dataset(data, tmp_path / "map.nc")
    again = open_map(tmp_path / "map.nc")
    assert set(again.coords) == set(data.coords)
    assert {"grains", "timestep"} <= set(again.force_ratio.encoding["coordinates"].split())
    assert again["stresses"].contact_stress.axis_b.values.tolist() == ["x", "y"]
