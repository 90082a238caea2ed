"""What the CF conventions ask of a map: attributes by which other programs understand its variables.

=====================  ===================================  ==========================================================
attribute              of                                   meaning
=====================  ===================================  ==========================================================
units                  all numbers but flags                "1": all are in units of m, σ and t, so they have no
                                                            dimension
reduced_unit           numbers that are no pure numbers     this unit, such as "m sigma / t^2"
ancillary_variables    values with errors, values by seed   names of their errors, of the strain of an independent
                                                            sample, and of their status
cell_methods           averages                             over what a value is an average; realization is the seed
coordinates            all, in the file                     number of grains and time step where a map has one of each,
                                                            names of tensor components
flag_values,           statuses, limits seen                numbers and their meanings
flag_meanings
standard_name          seed, statuses                       the name of CF
=====================  ===================================  ==========================================================

σ is the mean diameter, m the mass of a grain of that diameter (unless grains have their own), t the unit of time: 1/γ̇
at a shear rate of 1. A program that knows SI units would read "m / t^2" as metres per tonne squared, so such texts do
not stand in ``units``.
"""

import xarray as xr

from jaxgran.sampling.observables import EXTREME_OBSERVABLES, OBSERVABLES

CONVENTIONS = "CF-1.11"
_COMPANIONS = ("stderr", "error", "error_timestep", "error_size", "error_tolerance", "correlation_strain")
_STANDARD_NAMES = {"status": "aggregate_quality_flag", "status_by_seed": "quality_flag", "seed": "realization"}
_SUMS = " (ratio of sums over time steps)"


def follow_conventions(data: xr.Dataset) -> xr.Dataset:
    """A map whose variables have the attributes of the module; it comes with long names and units in m, σ and t."""
    for name in map(str, data.variables):
        about = data[name].attrs
        if about.get("units", "1") != "1":
            about |= {"reduced_unit": about["units"], "units": "1"}
        if name in _STANDARD_NAMES:
            about["standard_name"] = _STANDARD_NAMES[name]
        linked = _ancillary(data, name)
        if linked:
            about["ancillary_variables"] = " ".join(linked)
        if name.removesuffix("_by_seed") in OBSERVABLES:
            about["cell_methods"] = _cell_methods(name)
    return data


def _ancillary(data: xr.Dataset, name: str) -> list[str]:
    """The variables that say how good a value is."""
    if name.endswith("_by_seed") and name.removesuffix("_by_seed") in OBSERVABLES:
        return ["status_by_seed"]
    linked = [f"{name}_{ending}" for ending in _COMPANIONS if f"{name}_{ending}" in data]
    if name.endswith("_large_system"):
        return [*linked, name.replace("_large_system", "_limit_seen")]
    return [*linked, "status"] if linked else []


def _cell_methods(name: str) -> str:
    """Over what an observable is an average, in the words of CF: time in a sample, and seeds but by seed."""
    observable = name.removesuffix("_by_seed")
    over = "time:" if observable != name else "realization: time:"
    if observable in EXTREME_OBSERVABLES:
        return f"{over} maximum"
    return f"{over} median" if observable.startswith("median_") else f"{over} mean{_SUMS}"
