"""The replicas of a map: the status and the strains of each seed."""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status

NOT_RUN = -1  # status of a replica without a result
STATUS_FLAGS = {
    "flag_values": np.array([NOT_RUN, *Status], np.int8),
    "flag_meanings": " ".join(["not_run", *(status.name for status in Status)]),
}


def replica_statuses(settings: MapSettings, replicas: Mapping[Key, Replica | None]) -> np.ndarray:
    """The status of every replica, (points, seeds): ``NOT_RUN`` where it is missing, failed where
    it was given up.
    """
    statuses = np.full((len(settings.flows()), settings.seeds), NOT_RUN, np.int8)
    for key, replica in replicas.items():
        statuses[key] = Status.failed if replica is None else replica.status
    return statuses


def worst_status(statuses: np.ndarray) -> np.ndarray:
    """The worst status (points,) over the seeds; ``NOT_RUN`` if a seed is missing and the others
    are ok.
    """
    worst = statuses.max(axis=1)
    return np.where(
        (statuses.min(axis=1) == NOT_RUN) & (worst <= Status.ok), NOT_RUN, worst
    ).astype(np.int8)


def seed_variables(
    settings: MapSettings,
    grid: PointGrid,
    replicas: Mapping[Key, Replica | None],
    statuses: np.ndarray,
) -> dict[str, xr.Variable]:
    """The group ``seeds``: variables along the dimension ``seed``.

    ====================  ==========================================================================
    variable              meaning
    ====================  ==========================================================================
    status                status of the replica
    strain                sampled strain
    equilibration_strain  strain before the sample
    ====================  ==========================================================================
    """
    shape = (len(grid.flows), settings.seeds)
    strain, equilibration = (np.full(shape, np.nan) for _ in range(2))
    for key, replica in replicas.items():
        if replica is None:
            continue
        equilibration[key] = replica.strain
        strain[key] = replica.sample.tally.duration.sum() * replica.sample.shear_rate
    about = {
        "strain": (strain, {"long_name": "sampled strain", "units": "1"}),
        "equilibration_strain": (
            equilibration,
            {"long_name": "strain sheared before the sample", "units": "1"},
        ),
    }
    variables = {"status": grid.variable(statuses, {"long_name": "status", **STATUS_FLAGS}, "seed")}
    return variables | {
        name: grid.variable(column, attrs, "seed") for name, (column, attrs) in about.items()
    }


def seed_coordinate(settings: MapSettings) -> xr.Variable:
    """The numbers of the seeds."""
    about = {"long_name": "seed of the random numbers, from the first", "units": "1"}
    return xr.Variable("seed", np.arange(settings.seeds), about)
