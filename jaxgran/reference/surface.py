"""Smooth surfaces through measured points of the plane of α and ν, with their standard errors:
Gaussian processes.

The coordinates are √(1 − α) and −ln(0.86 − ν), in which logarithms of averages over those of a
theory are smooth. A surface is the mean of a Gaussian process that is given the points with their
standard errors. Its prior is a plane plus a Matérn 5/2 function. Amplitude, lengths and a factor of
the standard errors maximise the likelihood; where the points left out scatter more than they
should, all standard errors are larger by the ratio. C. E. Rasmussen and C. K. I. Williams,
*Gaussian Processes for Machine Learning* (2006).

All functions take the module of arrays, ``numpy`` or ``jax.numpy``, as ``xp``.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

_JAMMING = 0.86  # beyond the densest flow; the onset of rigidity lies near 0.85
_SLOPE = 5.0  # prior standard deviation of the plane's three coefficients: wide
_TINY = 1e-30  # under a root, whose derivative at zero would be infinite
_NEAR = 1e-8  # squared distance below which the Matérn function is a polynomial to rounding


def coordinates(restitution: Any, packing_fraction: Any, xp: Any = np) -> Any:
    """√(1 − α) and −ln(0.86 − ν), on a last axis."""
    return xp.stack([xp.sqrt(1 - restitution), -xp.log(_JAMMING - packing_fraction)], axis=-1)


def packing_fraction(where: Any, xp: Any = np) -> Any:
    """ν at coordinates (..., 2)."""
    return _JAMMING - xp.exp(-where[..., 1])


@dataclass(frozen=True)
class Shape:
    """What is fitted of a surface: amplitude, a length along each coordinate, factors of standard
    errors.
    """

    amplitude: float
    lengths: tuple[float, float]
    noise: float = 1.0  # of the points
    leave_one_out: float = 1.0  # of the surface

    def covariance(self, where: Any, points: Any, xp: Any = np) -> Any:
        """Prior covariance of (..., 2) and (points, 2) coordinates, (..., points)."""
        first, second = ((where[..., None, k] - points[:, k]) / self.lengths[k] for k in (0, 1))
        square = 5 * (first**2 + second**2)
        near = square < _NEAR  # second derivatives of the root would multiply rounding
        r = xp.sqrt(xp.where(near, 1, square))
        far = (1 + r + r**2 / 3) * xp.exp(-r)
        matern = xp.where(near, 1 - square / 6 + square**2 / 24, far)
        return self.amplitude**2 * matern + _SLOPE**2 * (1 + where @ points.T)

    def variance(self, where: Any, xp: Any = np) -> Any:
        """Prior variance at (..., 2) coordinates."""
        return self.amplitude**2 + _SLOPE**2 * (1 + xp.sum(where**2, axis=-1))


@dataclass(frozen=True)
class Surface:
    """A surface through values (points,) with standard errors at coordinates (points, 2)."""

    points: np.ndarray
    values: np.ndarray
    stderrs: np.ndarray
    shape: Shape

    @cached_property
    def _covariance(self) -> np.ndarray:
        """Covariance of the values at the points."""
        return self.shape.covariance(self.points, self.points) + np.diag(
            (self.shape.noise * self.stderrs) ** 2
        )

    @cached_property
    def _whitening(self) -> np.ndarray:
        """The inverse of the lower Cholesky factor of the covariance: the inverse itself would lose
        small variances.
        """
        return np.linalg.inv(np.linalg.cholesky(self._covariance))

    @cached_property
    def _weights(self) -> np.ndarray:
        return np.linalg.solve(self._covariance, self.values)

    def mean(self, where: Any, xp: Any = np) -> Any:
        """Value at coordinates (..., 2)."""
        return self.shape.covariance(where, self.points, xp) @ self._weights

    def __call__(self, where: Any, xp: Any = np) -> tuple[Any, Any]:
        """Value and standard error at coordinates (..., 2)."""
        with_points = self.shape.covariance(where, self.points, xp)
        known = xp.sum((with_points @ self._whitening.T) ** 2, axis=-1)
        spread = xp.sqrt(xp.maximum(self.shape.variance(where, xp) - known, _TINY))
        return with_points @ self._weights, self.shape.leave_one_out * spread

    def left_out(self) -> tuple[np.ndarray, np.ndarray]:
        """Errors at the points where each is left out in turn, and their expected standard
        deviations.
        """
        precision = np.sum(self._whitening**2, axis=0)
        return self._weights / precision, self.shape.leave_one_out / np.sqrt(precision)

    def log_likelihood(self) -> float:
        """Logarithm of the probability density of the values, up to a constant."""
        return float(np.sum(np.log(np.diag(self._whitening))) - self.values @ self._weights / 2)
