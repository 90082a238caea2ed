"""A sample as a dataset: its averages with errors and units, named as in the file of a map."""

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from jaxgran.model.status import Status
from jaxgran.sampling.observables import OBSERVABLES, TENSOR_AXES, unit_attributes

if TYPE_CHECKING:
    from jaxgran.sampling.sample import Sample


def dataset_of(sample: "Sample") -> xr.Dataset:
    """The dataset of ``Sample.to_dataset``."""
    replicas = ("replica",) * np.ndim(sample.area)
    values, errors = sample.averages, sample.errors()
    variables: dict[str, Any] = {}
    for name, one in OBSERVABLES.items():
        dims = (*replicas, *one.axes)
        variables[name] = dims, values[name], _about(one.meaning, one.unit)
        variables[f"{name}_stderr"] = dims, errors[name], _about(one.meaning_of_error, one.unit)
    flags = {"flag_values": np.array([*Status], np.int8), "flag_meanings": " ".join(status.name for status in Status)}
    variables["strain"] = replicas, sample.strain, _about("sampled strain", "1")
    variables["status"] = replicas, np.asarray(sample.status, np.int8), {"long_name": "status", **flags}
    coordinates = {axis: ["x", "y"] for axis in TENSOR_AXES}
    return xr.Dataset(variables, coordinates, {"grains": sample.grains})


def _about(meaning: str, unit: str) -> dict[str, str]:
    """The attributes of a variable, as in a map."""
    return {"long_name": meaning, **unit_attributes(unit)}
