"""The data of a ratio map: a DataTree of observables with errors on the grid, and all parameters of
the run.
"""

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import xarray as xr

from jaxgran.dynamics.engine import select_engine, solver_in_use
from jaxgran.maps.attributes import to_attrs
from jaxgran.maps.batches import points_of_part
from jaxgran.maps.confidence import confidence_variables
from jaxgran.maps.conventions import CONVENTIONS, follow_conventions
from jaxgran.maps.diagnostics import diagnostic_variables, observable_coordinate
from jaxgran.maps.own_observables import own_variables
from jaxgran.maps.points import PointAverages, PointGrid, point_averages
from jaxgran.maps.provenance import made_with
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.schema import ERROR_SOURCES, FORMAT_VERSION
from jaxgran.maps.seeds import (
    NOT_RUN,
    STATUS_FLAGS,
    replica_statuses,
    seed_coordinate,
    seed_variables,
    worst_status,
)
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import first_of_points, state_variables
from jaxgran.maps.sums import sum_variables
from jaxgran.maps.theory_variables import theory_variables
from jaxgran.model.status import Status
from jaxgran.sampling.observables import GROUPS

_AXES = {
    "grains": {"long_name": "number of grains", "units": "1"},
    "timestep": {"long_name": "time step of the sample", "units": "1 / shear rate"},
    "packing_fraction": {"long_name": "packing fraction", "units": "1"},
    "restitution": {"long_name": "restitution", "units": "1"},
}
_UNIFORM = "diameters uniform in 1 +- polydispersity, quantile midpoints; mass = diameter squared"
_GIVEN = "the diameters over their mean, as many grains of each; mass = diameter squared"
_TITLES = {
    "stresses": "stress and dissipation by origin: contact forces, the same if collisions were "
    "binary, peculiar motion",
    "theory": "predictions of kinetic theory, and factors by which it fails",
    "diagnostics": "quality of the contact solves, conservation of momentum and energy, "
    "correlation of samples",
    "seeds": "replicas of each point",
    "sums": "running sums of each replica, from which all averages follow",
    "states": "last state of one replica of every point",
}


def map_dataset(
    settings: MapSettings,
    replicas: Mapping[Key, Replica | None],
    run: Mapping[str, str | float | int],
) -> xr.DataTree:
    """The data of the finished replicas; points without any are NaN with the status ``not_run`` or
    ``failed``.

    A point is (packing_fraction, restitution). If the settings have a list of numbers of grains or
    of time steps, the dimensions grains and timestep come before these. Tensors have the dimensions
    (axis_a, axis_b) last.

    ============================  ====================  ============================================
    root                          dimensions            meaning
    ============================  ====================  ============================================
    NAME, NAME_stderr             point                 average over all seeds and its standard
                                                        error, for each observable of the root
    NAME_ci95                     (point,               half-width of its 95 % interval for a large
                                                        system, for the
                                  error_source)         names in ``BUDGET``
    NAME, NAME_stderr, NAME_ci95  point, …              only with the setting ``observe``, see
                                                        ``own_variables``
    status                        point                 worst status
    correlation_strain            point                 strain over which the flow is correlated
    ============================  ====================  ============================================

    ============================  ==================================================================
    group                         content
    ============================  ==================================================================
    stresses                      NAME and NAME_stderr for each observable of this group
    theory                        see ``theory_variables``
    diagnostics                   see ``diagnostic_variables``
    seeds                         see ``seed_variables``
    sums                          see ``sum_variables``
    states                        only with the setting ``snapshots``, see ``state_variables``
    ============================  ==================================================================

    ============================  ====================  ============================================
    coordinate                    dimensions            meaning
    ============================  ====================  ============================================
    packing_fraction,             of their own          values of the plane
    restitution
    grains, timestep              of their own or none  values of a list, or the one of all points
    point_grains                  point                 number of grains, if it was chosen by point
    error_source                  of its own            total, sampling, timestep, size, tolerance
    seed                          of its own            0, 1, …: number of the replica, from
                                                        ``first_seed`` on
    observable                    of its own            name of an observable, in ``diagnostics``
    axis_a, axis_b                of their own          "x" and "y": of the centre-to-centre vector,
                                                        of the force
    ============================  ====================  ============================================

    Args:
      settings: the map.
      replicas: replicas by point (in the order of ``settings.flows()``) and seed; None for those
        that were given up.
      run: further attributes to store: command, wall time, speed; with ``engine`` and ``solver``
        also what ran, where that is not what this process would take.
    """
    grid = PointGrid.of(settings)
    averages, statuses = point_averages(settings, replicas), replica_statuses(settings, replicas)
    groups = {
        "/": _core(settings, grid, averages, statuses),
        "stresses": xr.Dataset(
            grid.averages(GROUPS["stresses"], averages.values, averages.stderrs)
        ),
        "theory": xr.Dataset(theory_variables(grid, averages.samples)),
        "diagnostics": xr.Dataset(
            diagnostic_variables(grid, averages), {"observable": observable_coordinate(averages)}
        ),
        "seeds": xr.Dataset(
            seed_variables(settings, grid, replicas, statuses), {"seed": seed_coordinate(settings)}
        ),
    }
    if any(replicas.values()):
        groups["sums"] = xr.Dataset(sum_variables(settings, grid, replicas))
    if settings.snapshots:
        groups["states"] = xr.Dataset(state_variables(grid, first_of_points(replicas)))
    tree = {name: follow_conventions(group, name) for name, group in groups.items()}
    tree = {
        name: group.assign_attrs(title=_TITLES[name]) if name in _TITLES else group
        for name, group in tree.items()
    }
    ran = {} if "engine" in run else what_runs(settings)
    tree["/"].attrs.update({**run_attributes(settings), **ran, **_history(run), **run})
    return xr.DataTree.from_dict(tree)


def _core(
    settings: MapSettings, grid: PointGrid, averages: PointAverages, statuses: np.ndarray
) -> xr.Dataset:
    """The root of a map: its main averages with errors, the status and the correlation strain of
    every point.
    """
    worst = np.maximum(
        worst_status(statuses), np.where(averages.drifting, Status.not_steady, NOT_RUN)
    ).astype(np.int8)
    about_status = {
        "long_name": "worst status of a point, over all seeds and of their samples together"
    }
    about_strain = {
        "long_name": "strain over which the flow is correlated, that of one sample",
        "units": "1",
    }
    variables = {
        **grid.averages(GROUPS["/"], averages.values, averages.stderrs),
        **confidence_variables(grid, averages, settings.solver.tolerance),
        **own_variables(settings, grid, averages.samples),
        "status": grid.variable(worst, {**about_status, **STATUS_FLAGS}),
        "correlation_strain": grid.variable(averages.correlation_strain, about_strain),
    }
    return xr.Dataset(variables, _coordinates(settings, grid))


def _coordinates(settings: MapSettings, grid: PointGrid) -> dict[str, xr.Variable]:
    """The coordinates of the root."""
    single: dict[str, Any] = {"timestep": settings.timestep, "grains": settings.grains}
    coordinates = {
        name: xr.Variable(name, list(values), _AXES[name]) for name, values in settings.axes.items()
    }
    for name, value in single.items():
        if name == "grains" and settings.grains_by_point is not None:
            coordinates["point_grains"] = grid.variable(grid.grains, _AXES[name])
        elif name not in settings.axes:
            coordinates[name] = xr.Variable((), value, _AXES[name])
    labels = {
        "error_source": (list(ERROR_SOURCES), "source of an error"),
        "axis_a": (["x", "y"], "direction of the centre-to-centre vector"),
        "axis_b": (["x", "y"], "direction of the force"),
    }
    return coordinates | {
        name: xr.Variable(name, x, {"long_name": words}) for name, (x, words) in labels.items()
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
        "strain_meaning": "sampled strain of each seed; where none is given, see seeds/strain",
        "shear_rate": settings.flows()[0].shear_rate,
        "size_distribution": _UNIFORM if settings.diameters is None else _GIVEN,
        **({} if settings.part is None else {"part_points": points_of_part(settings)}),
        **made_with(),
    }


def what_runs(settings: MapSettings) -> dict[str, str]:
    """The attributes ``engine`` and ``solver``: what this process takes for the flows of a map."""
    flow, of_sample = settings.flows()[0], "" if settings.observe is None else "observe"
    engines = [
        select_engine(replace(flow, grains=grains), settings.numerics, option=option)
        for grains in settings.sizes
        for option in ("", of_sample)
    ]
    solvers = [solver_in_use(engine, settings.solver) for engine in engines]
    return {
        "engine": ", ".join(dict.fromkeys(engine.name for engine in engines)),
        "solver": ", ".join(dict.fromkeys(solvers)),
    }
