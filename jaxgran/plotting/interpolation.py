"""Fields between the points of a map: bilinear interpolation, and its error as the map itself shows
it.

A linear interpolation over an interval h is wrong by |f″| h² t (1 − t)/2 at a share t of it. The
second derivative follows from how well a point that is left out is interpolated from its two
neighbours along an axis. The errors of both axes are added. Noise of the points is part of what is
measured so.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr

_SUBDIVISIONS = 12  # steps of the bilinear interpolation between neighbouring grid points
_FEWEST = 4  # errors of points left out of which a caption gives quantiles


def refined_axes(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 − α and ν at the points of an interpolated field."""
    x, y = (_refinement(len(axis)) @ axis for axis in _axes(data))
    return x, y


def interpolated(field: np.ndarray) -> np.ma.MaskedArray:
    """Return a field interpolated bilinearly to a finer grid, masked where a missing point would
    contribute.
    """
    rows, columns = (_refinement(count) for count in field.shape)
    missing = ~np.isfinite(field)
    values = rows @ np.where(missing, 0.0, field) @ columns.T
    return np.ma.masked_array(values, mask=rows @ missing @ columns.T > 0.0)


def interpolation_error(data: xr.Dataset, field: np.ndarray) -> np.ndarray:
    """Return the estimated error of the interpolated field of a map at its points; zero at the
    points of the map.

    Along an axis of two points, and beside missing ones, no error can be estimated, and none is
    added.
    """
    x, y = _axes(data)
    rows, columns = (_refinement(count) for count in field.shape)
    return _error_along(y, field) @ columns.T + rows @ _error_along(x, field.T).T


def left_out_note(
    data: xr.Dataset, fields: Iterable[np.ndarray], of: str, counted: np.ndarray | bool = True
) -> str:
    """Return a line about the errors of points that are left out and interpolated.

    The fields are logarithms or shares of what is named by `of`. Only points that are counted are
    left out.
    """
    x, y = _axes(data)
    errors = []
    for field in fields:
        chosen = np.broadcast_to(counted, field.shape)
        errors += [_left_out(y, field)[chosen[1:-1]], _left_out(x, field.T)[chosen.T[1:-1]]]
    known = np.abs(np.concatenate(errors))
    known = known[np.isfinite(known)]
    if len(known) < _FEWEST:
        return "Linear interpolation between points, too few to estimate its error"
    median, large = (
        f"{float(f'{100 * value:.2g}'):g} %" for value in np.quantile(known, (0.5, 0.9))
    )
    return f"Leave-one-out interpolation error of {of}: median {median}, 90th percentile {large}"


def _axes(data: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    return 1.0 - data.restitution.values, data.packing_fraction.values


def _refinement(count: int) -> np.ndarray:
    """Return the matrix (fine, count) of linear interpolation onto a subdivided axis."""
    position = np.linspace(0.0, count - 1.0, (count - 1) * _SUBDIVISIONS + 1)
    return np.maximum(0.0, 1.0 - np.abs(position[:, None] - np.arange(count)))


def _left_out(axis: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return the error (count − 2, others) of each inner point of the first axis, interpolated from
    its neighbours.
    """
    share = ((axis[1:-1] - axis[:-2]) / (axis[2:] - axis[:-2]))[:, None]
    return (1.0 - share) * field[:-2] + share * field[2:] - field[1:-1]


def _error_along(axis: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return the error (fine, others) of linear interpolation along the first axis."""
    steps = np.diff(axis)
    if len(steps) < 2:
        return np.zeros((_SUBDIVISIONS * len(steps) + 1, field.shape[1]))
    curvature = (
        np.abs(_left_out(axis, field)) / (steps[:-1] * steps[1:])[:, None]
    )  # half the second derivative
    curvature = np.nan_to_num(curvature)[[0, *range(len(steps) - 1), -1]]
    largest = (
        np.maximum(curvature[:-1], curvature[1:]) * steps[:, None] ** 2
    )  # of the two ends of each interval
    position = np.linspace(0.0, len(steps), _SUBDIVISIONS * len(steps) + 1)
    interval = np.minimum(position.astype(int), len(steps) - 1)
    share = (position - interval)[:, None]
    return largest[interval] * share * (1.0 - share)
