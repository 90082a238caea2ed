"""The running sums of the replicas in the data of a map, so that maps are merged with the averages
of one run.
"""

from collections.abc import Mapping

import numpy as np
import xarray as xr

from jaxgran.dynamics.tally import flat_tally, tally_from_flat
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.schema import flattened
from jaxgran.maps.seeds import NOT_RUN
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import states_of
from jaxgran.model.checks import InputError
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.sample import Sample


def sum_variables(
    settings: MapSettings, grid: PointGrid, replicas: Mapping[Key, Replica | None]
) -> dict[str, xr.Variable]:
    """The group ``sums``.

    ========  ==============================  ======================================================
    variable  dimensions                      meaning
    ========  ==============================  ======================================================
    tally     (point, seed, block, quantity)  the numbers of the ``Tally`` of each block of a
                                              sample, in the order of its fields, and behind them
                                              the sums of the user's observables
    area      (point, seed)                   area of the cell
    ========  ==============================  ======================================================
    """
    flat = {}
    for key, replica in replicas.items():
        if replica is not None:
            flat[key] = flat_tally(replica.sample.tally, np.shape(replica.sample.tally.steps))
    shape = (len(grid.flows), settings.seeds)
    sums, area = np.full((*shape, *next(iter(flat.values())).shape), np.nan), np.full(shape, np.nan)
    for key, numbers in flat.items():
        sums[key], area[key] = numbers, replicas[key].sample.area  # type: ignore[union-attr]
    about = {
        "long_name": "running sums of each block of a sample, in the order of the fields of Tally",
        "units": "1",
    }
    about_area = {"long_name": "area of the cell", "units": "sigma^2"}
    tally = grid.variable(sums, about, "seed", "block", "quantity")
    tally.encoding = {"zlib": True, "shuffle": True, "complevel": 4}
    return {"tally": tally, "area": grid.variable(area, about_area, "seed")}


def replicas_of(data: xr.DataTree, settings: MapSettings) -> dict[Key, Replica | None]:
    """The replicas of a map of these settings, by point and seed from 0; None for those that were
    given up.

    Raises:
      InputError: (a ValueError) the data have no sums.
    """
    if "sums" not in data.children:
        raise InputError("data must have the group sums, which maps of this version have.")
    flows = settings.flows()
    shape, numbers = (len(flows), settings.seeds), flattened(data)
    status, strain, area = (
        numbers[name].values.reshape(shape)
        for name in ("seeds/status", "seeds/equilibration_strain", "sums/area")
    )
    flags = numbers[
        "seeds/status"
    ].attrs  # those of the file, which an earlier version may have written
    for value, name in zip(flags["flag_values"], flags["flag_meanings"].split(), strict=True):
        own = Status[name] if name in Status.__members__ else NOT_RUN
        status = np.where(numbers["seeds/status"].values.reshape(shape) == value, own, status)
    sums = numbers["sums/tally"].values
    sums = sums.reshape(*shape, *sums.shape[-2:])
    dtype, own_sums = np.dtype(str(data.attrs["precision"])), sums_by_name(settings)
    states = states_of(data["states"].to_dataset(), len(flows), dtype) if settings.snapshots else {}
    found: dict[Key, Replica | None] = {}
    for point, seed in np.argwhere(status >= Status.ok).tolist():
        key = point, seed
        if np.isnan(area[key]):
            found[key] = None
            continue
        tally = tally_from_flat(sums[key], dtype, own_sums)
        shear_rate = dtype.type(flows[point].shear_rate)
        sample = Sample(tally, dtype.type(area[key]), shear_rate, flows[point].grains)
        state = states.pop(point, None) if status[key] < GIVEN_UP else None
        found[key] = Replica(sample, int(status[key]), float(strain[key]), state)
    return found
