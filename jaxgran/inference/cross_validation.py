"""Leave-one-out cross-validation of a closure: each point of a map is predicted by the fit to the others."""

from __future__ import annotations

import jax
import numpy as np
import xarray as xr

from jaxgran.inference.closure import NEEDED, broadcast
from jaxgran.inference.closure import prediction as closure_prediction
from jaxgran.inference.closure_fit import (
    FEWEST_POINTS,
    Points,
    closure_points,
    fit_points,
    require_enough,
    table,
)
from jaxgran.inference.stress_inversion import estimate_restitution
from jaxgran.maps.schema import MapData, finest, require_map
from jaxgran.sampling.timestep import JAMMING


def leave_one_out(data: MapData) -> xr.Dataset:
    """Predict every point of a map by the closure fitted to all others.

    Args:
      data: as for :func:`fit_closure`, and `shear_stress` with `_stderr`.

    Returns:
      A dataset of the variables below, by packing fraction and restitution; NaN where a point is not fitted.

    Raises:
      InputError: (a ValueError) fewer than 13 points, or than 3 values of α or of ν when one point is left out.

    ==================  =============================================================================================
    variable            meaning; NAME is pressure, shear_stress or force_ratio
    ==================  =============================================================================================
    NAME_predicted      prediction, in units of m = σ = γ̇ = 1
    NAME_error          predicted over measured, minus one
    NAME_noise          relative standard error of the measured point
    NAME_stderr         relative standard error expected of prediction and point together
    restitution_found   restitution from the stresses of the point, by the closure fitted without it
    restitution_stderr  its standard error
    edge                whether α or ν is the smallest or largest of the fitted points
    ==================  =============================================================================================
    """
    require_map(data, *NEEDED, "shear_stress", "shear_stress_stderr")
    points = closure_points(data, FEWEST_POINTS + 1)
    indices, closures = np.arange(len(points.place)), []
    for k in indices:
        others = points.chosen(indices != k)
        require_enough(others.restitution, others.packing_fraction, FEWEST_POINTS)
        closures.append(fit_points(others, JAMMING))
    batch = jax.tree.map(lambda *x: np.stack(x), *closures)
    alpha, nu = broadcast(restitution=points.restitution, packing_fraction=points.packing_fraction)
    predicted = _batch_predictions(batch, alpha, nu)

    measured = {name: table(finest(data), [name, f"{name}_stderr"])[points.place] for name in _PREDICTED}
    columns = {}
    for name, value_and_error in measured.items():
        value, error = value_and_error.T
        prediction, prediction_error = (
            np.asarray(getattr(predicted, f"{name}{end}"), float) for end in ("", "_stderr")
        )
        columns[f"{name}_predicted"] = prediction
        columns[f"{name}_error"] = prediction / value - 1
        columns[f"{name}_noise"] = error / value
        columns[f"{name}_stderr"] = np.hypot(error, prediction_error) / value

    (pressure, pressure_error), (shear, shear_error) = measured["pressure"].T, measured["shear_stress"].T
    correlation = _correlation(pressure_error / pressure, shear_error / shear, points.errors[:, 1])
    numbers = broadcast(
        pressure=pressure,
        shear_stress=shear,
        pressure_stderr=pressure_error,
        shear_stress_stderr=shear_error,
        correlation=correlation,
    )
    found = _batch_estimates(batch, nu, *numbers)
    columns["restitution_found"] = np.asarray(found.restitution, float)
    columns["restitution_stderr"] = np.asarray(found.stderr, float)
    return _as_map(data, points, columns)


_PREDICTED = ("pressure", "shear_stress", "force_ratio")
_batch_predictions = jax.jit(jax.vmap(closure_prediction))  # one closure for each point
_batch_estimates = jax.jit(jax.vmap(estimate_restitution))


def _correlation(pressure: np.ndarray, shear: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Correlation of the errors of ln P and ln τ, from these errors and that of their difference, the friction."""
    product = np.maximum(pressure * shear, np.finfo(float).tiny)
    return np.clip((pressure**2 + shear**2 - friction**2) / (2 * product), -1.0, 1.0)


def _as_map(data: MapData, points: Points, columns: dict[str, np.ndarray]) -> xr.Dataset:
    """Values at the fitted points as variables of the map, NaN elsewhere."""
    dims = ("packing_fraction", "restitution")
    shape = tuple(data.sizes[name] for name in dims)
    variables = {}
    for name, column in columns.items():
        full = np.full(shape, np.nan)
        full.ravel()[points.place] = column
        variables[name] = (dims, full)
    result = xr.Dataset(variables, {name: data[name].values for name in dims})
    fitted = points.packing_fraction, points.restitution
    ends = [result[name].isin([x.min(), x.max()]) for name, x in zip(dims, fitted, strict=True)]
    return result.assign(edge=(ends[0] | ends[1]).transpose(*dims))
