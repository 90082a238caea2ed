"""Estimates for a large system, from a map of several numbers of grains N.

Averages of a sheared flow depend on N. They approach those of a large system by a power of N that differs between
averages and is small (page "System size"). A few sizes do not determine it, so nothing is extrapolated here. The
estimate is the value at the largest N, and its error bounds the change beyond N.

The change beyond N is at most K times the difference between N and N/4. In flows with 0.2 ≤ α ≤ 0.95 and 0.2 ≤ ν ≤
0.8, run up to N = 25600, K was at most 2 for the pressure and 3 for the granular temperature.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr

from jaxgran.maps.points import PointAverages, PointGrid
from jaxgran.maps.settings import MapSettings
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.sampling.observables import OBSERVABLES

CONVERGED = {"not_converged": 0, "converged": 1, "too_few_sizes": 2}  # values of the flag and their meanings
BOUNDS = {  # K of each observable that has an estimate
    "force_ratio": 2.0,
    "pressure": 2.0,
    "shear_stress": 2.0,
    "granular_temperature": 3.0,
    "macroscopic_friction": 2.0,
}
_SIGNIFICANT = 2.0  # standard errors
_FACTOR = math.log(4)  # all steps are those for a factor of four in N


class LargeSystem(NamedTuple):
    """Estimate of an average for a large system.

    =========  =====================================================================================================
    value      that at the largest N; NaN where the average does not converge, or with fewer than two sizes
    error      half-width of the 95 % interval of the limit
    converged  a value of ``CONVERGED``; three sizes are needed to tell whether there is a limit
    =========  =====================================================================================================
    """

    value: float
    error: float
    converged: int


def large_system_estimate(grains: np.ndarray, values: np.ndarray, errors: np.ndarray, bound: float) -> LargeSystem:
    """The large-system limit of an average, from its values at several numbers of grains.

    The error is √((1.96 s)² + K²(d² + s_d²)), half the width of an interval of 95 %. Here d is the difference between N
    and N/4, interpolated in ln N, and s and s_d are the standard errors of the value at the largest N and of d. With
    sizes that span less than a factor of four, d is extrapolated.

    Steps that shrink by the same ratio q at each factor of four add up to d q/(1 − q). This is more than K d if q is
    above K/(1 + K). So no limit is seen if the last step is larger than this share of the step before it, by more than
    two standard errors.

    Args:
      grains: numbers of grains N, (sizes,), all different.
      values: average at each N, (sizes,). Sizes without a finite value and error are left out.
      errors: standard errors of the values, (sizes,).
      bound: K.

    Examples:
      A step of 0.05 after one of 0.2 bounds the rest by 0.1. Two equal steps show no limit.

      >>> sizes, errors = np.array([100, 400, 1600]), np.full(3, 1e-3)
      >>> found = large_system_estimate(sizes, np.array([1.0, 1.2, 1.25]), errors, bound=2.0)
      >>> found.value, round(found.error, 3), found.converged
      (1.25, 0.1, 1)
      >>> large_system_estimate(sizes, np.array([1.0, 1.2, 1.4]), errors, bound=2.0)
      LargeSystem(value=nan, error=nan, converged=0)
    """
    order = np.argsort(grains)
    sizes, x, s = (np.asarray(a, float)[order] for a in (grains, values, errors))
    known = np.isfinite(x) & np.isfinite(s)
    log, x, s = np.log(sizes[known]), x[known], s[known]
    if len(x) < 2:
        return LargeSystem(math.nan, math.nan, CONVERGED["too_few_sizes"])
    d = _difference(log)
    error = math.sqrt((HALF_INTERVAL * s[-1]) ** 2 + bound**2 * ((d @ x) ** 2 + d**2 @ s**2))
    if len(x) == 2:
        return LargeSystem(float(x[-1]), error, CONVERGED["too_few_sizes"])
    if _goes_on(log, x, s, bound):
        return LargeSystem(math.nan, math.nan, CONVERGED["not_converged"])
    return LargeSystem(float(x[-1]), error, CONVERGED["converged"])


def large_system_variables(settings: MapSettings, grid: PointGrid, averages: PointAverages) -> dict[str, xr.Variable]:
    """The group ``large_system`` of a map of several numbers of grains, for the names in ``BOUNDS``.

    ================  =======================================================================
    variable          meaning
    ================  =======================================================================
    NAME              estimate for a large system; a point has no dimension grains here
    NAME_ci95         half-width of the interval that contains it
    NAME_converged    whether the average converges at large numbers of grains
    ================  =======================================================================
    """
    sizes, shape = np.array(settings.sizes), grid.shape[1:]
    variables: dict[str, xr.Variable] = {}
    for name, bound in BOUNDS.items():
        columns = (x[name].reshape(len(sizes), -1).T for x in (averages.values, averages.stderrs))
        found = [large_system_estimate(sizes, x, s, bound) for x, s in zip(*columns, strict=True)]
        value, error, converged = (np.array(part).reshape(shape) for part in zip(*found, strict=True))
        long_name, units = OBSERVABLES[name].meaning, OBSERVABLES[name].unit
        about = {"long_name": f"{long_name} of a large system", "units": units}
        variables[name] = xr.Variable(grid.dims[1:], value, about)
        about = {"long_name": f"half-width of the 95 % interval of the {long_name} of a large system", "units": units}
        variables[f"{name}_ci95"] = xr.Variable(grid.dims[1:], error, about)
        flags = {
            "long_name": f"whether the {long_name} converges at large numbers of grains",
            "flag_values": np.array(list(CONVERGED.values()), np.int8),
            "flag_meanings": " ".join(CONVERGED),
        }
        variables[f"{name}_converged"] = xr.Variable(grid.dims[1:], converged.astype(np.int8), flags)
    return variables


def _difference(log: np.ndarray) -> np.ndarray:
    """Coefficients of the values in the difference between N and N/4, from the logarithms of the sizes."""
    if log[-1] - log[0] < _FACTOR:
        ends = np.zeros(len(log))
        ends[[0, -1]] = -1, 1
        return ends * _FACTOR / (log[-1] - log[0])
    return np.array([np.interp(log[-1], log, one) - np.interp(log[-1] - _FACTOR, log, one) for one in np.eye(len(log))])


def _goes_on(log: np.ndarray, x: np.ndarray, s: np.ndarray, bound: float) -> bool:
    """Whether the last step is significantly too large, compared with the one before it, for the rest to be bounded."""
    widths = np.diff(log[-3:])
    before, last = np.array([[-1, 1, 0], [0, -1, 1]]) * (_FACTOR / widths)[:, None]  # coefficients of both steps
    share = (bound / (1 + bound)) ** (widths.mean() / _FACTOR)
    excess = np.copysign(1, last @ x[-3:]) * last - share * np.copysign(1, before @ x[-3:]) * before
    return bool(excess @ x[-3:] > _SIGNIFICANT * math.sqrt(excess**2 @ s[-3:] ** 2))
