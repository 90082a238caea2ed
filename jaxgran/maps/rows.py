"""A replica as arrays by the paths of ``VARIABLES``, in the data of a map and in a file of its own,
and back.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np
import xarray as xr

from jaxgran.dynamics.tally import empty_tally, flat_tally, tally_from_flat
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.replica import AXES, Replica, ReplicaId
from jaxgran.maps.schema import flag_names, flattened
from jaxgran.maps.settings import MapSettings, rounded
from jaxgran.maps.states import FIELDS, state_of
from jaxgran.maps.variables import NOT_RUN
from jaxgran.model.checks import InputError
from jaxgran.model.state import State
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.correlation_strain import mass_of_grains
from jaxgran.sampling.sample import Sample

SUMS = ("status", "strain", "equilibration_strain", "area", "tally")
"""The variables of the group ``sums``."""

_READ = ("sums/", "states/", "point_grains")


def sums_of(replica: Replica) -> dict[str, np.ndarray]:
    """The numbers of a replica by their names in the group ``sums``; its status alone if it was
    given up.
    """
    sample, status = replica.sample, np.asarray(replica.status, np.int8)
    if sample is None:
        return {"status": status}
    return {
        "status": status,
        "strain": np.asarray(sample.tally.duration.sum() * sample.flow.shear_rate),
        "equilibration_strain": np.asarray(replica.strain),
        "area": np.asarray(sample.area),
        "tally": flat_tally(sample.tally, np.shape(sample.tally.steps)),
    }


def replica_of(
    settings: MapSettings,
    replica: ReplicaId,
    sums: Mapping[str, np.ndarray],
    dtype: np.dtype,
    own_sums: Mapping[str, jax.ShapeDtypeStruct] | None,
    state: State | None = None,
) -> Replica:
    """The replica of ``sums_of``, in a map of these settings but for its axes and seeds, with
    ``own_sums`` of ``sums_by_name``.
    """
    status = int(sums["status"])
    if not np.isfinite(sums.get("area", np.nan)):
        return Replica(replica, None, status, np.nan)
    flow = jax.tree.map(dtype.type, settings.flow_at(replica.point))
    area = float(sums["area"])
    sample = Sample(
        tally_from_flat(sums["tally"], dtype, own_sums),
        dtype.type(area),
        dtype.type(mass_of_grains(flow.packing_fraction, area)),
        flow,
    )
    return Replica(replica, sample, status, float(sums["equilibration_strain"]), state)


def measured_ids(data: xr.DataTree) -> dict[ReplicaId, tuple[int, ...]]:
    """The replicas that a map has measured, with their places in ``_with_all_axes`` of it.

    Raises:
      InputError: (a ValueError) the data have no sums.
    """
    return _places(_with_all_axes(data), int(data.attrs["first_seed"]))


def _places(whole: xr.Dataset, first_seed: int) -> dict[ReplicaId, tuple[int, ...]]:
    coords = [[rounded(x) for x in whole[name].values.tolist()] for name in AXES]
    sizes = whole["point_grains"].values[0] if "point_grains" in whole else None
    ids = {}
    for place in map(tuple, np.argwhere(np.isfinite(whole["sums/area"].values)).tolist()):
        grains, dt, nu, alpha = (axis[k] for axis, k in zip(coords, place[:-1], strict=True))
        if sizes is not None:
            grains = sizes[place[1:-1]]
        ids[ReplicaId(int(grains), dt, nu, alpha, first_seed + place[-1])] = place
    return ids


def replicas_of(data: xr.DataTree, settings: MapSettings) -> Iterator[Replica]:
    """The replicas that a map has measured, whose settings but axes and seeds are the given ones.

    Raises:
      InputError: (a ValueError) the data have no sums.
    """
    whole, dtype = _with_all_axes(data), np.dtype(str(data.attrs["precision"]))
    names = flag_names(whole["sums/status"])
    own_sums = sums_by_name(settings)
    leaves = jax.tree.leaves((empty_tally(dtype), own_sums))
    if whole.sizes["quantity"] != sum(math.prod(leaf.shape) for leaf in leaves):
        raise InputError("data must have the running sums of this version and of `observe`.")
    arrays = {name: whole[f"sums/{name}"].values for name in SUMS}
    fields = [f"states/{name}" for name in FIELDS if f"states/{name}" in whole]
    states = {path.partition("/")[2]: whole[path].values for path in fields}
    kept = set()
    for replica, place in _places(whole, int(data.attrs["first_seed"])).items():
        sums = {name: array[place] for name, array in arrays.items()}
        name = names[int(sums["status"])]
        sums["status"] = np.asarray(Status[name] if name in Status.__members__ else NOT_RUN)
        state = None
        if states and replica.point not in kept and sums["status"] < GIVEN_UP:
            kept.add(replica.point)  # the state is that of the first good seed
            state = state_of({name: x[place[:-1]] for name, x in states.items()}, dtype)
        yield replica_of(settings, replica, sums, dtype, own_sums, state)


def _with_all_axes(data: xr.DataTree) -> xr.Dataset:
    """The sums and states of a map, flattened, with the dimensions of ``AXES`` first, then those of
    the seeds.
    """
    flat = flattened(data)
    if "sums/tally" not in flat or "seed" not in flat.dims:
        raise InputError(
            "data must have the group sums with its seeds, which maps of this version have, and "
            "averages of them do not."
        )
    if "grains" not in flat.coords:  # a map that has another number at each point
        flat = flat.assign_coords(grains=0).reset_coords("point_grains")
    whole: Any = flat[[x for x in flat.data_vars if str(x).startswith(_READ)]]
    whole = whole.expand_dims([name for name in AXES if name not in whole.dims])
    return whole.transpose(*AXES, "seed", ...)
