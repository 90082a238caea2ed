"""A sample as a dataset: its averages with errors and units, named as in the file of a map."""

from typing import TYPE_CHECKING, Any

import jax
import numpy as np
import xarray as xr

from jaxgran.environment import versions
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.status import Status
from jaxgran.sampling.observables import OBSERVABLES, TENSOR_AXES, unit_attributes
from jaxgran.sampling.observe import dimensions_of

if TYPE_CHECKING:
    from jaxgran.sampling.sample import Sample

_PARAMETERS = {  # of a flow: what they are, and their units
    "restitution": ("restitution", "1"),
    "packing_fraction": ("packing fraction", "1"),
    "timestep": ("time step", "t"),
    "shear_rate": ("shear rate", "1 / t"),
    "activation": ("part of a step of free flight after which an overlap is a contact", "1"),
}


def dataset_of(sample: "Sample") -> xr.Dataset:
    """The dataset of ``Sample.to_dataset``."""
    replicas = ("replica",) * np.ndim(sample.area)
    values, errors = sample.averages, sample.errors()
    variables: dict[str, Any] = {}
    for name, row in OBSERVABLES.items():
        dims = (*replicas, *row.axes)
        variables[name] = dims, values[name], _about(row.meaning, row.unit)
        error = "standard deviation over blocks" if row.extreme else "standard error"
        about = _about(f"{error} of {row.meaning}", row.unit)
        variables[f"{name}_stderr"] = dims, errors[name], about
    for name, (meaning, unit) in _PARAMETERS.items():
        variables[name] = replicas, getattr(sample.flow, name), _about(meaning, unit)
    flags = {
        "flag_values": np.array([*Status], np.int8),
        "flag_meanings": " ".join(status.name for status in Status),
    }
    variables["strain"] = replicas, sample.strain, _about("sampled strain", "1")
    variables["status"] = (
        replicas,
        np.asarray(sample.status, np.int8),
        {"long_name": "status", **flags},
    )
    observed = _own_variables(sample, replicas)
    if taken := [name for name in observed if name in variables]:
        raise InputError(
            f"observe must return names that a sample does not have, not {short_repr(taken[0])}."
        )
    variables |= observed
    coordinates = {axis: ["x", "y"] for axis in TENSOR_AXES}
    about = {
        "grains": sample.flow.grains,
        "engine": sample.engine,
        "precision": str(np.asarray(sample.area).dtype),
        **{f"version_{name}": number for name, number in versions(["jaxgran"]).items()},
    }
    return xr.Dataset(variables, coordinates, about)


def _own_variables(sample: "Sample", replicas: tuple[str, ...]) -> dict[str, Any]:
    """The means of what ``observe`` returned, with errors, if it is a dictionary of numbers or
    arrays.
    """
    sums = sample.observed_sums
    if not isinstance(sums, dict) or not all(
        isinstance(x, (np.ndarray, jax.Array)) for x in sums.values()
    ):
        return {}
    each = [sample[k].observed() for k in range(len(sample))] if replicas else [sample.observed()]
    variables = {}
    for name in sums:
        means, errors = (np.stack([estimate[kind][name] for estimate in each]) for kind in (0, 1))
        dims = (*replicas, *dimensions_of(name, means.shape[1:]))
        for key, numbers, meaning in (
            (name, means, "mean"),
            (f"{name}_stderr", errors, "standard error of the mean"),
        ):
            values = numbers if replicas else numbers[0]
            variables[key] = dims, values, {"long_name": f"{meaning} of {name} over all time steps"}
    return variables


def _about(meaning: str, unit: str) -> dict[str, str]:
    """The attributes of a variable, as in a map."""
    return {"long_name": meaning, **unit_attributes(unit)}
