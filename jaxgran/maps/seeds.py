"""The replicas of a map: the status and the strains of each seed."""

from collections.abc import Mapping

import numpy as np

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


def worst_status(statuses: np.ndarray, fewer_seeds: bool = False) -> np.ndarray:
    """The worst status (points,) over the seeds; ``NOT_RUN`` if a seed is missing and the others
    are ok, or, where points may have fewer seeds than others, if all are missing.
    """
    worst = statuses.max(axis=1)
    missing = (statuses.min(axis=1) == NOT_RUN) & (not fewer_seeds)
    return np.where(missing & (worst <= Status.ok), NOT_RUN, worst).astype(np.int8)


def seed_strains(
    settings: MapSettings, replicas: Mapping[Key, Replica | None]
) -> tuple[np.ndarray, np.ndarray]:
    """The sampled strain and the strain before the sample of every replica, (points, seeds)."""
    sampled, before = (np.full((len(settings.flows()), settings.seeds), np.nan) for _ in range(2))
    for key, replica in replicas.items():
        if replica is not None:
            before[key] = replica.strain
            sampled[key] = replica.sample.tally.duration.sum() * replica.sample.flow.shear_rate
    return sampled, before
