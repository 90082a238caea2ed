"""What the CF conventions ask of a map: attributes by which other programs understand its
variables.

=====================  ===================================  ========================================
attribute              of                                   meaning
=====================  ===================================  ========================================
units                  all numbers but flags                "1": all are in units of m, σ and t, so
                                                            they have no dimension
reduced_unit           numbers that are not pure numbers    this unit, such as "m sigma / t^2"
ancillary_variables    values with errors                   names of their errors and of their
                                                            status, "/status" where
                                                            it is in the root
cell_methods           averages                             what a value is averaged over; a
                                                            realization is a seed
coordinates            all, in the file                     number of grains and time step where a
                                                            map has one of each
flag_values,           statuses                             numbers and their meanings
flag_meanings
standard_name          seed, statuses                       the name of CF
=====================  ===================================  ========================================

σ is the mean diameter, m the mass of a grain of that diameter (unless grains have their own), t the
unit of time: 1/γ̇ at a shear rate of 1. A program that knows SI units would read "m / t^2" as
metres per tonne squared, so such texts are not in ``units``.
"""

import xarray as xr

from jaxgran.sampling.observables import unit_attributes

CONVENTIONS = "CF-1.11"
_COMPANIONS = ("stderr", "ci95")


def follow_conventions(data: xr.Dataset) -> xr.Dataset:
    """A group with the attributes of the module; it comes with long names, units in m, σ and t,
    cell methods of averages and standard names.
    """
    for name in map(str, data.variables):
        about = data[name].attrs
        if "units" in about:
            about |= unit_attributes(about["units"])
        linked = [f"{name}_{ending}" for ending in _COMPANIONS if f"{name}_{ending}" in data]
        if linked or "cell_methods" in about:
            about["ancillary_variables"] = " ".join(
                [*linked, "status" if "status" in data else "/status"]
            )
    return data
