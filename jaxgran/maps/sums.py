"""The running sums of the replicas in the data of a map, so that maps are merged with the averages
of one run.
"""

from collections.abc import Mapping

import jax
import numpy as np
import xarray as xr

from jaxgran.dynamics.tally import flat_tally, tally_from_flat
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.schema import flag_names, flattened
from jaxgran.maps.seeds import NOT_RUN
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import states_of
from jaxgran.model.checks import InputError
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.correlation_strain import mass_of_grains
from jaxgran.sampling.sample import Sample


def sum_variables(
    settings: MapSettings, grid: PointGrid, replicas: Mapping[Key, Replica | None]
) -> dict[str, np.ndarray]:
    """The values of ``sums/tally`` (points, seeds, blocks, quantities) and ``sums/area`` (points,
    seeds); none without a replica.
    """
    flat = {}
    for key, replica in replicas.items():
        if replica is not None:
            flat[key] = flat_tally(replica.sample.tally, np.shape(replica.sample.tally.steps))
    if not flat:
        return {}
    shape = (len(grid.flows), settings.seeds)
    sums, area = np.full((*shape, *next(iter(flat.values())).shape), np.nan), np.full(shape, np.nan)
    for key, numbers in flat.items():
        sums[key], area[key] = numbers, replicas[key].sample.area  # type: ignore[union-attr]
    return {"tally": sums, "area": area}


def replicas_of(data: xr.DataTree, settings: MapSettings) -> dict[Key, Replica | None]:
    """The replicas of a map of these settings, by point and seed from 0; None for those that were
    given up.

    Raises:
      InputError: (a ValueError) the data have no sums.
    """
    if "sums" not in data.children or "tally" not in data["sums"]:
        raise InputError("data must have the group sums, which maps of this version have.")
    flows = settings.flows()
    shape, numbers = (len(flows), settings.seeds), flattened(data)
    status, strain, area = (
        numbers[name].values.reshape(shape)
        for name in ("sums/status", "sums/equilibration_strain", "sums/area")
    )
    # the flags are those of the file, which an earlier version may have written
    for value, name in flag_names(numbers["sums/status"]).items():
        code = Status[name] if name in Status.__members__ else NOT_RUN
        status = np.where(numbers["sums/status"].values.reshape(shape) == value, code, status)
    sums = numbers["sums/tally"].values
    sums = sums.reshape(*shape, *sums.shape[-2:])
    dtype, own_sums = np.dtype(str(data.attrs["precision"])), sums_by_name(settings)
    states = states_of(data["states"].to_dataset(), len(flows), dtype) if settings.snapshots else {}
    replicas: dict[Key, Replica | None] = {}
    for point, seed in np.argwhere(status >= Status.ok).tolist():
        key = point, seed
        if np.isnan(area[key]):
            replicas[key] = None
            continue
        tally = tally_from_flat(sums[key], dtype, own_sums)
        flow = jax.tree.map(dtype.type, flows[point])
        of_grains = dtype.type(mass_of_grains(flow.packing_fraction, area[key]))
        sample = Sample(tally, dtype.type(area[key]), of_grains, flow)
        state = states.pop(point, None) if status[key] < GIVEN_UP else None
        replicas[key] = Replica(sample, int(status[key]), float(strain[key]), state)
    return replicas
