"""Rheology of dense flow: friction and packing fraction as power laws of the inertial number I, fitted to a map.

For frictionless grains μ(I) = μ₀ + a I^b and ν(I) = ν_c − k I^c. The macroscopic friction μ₀ at the onset of flow is
finite because of the anisotropy of the contacts.

Source: GDR MiDi, Eur. Phys. J. E 14, 341 (2004); for frictionless grains P.-E. Peyneau and J.-N. Roux, Phys. Rev. E 78,
011307 (2008), who find μ₀ ≈ 0.10 and exponents near 0.4 for spheres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy  # loads its submodules on first use; scipy.optimize takes longer than a figure
import xarray as xr

from jaxgran.maps.schema import MapData, finest, require_map
from jaxgran.model.checks import InputError, require_number
from jaxgran.model.status import Status

LARGEST_INERTIAL_NUMBER = 0.3  # of a dense flow
SMALLEST_PACKING_FRACTION = 0.7  # of a dense flow
FEWEST_POINTS = 4  # for the three parameters of a law
FEWEST_PACKING_FRACTIONS = 3  # among the points
NEEDED = ("inertial_number", "inertial_number_stderr", "macroscopic_friction", "macroscopic_friction_stderr")
"""Variables of a map that a friction law needs."""
CORRELATION = "diagnostics/friction_error_correlation"
"""Variable of the correlation of the errors of friction and inertial number."""

_EXPONENTS = (0.05, 4.0)  # bounds of a fit; an exponent at a bound is not determined
_MAX_ROUNDS = 30  # of the effective variance


@dataclass(frozen=True)
class PowerLaw:
    """A fitted law y = offset + coefficient · I^exponent.

    ============  ======  =============================================================
    field         shape   meaning; all are dimensionless
    ============  ======  =============================================================
    parameters    (3,)    offset, coefficient, exponent
    covariance    (3, 3)  of the parameters, times the reduced χ² where that is above
                          one; infinite where the points do not determine the exponent
    chi_squared   ()      reduced: χ² per degree of freedom
    points        ()      number of points
    span          (2,)    smallest and largest inertial number
    ============  ======  =============================================================
    """

    parameters: np.ndarray
    covariance: np.ndarray
    chi_squared: float
    points: int
    span: tuple[float, float]

    @property
    def standard_errors(self) -> np.ndarray:
        """Standard errors of the parameters, (3,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def determined(self) -> bool:
        """Whether the exponent exceeds its standard error; if not, the parameters are meaningless."""
        return bool(self.standard_errors[2] < self.parameters[2])

    def __call__(self, inertial_number: np.ndarray) -> np.ndarray:
        return _power(inertial_number, *self.parameters)


@dataclass(frozen=True)
class FrictionLaw:
    """μ(I) = μ₀ + a I^b and ν(I) = ν_c − k I^c, fitted to all dense points and to those of each restitution.

    ================  ========  ==================================================
    field             type      meaning
    ================  ========  ==================================================
    friction          PowerLaw  μ(I)
    packing_fraction  PowerLaw  ν(I), with the coefficient −k
    by_restitution    mapping   α → FrictionLaw, of each α with enough points
    ================  ========  ==================================================
    """

    friction: PowerLaw
    packing_fraction: PowerLaw
    by_restitution: Mapping[float, FrictionLaw] = field(default_factory=dict)


def friction_law(
    data: MapData,
    largest_inertial_number: float = LARGEST_INERTIAL_NUMBER,
    smallest_packing_fraction: float = SMALLEST_PACKING_FRACTION,
) -> FrictionLaw:
    """Fit friction and packing fraction as power laws of the inertial number to the dense points of a map.

    The fit is by least squares with the effective variance: the variance of a point is that of y plus that of I times
    the squared slope of the law, less twice the slope times their covariance. It is found by iteration. A map without
    `diagnostics/friction_error_correlation` is fitted as if the errors of μ and I were independent.

    Args:
      data: a map with `macroscopic_friction` and `inertial_number`, with `_stderr`, and `status`. The largest of
        several numbers of grains and the shortest of several time steps are fitted.
      largest_inertial_number: of a dense point.
      smallest_packing_fraction: of a dense point; it excludes nearly elastic flows, whose small I is due to heat.

    Raises:
      InputError: (a ValueError) fewer than four dense points with status ok, or at fewer than three packing fractions.
    """
    require_map(data, *NEEDED)
    for name, limit in (
        ("largest_inertial_number", largest_inertial_number),
        ("smallest_packing_fraction", smallest_packing_fraction),
    ):
        require_number(name, limit, lambda x: ~np.isnan(x), "a number")
    points = dense_points(data, largest_inertial_number, smallest_packing_fraction)
    if not enough(points):
        raise InputError(
            f"a friction law needs at least {FEWEST_POINTS} points of status ok at {FEWEST_PACKING_FRACTIONS} packing "
            f"fractions, with I <= {largest_inertial_number:g} and packing fraction >= {smallest_packing_fraction:g}, "
            f"and this map has {points.sizes['point']} at {len(np.unique(points.packing_fraction))}."
        )
    alphas = points.restitution.values
    parts = {float(alpha): points.isel(point=alphas == alpha) for alpha in np.unique(alphas)}
    laws = {alpha: FrictionLaw(*_fits(part)) for alpha, part in parts.items() if enough(part)}
    return FrictionLaw(*_fits(points), laws)


def is_dense(
    data: xr.Dataset,
    largest_inertial_number: float = LARGEST_INERTIAL_NUMBER,
    smallest_packing_fraction: float = SMALLEST_PACKING_FRACTION,
) -> xr.DataArray:
    """Whether a point of a map is one that :func:`friction_law` fits: dense, of status ok, and with errors."""
    known = np.isfinite(data.macroscopic_friction)
    known &= (data.inertial_number_stderr > 0) & (data.macroscopic_friction_stderr > 0)
    dense = (data.inertial_number <= largest_inertial_number) & (data.packing_fraction >= smallest_packing_fraction)
    return known & dense & (data.status == Status.ok if "status" in data else True)


def dense_points(
    data: MapData,
    largest_inertial_number: float = LARGEST_INERTIAL_NUMBER,
    smallest_packing_fraction: float = SMALLEST_PACKING_FRACTION,
) -> xr.Dataset:
    """The points that :func:`friction_law` fits, along one dimension ``point``."""
    data = finest(data)
    dense = is_dense(data, largest_inertial_number, smallest_packing_fraction)
    if CORRELATION not in data:
        data = data.assign({CORRELATION: xr.zeros_like(data.inertial_number)})
    points = data[[*NEEDED, CORRELATION]].assign(dense=dense)
    points = points.stack(point=("packing_fraction", "restitution"), create_index=False)
    return points.isel(point=points.dense.values)


def enough(points: xr.Dataset) -> bool:
    """Whether there are enough dense points for the three parameters of a law."""
    fractions = len(np.unique(points.packing_fraction))
    return points.sizes["point"] >= FEWEST_POINTS and fractions >= FEWEST_PACKING_FRACTIONS


def _fits(points: xr.Dataset) -> tuple[PowerLaw, PowerLaw]:
    """The laws of friction and of packing fraction through dense points."""
    number, number_error = points.inertial_number.values, points.inertial_number_stderr.values
    friction, friction_error = points.macroscopic_friction.values, points.macroscopic_friction_stderr.values
    fraction, exact = points.packing_fraction.values, np.zeros(points.sizes["point"])
    covariance = np.nan_to_num(points[CORRELATION].values) * number_error * friction_error
    return (
        fit_power_law(number, friction, number_error, friction_error, covariance, sign=1.0),
        fit_power_law(number, fraction, number_error, exact, exact, sign=-1.0),
    )


def fit_power_law(
    x: np.ndarray, y: np.ndarray, x_error: np.ndarray, y_error: np.ndarray, covariance_xy: np.ndarray, sign: float
) -> PowerLaw:
    """Return the law through points with errors in both coordinates; its coefficient has the given sign."""
    low, high = ([-np.inf, 0.0, _EXPONENTS[0]], [np.inf, np.inf, _EXPONENTS[1]])
    scale = x.max()  # unit of the inertial number in the fit, so that coefficient and offset are of similar size
    parameters, covariance, deviation = np.array([y[x.argmin()], max(np.ptp(y), 1e-3), 0.5]), np.eye(3), y_error

    def law(number, offset, coefficient, exponent):
        return _power(number, offset, sign * coefficient, exponent)

    def slopes(number, _, coefficient, exponent):
        power = number**exponent
        return np.stack([np.ones_like(number), sign * power, sign * coefficient * power * np.log(number)], axis=-1)

    converged = True
    for _ in range(_MAX_ROUNDS):
        previous, (_, coefficient, exponent) = parameters, parameters
        slope = sign * coefficient * exponent * (x / scale) ** (exponent - 1) / scale
        deviation = np.sqrt(np.maximum(y_error**2 + (slope * x_error) ** 2 - 2 * slope * covariance_xy, 1e-18))
        try:
            parameters, covariance = scipy.optimize.curve_fit(
                law, x / scale, y, previous, deviation, absolute_sigma=True, bounds=(low, high), jac=slopes
            )
        except RuntimeError:  # no convergence: the points do not determine the exponent
            converged = False
            break
        if np.allclose(parameters, previous, rtol=1e-6):
            break
    chi_squared = np.sum(((y - law(x / scale, *parameters)) / deviation) ** 2) / max(1, len(x) - 3)
    offset, coefficient, exponent = parameters
    determined = converged and coefficient > 0.0 and _EXPONENTS[0] * 1.01 < exponent < _EXPONENTS[1] * 0.99
    coefficient = sign * coefficient * scale**-exponent  # of the law of x, not of x / scale
    jacobian = np.diag([1.0, sign * scale**-exponent, 1.0])  # of the parameters of the law of x
    jacobian[1, 2] = -coefficient * np.log(scale)
    return PowerLaw(
        parameters=np.array([offset, coefficient, exponent]),
        covariance=max(1.0, chi_squared) * jacobian @ covariance @ jacobian.T
        if determined
        else np.diag(np.full(3, np.inf)),
        chi_squared=float(chi_squared),
        points=len(x),
        span=(float(x.min()), float(x.max())),
    )


def _power(number: np.ndarray, offset: float, coefficient: float, exponent: float) -> np.ndarray:
    return offset + coefficient * number**exponent
