"""The dataset of a ratio map: observables with errors on the grid, statuses, and all parameters of the run."""

import json
import math
import os
import platform
from collections.abc import Mapping
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import xarray as xr

from jaxgran import environment
from jaxgran.contact.projected_methods import solver_name, solver_numbers
from jaxgran.dynamics.engine import select_engine, solver_in_use
from jaxgran.maps.conventions import CONVENTIONS, follow_conventions
from jaxgran.maps.enskog_factor_variables import enskog_factor_variables
from jaxgran.maps.error_variables import error_variables
from jaxgran.maps.instants import first_of_points, instant_variables
from jaxgran.maps.large_system import BOUNDS, large_system_variables
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings, stack_of_any_size
from jaxgran.model.status import Status
from jaxgran.sampling.correlation_strain import flow_correlation_strain
from jaxgran.sampling.drift import is_drifting
from jaxgran.sampling.observables import EXTREME_OBSERVABLES, OBSERVABLES, TENSORS
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.sampling.sample import Sample, correlation_strains, error_correlation_of, estimates

_THEORY_NAME = "Enskog moments of an anisotropic Gaussian in each size class"
NOT_RUN = -1  # status of a replica without a result
THEORY = ("granular_temperature", "pressure", "shear_stress", "collision_rate")  # predicted as theory_NAME
_TENSOR_AXES = ("axis_a", "axis_b")
_AXES = {
    "grains": {"long_name": "number of grains", "units": "1"},
    "timestep": {"long_name": "time step of the sample", "units": "1 / shear rate"},
    "packing_fraction": {"long_name": "packing fraction", "units": "1"},
    "restitution": {"long_name": "restitution", "units": "1"},
}


def map_dataset(
    settings: MapSettings, found: Mapping[Key, Replica | None], run: Mapping[str, str | float | int]
) -> xr.Dataset:
    """The dataset of the finished replicas; points without any are NaN with the status ``not_run`` or ``failed``.

    ============================  ====================  =============================================================
    variable                      dimensions            meaning
    ============================  ====================  =============================================================
    NAME                          point                 average over all seeds, for each of ``OBSERVABLES``
    NAME_stderr                   point                 its standard error
    NAME_error_PART               point                 its errors of PART timestep, size and tolerance, for the names
                                                        in ``BUDGET``
    NAME_error                    point                 its whole error, half the width of an interval of 95 %
    NAME_correlation_strain       point                 strain of one independent sample, for averages of scalars
    NAME_by_seed                  (point, seed)         average of each seed
    theory_NAME                   point                 prediction of kinetic theory, for the names in ``THEORY``
    enskog_STRESS                 point                 contact pressure and shear stress of Enskog's theory at the
                                                        measured granular temperature, with ``_stderr``
    enskog_factor_STRESS_FACTOR   point                 factors whose product times enskog_STRESS is contact_STRESS,
                                                        see ``sampling.enskog_factors``, with ``_stderr``
    status, status_by_seed        point, (point, seed)  worst status
    memory                        point                 strain over which the flow remembers
    strain_by_seed                (point, seed)         sampled strain
    timestep_by_seed              (point, seed)         time step of the sample
    equilibration_strain_by_seed  (point, seed)         strain before the sample
    friction_error_correlation    point                 of the errors of macroscopic_friction and inertial_number
    NAME_large_system             point without grains  estimate for a large system, for the names in ``BOUNDS``
    NAME_large_system_error       point without grains  bound on its error
    NAME_limit_seen               point without grains  whether the average has a limit at large numbers of grains
    ============================  ====================  =============================================================

    Settings with ``snapshots`` add snapshot_NAME, see ``instant_variables``.

    A point is (packing_fraction, restitution). If the settings have a list of numbers of grains or of time steps, the
    dimensions grains and timestep come before these. Only a map with the dimension grains has the last three kinds of
    variables, see ``large_system_estimate``. Tensors have the dimensions (axis_a, axis_b) last. ``conventions`` lists
    the attributes of the variables.

    ============================  ====================  =============================================================
    coordinate                    dimensions            meaning
    ============================  ====================  =============================================================
    packing_fraction,             of their own          values of the plane
    restitution
    grains, timestep              of their own or none  values of a list, or the one of all points
    point_grains                  point                 number of grains, if it was chosen by point
    seed                          seed                  0, 1, …: number of the replica, from ``first_seed`` on
    direction_a, direction_b      axis_a, axis_b        "x" and "y": of the centre-to-centre vector, of the force
    ============================  ====================  =============================================================

    Args:
      settings: the map.
      found: replicas by point (in the order of ``settings.flows()``) and seed; None for those that were given up.
      run: further attributes to store: command, wall time, speed.
    """
    point_dims, shape = tuple(settings.axes), tuple(map(len, settings.axes.values()))
    count, seeds = math.prod(shape), settings.seeds
    values = {name: np.full((count, *_tensor_shape(name)), np.nan) for name in OBSERVABLES}
    errors = {name: np.full((count, *_tensor_shape(name)), np.nan) for name in OBSERVABLES}
    friction_correlation = np.full(count, np.nan)
    memory, drifting = np.full(count, np.nan), np.zeros(count, bool)
    measured: dict[int, list[Sample]] = {}
    flows = settings.flows()
    scalar_averages = [name for name in OBSERVABLES if name not in EXTREME_OBSERVABLES and name not in TENSORS]
    correlation = {name: np.full(count, np.nan) for name in scalar_averages}
    by_seed = {name: np.full((count, seeds, *_tensor_shape(name)), np.nan) for name in OBSERVABLES}
    status = np.full((count, seeds), NOT_RUN, np.int8)
    equilibration = np.full((count, seeds), np.nan)
    strain = np.full((count, seeds), np.nan)
    timestep = np.full((count, seeds), np.nan)
    results = {key: replica for key, replica in found.items() if replica is not None}
    for key in found.keys() - results.keys():
        status[key] = Status.failed
    for (point, seed), replica in results.items():
        status[point, seed], equilibration[point, seed] = replica.status, replica.strain
        tally = replica.sample.tally
        strain[point, seed] = tally.duration.sum() * replica.sample.shear_rate
        timestep[point, seed] = strain[point, seed] / max(tally.steps.sum(), 1)
        for name, value in replica.sample.averages.items():
            by_seed[name][point, seed] = value
    for point in range(count):
        finite = [results[point, s] for s in range(seeds) if NOT_RUN < status[point, s] < Status.nonfinite]
        if finite:
            samples = measured[point] = [replica.sample for replica in finite]
            value, error = estimates(samples)
            for name in OBSERVABLES:
                values[name][point], errors[name][point] = value[name], error[name]
            grains, spread = flows[point].grains, float(flows[point].polydispersity)
            mass = grains * (1 + spread**2 / 3)
            memory[point] = flow_correlation_strain(value, grains, mass, samples[0].area, samples[0].shear_rate)
            drifting[point] = is_drifting(samples, memory[point])
            friction_correlation[point] = error_correlation_of(samples, "macroscopic_friction", "inertial_number")
            independent = correlation_strains(samples)
            for name in scalar_averages:
                correlation[name][point] = independent[name]

    variables = {}
    for name, (long_name, units) in OBSERVABLES.items():
        tensor_dims = _TENSOR_AXES if name in TENSORS else ()
        dims = point_dims + tensor_dims
        attrs = {"long_name": long_name, "units": units}
        variables[name] = (dims, values[name].reshape(*shape, *_tensor_shape(name)), dict(attrs))
        spread = "standard deviation over blocks" if name in EXTREME_OBSERVABLES else "standard error"
        about = {"long_name": f"{spread} of {long_name}", "units": units}
        variables[f"{name}_stderr"] = (dims, errors[name].reshape(*shape, *_tensor_shape(name)), about)
        if name in correlation:
            about = {"long_name": f"strain of one independent sample of {long_name}", "units": "1"}
            variables[f"{name}_correlation_strain"] = (dims, correlation[name].reshape(shape), about)
        seed_dims = (*point_dims, "seed", *tensor_dims)
        variables[f"{name}_by_seed"] = (seed_dims, by_seed[name].reshape(*shape, seeds, *_tensor_shape(name)), attrs)
    variables |= error_variables(settings, point_dims, values, errors, OBSERVABLES)
    if "grains" in settings.axes:
        averages = {name: (values[name].reshape(shape), errors[name].reshape(shape)) for name in BOUNDS}
        variables |= large_system_variables(point_dims[1:], settings.sizes, averages, OBSERVABLES)
    if settings.snapshots:
        variables |= instant_variables(point_dims, shape, first_of_points(results))
    variables |= enskog_factor_variables(settings, point_dims, measured)
    predictions = _predictions(settings)
    for name in THEORY:
        long_name, units = OBSERVABLES[name]
        about = {"long_name": f"kinetic theory's prediction of the {long_name}", "units": units, "theory": _THEORY_NAME}
        variables[f"theory_{name}"] = (point_dims, predictions[name].reshape(shape), about)
    flags = {
        "long_name": "worst status of a point, over all seeds and of their samples together",
        "flag_values": np.array([NOT_RUN, *Status], np.int8),
        "flag_meanings": " ".join(["not_run", *(s.name for s in Status)]),
    }
    worst = np.maximum(_worst(status), np.where(drifting, Status.not_steady, NOT_RUN)).astype(np.int8)
    variables["status"] = (point_dims, worst.reshape(shape), flags)
    variables["status_by_seed"] = (
        (*point_dims, "seed"),
        status.reshape(*shape, seeds),
        {**flags, "long_name": "status"},
    )
    variables["equilibration_strain_by_seed"] = (
        (*point_dims, "seed"),
        equilibration.reshape(*shape, seeds),
        {"long_name": "strain sheared before the sample", "units": "1"},
    )
    variables["timestep_by_seed"] = (
        (*point_dims, "seed"),
        timestep.reshape(*shape, seeds),
        {
            "long_name": "time step of the sample, shorter than asked for where a replica was retried",
            "units": "1 / shear rate",
        },
    )
    variables["friction_error_correlation"] = (
        point_dims,
        friction_correlation.reshape(shape),
        {"long_name": "correlation of the errors of macroscopic friction and inertial number", "units": "1"},
    )
    variables["memory"] = (
        point_dims,
        memory.reshape(shape),
        {"long_name": "strain over which the flow remembers, that of one independent sample", "units": "1"},
    )
    variables["strain_by_seed"] = (
        (*point_dims, "seed"),
        strain.reshape(*shape, seeds),
        {"long_name": "sampled strain", "units": "1"},
    )
    coordinates = {
        **{name: (name, list(values), _AXES[name]) for name, values in settings.axes.items()},
        **{name: ((), value, _AXES[name]) for name, value in _single(settings).items()},
        **{name: variables.pop(name) for name in ("point_grains",) if name in variables},
        "seed": ("seed", np.arange(seeds), {"long_name": "seed of the random numbers, from the first", "units": "1"}),
        "direction_a": ("axis_a", ["x", "y"], {"long_name": "direction of the centre-to-centre vector"}),
        "direction_b": ("axis_b", ["x", "y"], {"long_name": "direction of the force"}),
    }
    return follow_conventions(xr.Dataset(variables, coordinates, {**run_attributes(settings), **_history(run), **run}))


def _single(settings: MapSettings) -> dict[str, Any]:
    """Number of grains and time step, where all points of a map have the same."""
    values: dict[str, Any] = {"timestep": settings.timestep}
    if settings.grains_by_point is None:
        values["grains"] = settings.grains
    return {name: value for name, value in values.items() if name not in settings.axes}


def _history(run: Mapping[str, Any]) -> dict[str, str]:
    """When and by what a map was made, in the form of CF; a command that goes on with a map is the last one."""
    return {"history": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {run.get('command', 'jaxgran.ratio_map')}"}


def _predictions(settings: MapSettings) -> dict[str, np.ndarray]:
    """Prediction of kinetic theory at every point; NaN where it has no steady state, as at α = 1."""
    flows = stack_of_any_size(settings.flows())
    theory = kinetic_theory(flows.restitution, flows.packing_fraction, flows.shear_rate, flows.polydispersity)
    with np.errstate(invalid="ignore"):
        values = {name: getattr(theory, name) for name in THEORY}
        return {name: np.where(np.isfinite(x) & (x < 1e12), x, np.nan) for name, x in values.items()}


def _tensor_shape(name: str) -> tuple[int, ...]:
    """Shape of an observable at one point: (2, 2) for a tensor, () for a scalar."""
    return (2, 2) if name in TENSORS else ()


def _worst(status: np.ndarray) -> np.ndarray:
    """Worst status over the seeds of each point; not run if a seed is missing and the others are ok."""
    worst = status.max(axis=1)
    return np.where((status.min(axis=1) == NOT_RUN) & (worst <= Status.ok), NOT_RUN, worst).astype(np.int8)


def run_attributes(settings: MapSettings) -> dict[str, Any]:
    """All parameters of the run, in types that NetCDF can store.

    ==========================  =======================================================================================
    attribute                   meaning
    ==========================  =======================================================================================
    title, Conventions          what the file is, and the version of the CF conventions
    restitution, …, first_seed  the settings by their names in ``ratio_map``
    engine, solver              what ran; numbers of grains may have different ones on a GPU
    engine_requested, solver_requested  what was asked for
    equilibrate                 strain before the sample, or "until steady"
    timestep_unit               of the time step
    strain_meaning              of the strain
    shear_rate                  γ̇
    polydispersity,             of the grains
    size_distribution
    tolerance, max_steps        of a contact solve
    solver_parameters           all fields of the solver, in JSON
    precision, device,          what it was computed with; the commit is empty outside a repository
    platform, python, commit
    version_PACKAGE             version of jaxgran and of packages that the numbers depend on
    history, command            when and by what command the map was made
    automatic_choice            what was chosen by ``auto``, in words
    workers, resumed_replicas   number of processes, and of replicas that an earlier process left
    wall_time_seconds,          of the last process
    replica_steps_per_second
    ==========================  =======================================================================================
    """
    parameters = {field.name: getattr(settings, field.name) for field in fields(settings)}
    equilibrate = parameters.pop("equilibrate")
    if settings.error is not None:
        del parameters["strain"]  # it differs between seeds: see ``strain_by_seed``
    parameters = {name: value for name, value in parameters.items() if value is not None}
    flow = settings.flows()[0]
    engines = [select_engine(replace(flow, grains=grains), settings.numerics) for grains in settings.sizes]
    numbers = solver_numbers(settings.solver)
    solvers = [solver_in_use(engine, settings.solver) for engine in engines]
    return {
        "title": "Ratio of the mean contact force to that of binary collisions in simple shear of hard discs",
        "Conventions": CONVENTIONS,
        **{name: list(x) if isinstance(x, tuple) else x for name, x in parameters.items()},
        "snapshots": int(settings.snapshots),  # NetCDF has no True and False
        "engine": ", ".join(dict.fromkeys(engine.name for engine in engines)),
        "solver": ", ".join(dict.fromkeys(solvers)),
        "engine_requested": "auto" if settings.engine is None else settings.engine.name,
        "solver_requested": solver_name(settings.solver),
        "solver_parameters": json.dumps(numbers),
        "tolerance": numbers["tolerance"],
        "max_steps": numbers["max_steps"],
        "equilibrate": "until steady" if equilibrate is None else equilibrate,
        "timestep_unit": "1 / shear rate",
        "strain_meaning": "sampled strain of each seed; where none is given, see strain_by_seed",
        "shear_rate": flow.shear_rate,
        "polydispersity": flow.polydispersity,
        "size_distribution": "diameters uniform in 1 +- polydispersity, quantile midpoints; mass = diameter squared",
        **made_with(),
    }


def made_with() -> dict[str, str]:
    """Precision, device, platform, versions and commit of this process."""
    packages = ("jaxgran", "jax", "jaxlib", "jax-md", "numba", "numpy", "xarray")
    return {
        "precision": environment.precision(),
        "device": environment.devices()[0],
        "platform": f"{environment.system()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "commit": environment.commit(),
        **{f"version_{name.replace('-', '_')}": number for name, number in environment.versions(packages).items()},
    }
