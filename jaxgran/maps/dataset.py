"""The data of a ratio map: a DataTree of observables with errors on the grid, and all parameters of
the run.
"""

from collections import defaultdict
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import xarray as xr

from jaxgran.dynamics.engine import select_engine
from jaxgran.maps.attributes import to_attrs
from jaxgran.maps.batches import points_of_part
from jaxgran.maps.conventions import CONVENTIONS, follow_conventions
from jaxgran.maps.own_observables import own_variables
from jaxgran.maps.point_values import PointValues
from jaxgran.maps.provenance import made_with
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.schema import ERROR_SOURCES, FORMAT_VERSION
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.variables import COORDINATES, VARIABLES

_UNIFORM = "diameters uniform in 1 +- polydispersity, quantile midpoints; mass = diameter squared"
_GIVEN = "the diameters over their mean, as many grains of each; mass = diameter squared"


def map_dataset(
    settings: MapSettings,
    replicas: Mapping[Key, Replica | None],
    run: Mapping[str, str | float | int],
    fewer_seeds: bool = False,
) -> xr.DataTree:
    """The data of the finished replicas; points without any are NaN with the status ``not_run`` or
    ``failed``.

    Its variables and coordinates are the rows of ``maps.variables``, and with the setting
    ``observe`` also ``own_variables``. A point is (packing_fraction, restitution). If the settings
    have a list of numbers of grains or of time steps, the dimensions grains and timestep come
    before these.

    Args:
      settings: the map.
      replicas: replicas by point (in the order of ``settings.flows()``) and seed; None for those
        that were given up.
      run: further attributes to store: command, wall time, speed; with ``engine`` and ``solver``
        also what ran, where that is not what this process would take.
      fewer_seeds: whether points may have fewer seeds than others, and are measured then.
    """
    points = PointValues(settings, replicas, fewer_seeds)
    groups: dict[str, dict[str, xr.Variable]] = defaultdict(dict)
    for row in VARIABLES:
        groups[row.group].update(row.on(points))
    groups["/"] |= own_variables(settings, points.grid, points.averages.samples)
    coordinates = _coordinates(points)
    tree = {
        group: follow_conventions(xr.Dataset(variables, coordinates.get(group)))
        for group, variables in groups.items()
        if variables
    }
    ran = {} if "engine" in run else what_runs(settings)
    tree["/"].attrs.update({**run_attributes(settings), **ran, **_history(run), **run})
    return xr.DataTree.from_dict(tree)


def _coordinates(points: PointValues) -> dict[str, dict[str, xr.Variable]]:
    """The coordinates by the group that they belong to."""
    settings, grid = points.settings, points.grid
    single = {"timestep": settings.timestep, "grains": settings.grains}
    labels = {"error_source": ERROR_SOURCES, "axis_a": ("x", "y"), "axis_b": ("x", "y")}

    def along(name: str, values: Any) -> dict[str, xr.Variable]:
        return {name: xr.Variable(name, list(values), COORDINATES[name])}

    root: dict[str, xr.Variable] = {}
    for name, values in {**settings.axes, **labels}.items():
        root |= along(name, values)
    for name, value in single.items():
        if name == "grains" and settings.grains_by_point is not None:
            root["point_grains"] = grid.variable(grid.grains, COORDINATES["point_grains"])
        elif name not in settings.axes:
            root[name] = xr.Variable((), value, COORDINATES[name])
    return {
        "/": root,
        "diagnostics": along("observable", points.averages.observable_correlation),
        "sums": along("seed", range(settings.seeds)),
    }


def _history(run: Mapping[str, Any]) -> dict[str, str]:
    """When and by what a map was made, in the form of CF; a command that continues a map is the
    last one.
    """
    return {
        "history": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} "
        f"{run.get('command', 'jaxgran.ratio_map')}"
    }


def run_attributes(settings: MapSettings) -> dict[str, Any]:
    """All parameters of the run, in types that NetCDF can store.

    ==========================  ====================================================================
    attribute                   meaning
    ==========================  ====================================================================
    title, Conventions          what the file is, and the version of the CF conventions
    format_version              of the groups and names in the file; files of another one are
                                refused
    restitution, …, first_seed  the settings by their names in ``ratio_map``, see ``to_attrs``
    engine, solver              what ran; numbers of grains, preparation and sample may have
                                different ones on a GPU
    engine_requested, solver_requested  what was asked for
    observe                     names of the user's observables, and a hash of what their function
                                computes
    equilibrate                 strain before the sample, or "until steady"
    timestep_unit               of the time step
    strain_meaning              of the strain
    shear_rate                  γ̇
    polydispersity or           of the grains
    diameters,
    size_distribution
    part, part_points           share of the points that the file has, and their numbers from 0, if
                                it is not all
    tolerance, max_steps        of a contact solve
    solver_parameters           all fields of the solver, in JSON
    precision, device,          what it was computed with; the commit is empty outside a repository
    platform, python, commit
    version_PACKAGE             version of jaxgran and of packages that the numbers depend on
    code_digest                 hash of the sources of jaxgran
    random_bits                 generator of random numbers
    history, command            when and by what command the map was made
    automatic_choice            what was chosen by ``auto``, in words
    workers, resumed_replicas   number of threads, and of replicas that an earlier process left
    wall_time_seconds,          of the last process
    replica_steps_per_second
    ==========================  ====================================================================
    """
    return {
        "title": "Ratio of the mean contact force to that of binary collisions in simple shear of "
        "hard discs",
        "Conventions": CONVENTIONS,
        "format_version": FORMAT_VERSION,
        **to_attrs(settings),
        "timestep_unit": "1 / shear rate",
        "strain_meaning": "sampled strain of each seed; where none is given, see sums/strain",
        "shear_rate": settings.flows()[0].shear_rate,
        "size_distribution": _UNIFORM if settings.diameters is None else _GIVEN,
        **({} if settings.part is None else {"part_points": points_of_part(settings)}),
        **made_with(),
    }


def what_runs(settings: MapSettings) -> dict[str, str]:
    """The attributes ``engine`` and ``solver``: what this process takes for the flows of a map."""
    engine = select_engine(settings.numerics)
    return {"engine": engine.name, "solver": engine.solver_in_use(settings.solver)}
