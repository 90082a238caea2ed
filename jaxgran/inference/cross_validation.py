"""The errors of a closure at points that it has not seen: each is left out of the fit in turn."""

from __future__ import annotations

import jax
import numpy as np
import xarray as xr

from jaxgran.inference.closure import NEEDED, broadcast, prediction, require_jamming
from jaxgran.inference.closure_fit import (
    FEWEST_POINTS,
    Points,
    closure_points,
    finest,
    fit_points,
    require_enough,
    table,
)
from jaxgran.inference.stress_inversion import estimate_restitution
from jaxgran.maps.schema import require_map
from jaxgran.sampling.timestep import JAMMING


def leave_one_out(data: xr.Dataset, jamming_fraction: float = JAMMING) -> xr.Dataset:
    """Predict every point of a map by the closure that is fitted to all others.

    ================  ===============================  ==============================================================
    data              (packing_fraction, restitution)  as for :func:`fit_closure`, and `shear_stress` with `_stderr`
    jamming_fraction  ()                               ν_J
    returns           (packing_fraction, restitution)  of pressure, shear_stress and force_ratio: NAME_predicted;
                                                       NAME_error, predicted over measured less one; NAME_noise, the
                                                       relative standard error of the point itself; NAME_stderr, the
                                                       error expected of prediction and point together.
                                                       Of the restitution found from the point's stresses by that
                                                       closure: restitution_found, restitution_stderr. `edge`: α or
                                                       ν is the smallest or largest. NaN where a point is not fitted
    raises            InputError                       fewer than 13 points, or than 3 values of α or of ν without one
    ================  ===============================  ==============================================================
    """
    require_map(data, *NEEDED, "shear_stress", "shear_stress_stderr")
    require_jamming(jamming_fraction)
    points = closure_points(data)
    require_enough(points, FEWEST_POINTS + 1)
    every, closures = np.arange(len(points.place)), []
    for k in every:
        others = points.chosen(every != k)
        require_enough(others, FEWEST_POINTS)
        closures.append(fit_points(others, jamming_fraction))
    batch = jax.tree.map(lambda *x: np.stack(x), *closures)
    alpha, nu = broadcast(restitution=points.restitution, packing_fraction=points.packing_fraction)
    predicted = _predictions_of_each(batch, alpha, nu)

    measured = {name: table(finest(data), [name, f"{name}_stderr"])[points.place] for name in _PREDICTED}
    columns = {}
    for name, pair in measured.items():
        value, error = pair.T
        foreseen, its_error = (np.asarray(getattr(predicted, f"{name}{end}"), float) for end in ("", "_stderr"))
        columns[f"{name}_predicted"] = foreseen
        columns[f"{name}_error"] = foreseen / value - 1
        columns[f"{name}_noise"] = error / value
        columns[f"{name}_stderr"] = np.hypot(error, its_error) / value

    (pressure, first), (shear, second) = measured["pressure"].T, measured["shear_stress"].T
    correlation = _correlation(first / pressure, second / shear, points.errors[:, 1])
    numbers = broadcast(p=pressure, s=shear, first=first, second=second, correlation=correlation)
    found = _estimates_of_each(batch, nu, *numbers)
    columns["restitution_found"] = np.asarray(found.restitution, float)
    columns["restitution_stderr"] = np.asarray(found.stderr, float)
    return _as_map(data, points, columns)


_PREDICTED = ("pressure", "shear_stress", "force_ratio")
_predictions_of_each, _estimates_of_each = (
    jax.jit(jax.vmap(f)) for f in (prediction, estimate_restitution)
)  # of many closures


def _correlation(pressure: np.ndarray, shear: np.ndarray, friction: np.ndarray) -> np.ndarray:
    """Correlation of the errors of two logarithms from those of both and of their difference."""
    product = np.maximum(pressure * shear, np.finfo(float).tiny)
    return np.clip((pressure**2 + shear**2 - friction**2) / (2 * product), -1.0, 1.0)


def _as_map(data: xr.Dataset, points: Points, columns: dict[str, np.ndarray]) -> xr.Dataset:
    """Columns of points on the plane of the map, NaN elsewhere."""
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
