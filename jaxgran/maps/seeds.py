"""The replicas of a map: the status, strain and time step of each seed, and its averages where there are several."""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from jaxgran.maps.own_observables import own_seed_variables
from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.observables import OBSERVABLES

NOT_RUN = -1  # status of a replica without a result
STATUS_FLAGS = {
    "flag_values": np.array([NOT_RUN, *Status], np.int8),
    "flag_meanings": " ".join(["not_run", *(status.name for status in Status)]),
}


def replica_statuses(settings: MapSettings, replicas: Mapping[Key, Replica | None]) -> np.ndarray:
    """The status of every replica, (points, seeds): ``NOT_RUN`` where it is missing, failed where it was given up."""
    statuses = np.full((len(settings.flows()), settings.seeds), NOT_RUN, np.int8)
    for key, replica in replicas.items():
        statuses[key] = Status.failed if replica is None else replica.status
    return statuses


def worst_status(statuses: np.ndarray) -> np.ndarray:
    """The worst status (points,) over the seeds; ``NOT_RUN`` if a seed is missing and the others are ok."""
    worst = statuses.max(axis=1)
    return np.where((statuses.min(axis=1) == NOT_RUN) & (worst <= Status.ok), NOT_RUN, worst).astype(np.int8)


def seed_variables(
    settings: MapSettings, grid: PointGrid, replicas: Mapping[Key, Replica | None], statuses: np.ndarray
) -> dict[str, xr.Variable]:
    """The group ``seeds``: variables along the dimension ``seed``.

    ====================  ===========================================================================================
    variable              meaning
    ====================  ===========================================================================================
    status                status of the replica
    strain                sampled strain
    equilibration_strain  strain before the sample
    sample_timestep       time step of the sample
    NAME                  average of each observable, also of the user's, over the replica; only if the map has
                          several seeds, and NaN from the status ``infeasible`` on
    ====================  ===========================================================================================
    """
    shape = (len(grid.flows), settings.seeds)
    strain, equilibration, timestep = (np.full(shape, np.nan) for _ in range(3))
    values = {name: np.full((*shape, *one.shape), np.nan) for name, one in OBSERVABLES.items()}
    for key, replica in replicas.items():
        if replica is None:
            continue
        tally = replica.sample.tally
        equilibration[key] = replica.strain
        strain[key] = tally.duration.sum() * replica.sample.shear_rate
        timestep[key] = strain[key] / tally.steps.sum() if tally.steps.any() else np.nan
        if settings.seeds > 1 and replica.status < GIVEN_UP:
            for name, value in replica.sample.averages.items():
                values[name][key] = value
    about = {
        "strain": (strain, {"long_name": "sampled strain", "units": "1"}),
        "equilibration_strain": (equilibration, {"long_name": "strain sheared before the sample", "units": "1"}),
        "sample_timestep": (timestep, {"long_name": "time step of the sample", "units": "1 / shear rate"}),
    }
    variables = {"status": grid.variable(statuses, {"long_name": "status", **STATUS_FLAGS}, "seed")}
    variables |= {name: grid.variable(column, attrs, "seed") for name, (column, attrs) in about.items()}
    for name, one in OBSERVABLES.items() if settings.seeds > 1 else ():
        attrs = {"long_name": one.meaning, "units": one.unit}
        variables[name] = grid.variable(values[name], attrs, "seed", *one.axes)
    return variables | own_seed_variables(settings, grid, replicas)


def seed_coordinate(settings: MapSettings) -> xr.Variable:
    """The numbers of the seeds."""
    about = {"long_name": "seed of the random numbers, from the first", "units": "1"}
    return xr.Variable("seed", np.arange(settings.seeds), about)
