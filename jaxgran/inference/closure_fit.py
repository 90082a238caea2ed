"""Fit of a closure to a map: linear least squares for the stresses, L-BFGS for the force ratio."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
import xarray as xr
from jaxtyping import Array
from scipy.optimize import brentq

from jaxgran.inference.closure import LAWS, NEEDED, Closure, Law, excess_terms, require_jamming, stress_terms
from jaxgran.maps.schema import MapData, finest, require_map, require_one_timestep
from jaxgran.model.checks import InputError
from jaxgran.model.choices import MAX_PACKING_FRACTION
from jaxgran.model.status import Status
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.sampling.timestep import JAMMING

FEWEST_POINTS = 12  # of a map
FEWEST_VALUES = 3  # of restitution, and of packing fraction, among the points
_LEAST_ERROR = 1e-4  # relative: blocks without clusters may agree by chance, and their error is then too small
_MAX_ROUNDS = 50  # of fit and scatter
_SCATTER_TOLERANCE = 1e-5  # the rounds end when the scatter changes by less
_MAX_ITERATIONS = 200  # of L-BFGS
_GRADIENT_TOLERANCE = 1e-4  # of L-BFGS, for coefficients in units of their standard errors


def fit_closure(data: MapData, jamming_fraction: float = JAMMING) -> Closure:
    """Fit the closure to a ratio map.

    Weights combine the standard errors of the points with a scatter about each law, such that χ² equals the number
    of degrees of freedom, or zero if χ² is smaller without it.

    Args:
      data: a map with `pressure`, `macroscopic_friction` and `force_ratio`, with `_stderr`, and `status`. Points with
        status ok and α < 1 are fitted, at the largest of several numbers of grains and the shortest time step.
      jamming_fraction: ν_J, above 0.83; by default that of a random quench of the size distribution of maps.

    Raises:
      InputError: (a ValueError) fewer than 12 points, or than 3 values of α or of ν, or time steps chosen by point.

    Source: scatter by R. C. Paule and J. Mandel, J. Res. Natl. Bur. Stand. 87, 377 (1982).
    """
    require_map(data, *NEEDED)
    require_one_timestep(data, "a closure")
    require_jamming(jamming_fraction)
    return fit_points(closure_points(data), jamming_fraction)


class Points(NamedTuple):
    """Points of a map to which a closure is fitted."""

    place: np.ndarray  # (points,), index in the flattened map, ν before α
    restitution: np.ndarray  # (points,)
    packing_fraction: np.ndarray  # (points,)
    logs: np.ndarray  # (points, 3), logarithms of the quantities in ``LAWS``
    errors: np.ndarray  # (points, 3), their standard errors
    theory: np.ndarray  # (points, 2), logarithms of the pressure and the friction of theory
    timestep: float  # dt in 1/γ̇, NaN if unknown

    def chosen(self, which: np.ndarray) -> Points:
        """The points that a mask or an index array selects."""
        return self._replace(**{name: getattr(self, name)[which] for name in self._fields if name != "timestep"})


def closure_points(data: MapData, fewest: int = FEWEST_POINTS) -> Points:
    """The points that :func:`fit_closure` fits: of status ok, positive, with known errors, and with α < 1."""
    data = finest(data)
    alpha, nu = (data[name].astype(float).values for name in ("restitution", "packing_fraction"))
    nu, alpha = (x.ravel() for x in np.meshgrid(nu, alpha, indexing="ij"))
    values, errors = (table(data, [f"{name}{end}" for name in LAWS]) for end in ("", "_stderr"))
    known = np.isfinite(errors).all(axis=1) & (values > 0).all(axis=1) & np.isfinite(values).all(axis=1)
    known &= (alpha < 1) & (nu > 0) & (nu <= MAX_PACKING_FRACTION)
    if "status" in data:
        known &= table(data, ["status"])[:, 0] == Status.ok
    nu, alpha, values, errors = (x[known] for x in (nu, alpha, values, errors))
    require_enough(alpha, nu, fewest)
    theory = kinetic_theory(alpha, nu)
    pressure, shear_stress = (np.asarray(x, float) for x in (theory.pressure, theory.shear_stress))
    return Points(
        place=np.flatnonzero(known),
        restitution=alpha,
        packing_fraction=nu,
        logs=np.log(values),
        errors=np.maximum(errors / values, _LEAST_ERROR),
        theory=np.log(np.stack([pressure, shear_stress / pressure], axis=1)),
        timestep=float(data.attrs.get("timestep", np.nan)),
    )


def fit_points(points: Points, jamming_fraction: float) -> Closure:
    """Fit the three laws to points of a map."""
    alpha, nu, jamming = points.restitution, points.packing_fraction, np.asarray(jamming_fraction, float)
    stress, excess = (np.asarray(f(alpha, nu, jamming), float) for f in (stress_terms, excess_terms))
    laws = [
        _fit(stress, points.logs[:, k] - points.theory[:, k], points.errors[:, k], _linear_coefficients)
        for k in range(2)
    ]
    return Closure(
        *laws,
        force_ratio=_fit(excess, points.logs[:, 2], points.errors[:, 2], _excess_coefficients),
        restitution_range=np.array([alpha.min(), alpha.max()]),
        packing_fraction_range=np.array([nu.min(), nu.max()]),
        jamming_fraction=jamming,
        timestep=np.asarray(points.timestep),
    )


class _Solution(NamedTuple):
    """Coefficients (terms,), prediction (points,) and its Jacobian (points, terms)."""

    coefficients: np.ndarray
    predicted: np.ndarray
    gradient: np.ndarray


def _fit(terms: np.ndarray, logs: np.ndarray, errors: np.ndarray, solve: Callable[..., _Solution]) -> Law:
    """Fit with the scatter at which χ² equals the degrees of freedom, or none if χ² is below them."""
    freedom, scatter, previous, rounds = len(logs) - terms.shape[1], 0.0, np.inf, 0
    solution = solve(terms, logs, errors)
    while abs(scatter - previous) >= _SCATTER_TOLERANCE and rounds < _MAX_ROUNDS:
        previous, scatter = scatter, _scatter(logs - solution.predicted, errors, freedom)
        solution, rounds = solve(terms, logs, np.hypot(errors, scatter)), rounds + 1
    triangle = np.linalg.qr(solution.gradient / np.hypot(errors, scatter)[:, None], mode="r")
    return Law(solution.coefficients, np.linalg.inv(triangle), np.asarray(scatter))


def _scatter(residuals: np.ndarray, errors: np.ndarray, freedom: int) -> float:
    """The scatter at which χ² equals the number of degrees of freedom, or zero if χ² is below it."""

    def excess(scatter: float) -> float:
        return float(np.sum(residuals**2 / (errors**2 + scatter**2)) - freedom)

    largest = float(np.sqrt(np.sum(residuals**2) / freedom))
    return cast(float, brentq(excess, 0.0, largest)) if excess(0.0) > 0 else 0.0


def _linear_coefficients(terms: np.ndarray, logs: np.ndarray, errors: np.ndarray) -> _Solution:
    """Linear least squares of terms · coefficients."""
    coefficients = np.linalg.lstsq(terms / errors[:, None], logs / errors)[0]
    return _Solution(coefficients, terms @ coefficients, terms)


def _excess_coefficients(terms: np.ndarray, logs: np.ndarray, errors: np.ndarray) -> _Solution:
    """Least squares of ln F = ln(1 + exp(terms · c)), starting from the linear fit of ln(F − 1).

    The iteration is over c in units of its standard errors, in which the contours of χ² are nearly spherical.
    """
    excess = np.maximum(np.expm1(logs), errors)
    start = _linear_coefficients(terms, np.log(excess), errors * (1 + excess) / excess).coefficients
    triangle = np.linalg.qr(_slope(terms @ start)[:, None] * terms / errors[:, None], mode="r")
    units = np.linalg.inv(triangle)
    numbers = [jnp.asarray(x, float) for x in (terms @ start, terms @ units, logs, errors)]
    with jax.numpy_dtype_promotion("standard"):  # optax relies on it
        change = _least_squares(*numbers)
    coefficients = start + units @ np.asarray(change, float)
    log_excess = terms @ coefficients
    return _Solution(coefficients, np.logaddexp(0, log_excess), _slope(log_excess)[:, None] * terms)


def _slope(log_excess: np.ndarray) -> np.ndarray:
    """d ln F/d ln(F − 1) = (F − 1)/F."""
    return np.exp(log_excess - np.logaddexp(0, log_excess))


@jax.jit
def _least_squares(start: Array, terms: Array, logs: Array, errors: Array) -> Array:
    """Change of the coefficients, (terms,), that minimises the squares of ln F, by L-BFGS."""

    def cost(change):
        return jnp.sum(((jax.nn.softplus(start + terms @ change) - logs) / errors) ** 2) / 2

    solver = optax.lbfgs()

    def unfinished(carry: Any):
        _, _, gradient, iteration = carry
        return (jnp.linalg.norm(gradient) > _GRADIENT_TOLERANCE) & (iteration < _MAX_ITERATIONS)

    def iterate(carry: Any) -> Any:
        change, state, _, iteration = carry
        value, gradient = optax.value_and_grad_from_state(cost)(change, state=state)
        update, state = solver.update(gradient, state, change, value=value, grad=gradient, value_fn=cost)
        return optax.apply_updates(change, update), state, gradient, iteration + 1

    change = jnp.zeros(terms.shape[1], terms.dtype)
    return jax.lax.while_loop(unfinished, iterate, (change, solver.init(change), change + jnp.inf, 0))[0]


def table(data: xr.Dataset, names: list[str]) -> np.ndarray:
    """Variables as columns, (points, names), ν before α."""
    return np.stack([data[n].transpose("packing_fraction", "restitution").values.ravel() for n in names], axis=1)


def require_enough(restitution: np.ndarray, packing_fraction: np.ndarray, fewest: int) -> None:
    alphas, nus = (len(np.unique(x)) for x in (restitution, packing_fraction))
    if len(restitution) < fewest or min(alphas, nus) < FEWEST_VALUES:
        raise InputError(
            f"a closure needs at least {fewest} points of status ok, at {FEWEST_VALUES} restitutions below 1 and "
            f"{FEWEST_VALUES} packing fractions, and there are {len(restitution)} at {alphas} and {nus}."
        )
