"""The tables of this folder: measured averages of the reference map, and the theory as a Chebyshev
series.

Both are text with a head of lines ``# name: value``; ``python -m benchmarks reference`` makes them
from a map. ``averages.csv`` has a row for each point. Each average has the columns NAME,
NAME_stderr and, where there is a bound on the errors other than sampling, NAME_bound; the head has
the shape of its surface. ``theory.csv`` has a row for each term of the series of the logarithm of a
prediction, in √(1 − α) and ν scaled to −1 ... 1.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxgran.files import other_version
from jaxgran.model.checks import InputError
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.reference.surface import Shape, Surface, coordinates, packing_fraction

MEASURED = {
    "pressure": "m / t^2",
    "shear_stress": "m / t^2",
    "granular_temperature": "m (sigma / t)^2",
    "local_granular_temperature": "m (sigma / t)^2",
    "dissipation_rate": "m / t^3",
}
"""Averages of which the table has a surface over a theory, and their units."""

LENGTH = "correlation_length_from_pressure"
"""L′ of ``sampling.enskog_factors``, in σ; its surface is that of the logarithm, unbounded."""

RATIO = "force_ratio"
"""The force ratio at the time step of the map; ``force_ratio_at_DT`` is another map's, NaN where
that has no point.
"""

THEORIES = {
    "gaussian_moments": "moments of an anisotropic Gaussian",
    "garzo_dufty": "Garzó and Dufty",
}
"""What the theory of the series is called."""

THEORY = ("pressure", "shear_stress", "granular_temperature")
"""What the series predict. A theory's dissipation rate is its shear stress times the shear rate."""

CORRECTED = "corrected_"
"""What the names of the series of ``corrected_shear`` begin with."""

FOLDER = Path(__file__).parent
_FORMAT_VERSION = "1"  # of the files
# the force ratio's surface is that of asinh((ratio − 1)/0.01): linear below, logarithmic above
_EXCESS = 0.01
_BOUND_SHAPE = Shape(1.0, (1.0, 1.0))  # of the logarithm of a bound, which varies slowly
_BOUND_STDERR = 0.02
_LEAST_STDERR = 1e-3  # of a value of a surface; without clusters, that of the force ratio is 0


def theory_of(name: str) -> str:
    """The prediction that a measured average is compared with."""
    return "shear_stress" if name == "dissipation_rate" else name.removeprefix("local_")


def excess_from_surface(value: Any, xp: Any = np) -> Any:
    """Force ratio − 1 from the value of its surface."""
    return _EXCESS * xp.sinh(value)


@dataclass(frozen=True)
class Series:
    """Chebyshev series in √(1 − α) and ν of the logarithms of the predictions of a theory."""

    low: np.ndarray  # (2,) √(1 − α) and ν at −1
    high: np.ndarray  # at 1
    coefficients: dict[str, np.ndarray]  # (terms, terms) each

    def __call__(self, where: Any, xp: Any = np) -> dict[str, Any]:
        """Logarithm of every prediction at coordinates (..., 2) of ``surface``."""
        where = xp.stack([where[..., 0], packing_fraction(where, xp)], axis=-1)
        scaled = (2 * where - self.low - self.high) / (self.high - self.low)
        count = len(next(iter(self.coefficients.values())))
        terms = [xp.ones_like(scaled), scaled]
        for _ in range(2, count):
            terms.append(2 * scaled * terms[-1] - terms[-2])
        stacked = xp.stack(terms, axis=-1)
        first, second = stacked[..., 0, :], stacked[..., 1, :]
        return {
            name: xp.sum((first @ table) * second, axis=-1)
            for name, table in self.coefficients.items()
        }


@dataclass(frozen=True, eq=False)
class Table:
    """The averages of a map as surfaces, and what it was made with."""

    head: dict[str, str]
    columns: dict[str, np.ndarray]
    series: Series

    def range(self, name: str) -> tuple[float, float]:
        """Smallest and largest restitution or packing fraction."""
        return float(self.columns[name].min()), float(self.columns[name].max())

    @property
    def timestep(self) -> str:
        """Time step of the map as it is written by hand."""
        return f"{float(self.head['timestep']):.0e}".replace("e-0", "e-")

    @property
    def made_with(self) -> str:
        """Number of grains and time step of the map, for a reader."""
        return f"N = {self.head['grains']}, dt = {self.timestep}/γ̇"

    @cached_property
    def points(self) -> np.ndarray:
        return coordinates(self.columns["restitution"], self.columns["packing_fraction"])

    @cached_property
    def surfaces(self) -> dict[str, Surface]:
        """The surface of every average, of the shape in the head."""
        surfaces = {}
        for key, text in self.head.items():
            if key.startswith("surface "):
                amplitude, first, second, noise, left_out = map(float, text.split())
                name, shape = key.split()[1], Shape(amplitude, (first, second), noise, left_out)
                surfaces[name] = self.surface(name, shape)
        return surfaces

    @cached_property
    def bounds(self) -> dict[str, Surface]:
        """The surfaces of the logarithm of every bound, over its average; that of the force ratio
        is not.
        """
        bounds = {}
        for name in (*MEASURED, RATIO):
            scale = 1.0 if name == RATIO else self.columns[name]
            values = np.log(self.columns[f"{name}_bound"] / scale)
            stderrs = np.full(values.shape, _BOUND_STDERR)
            bounds[name] = Surface(self.points, values, stderrs, _BOUND_SHAPE)
        return bounds

    def log_estimate(self, name: str, where: Any, xp: Any = np) -> tuple[Any, Any]:
        """The logarithm of an average over the theory's, or of a factor or ``LENGTH``, and the
        half-width of its 95 % interval.
        """
        log, stderr = self.surfaces[name](where, xp)
        half = HALF_INTERVAL * stderr
        if name in MEASURED:
            half = xp.hypot(half, xp.exp(self.bounds[name].mean(where, xp)))
        return log, half

    def surface(self, name: str, shape: Shape) -> Surface:
        """The surface of an average, of a given shape."""
        value, stderr = self.columns[name], self.columns[f"{name}_stderr"]
        if name.startswith(RATIO):
            values = np.arcsinh((value - 1) / _EXCESS)
            stderrs = stderr / np.hypot(value - 1, _EXCESS)
        else:
            theory = np.exp(self.series(self.points)[theory_of(name)]) if name in MEASURED else 1.0
            values, stderrs = np.log(value / theory), stderr / value
        known = np.isfinite(values)
        return Surface(
            self.points[known], values[known], np.maximum(stderrs[known], _LEAST_STDERR), shape
        )


@cache
def shipped_table() -> Table:
    """The table of this package."""
    return read_table(FOLDER)


def read_table(folder: Path) -> Table:
    """The table in a folder."""
    head, columns = read_columns(folder / "averages.csv")
    theory_head, terms = read_columns(folder / "theory.csv")
    low, high = (
        np.array([float(x) for x in theory_head[name].split()]) for name in ("low", "high")
    )
    count = round(np.sqrt(len(terms["first"])))
    coefficients = {
        name: x.reshape(count, count)
        for name, x in terms.items()
        if name not in ("first", "second")
    }
    return Table(theory_head | head, columns, Series(low, high, coefficients))


def read_columns(path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Head and columns of a file; InputError if it has another format."""
    lines = path.read_text(encoding="utf-8").splitlines()
    head = dict(line[2:].split(": ", 1) for line in lines if line.startswith("# "))
    if wrong := other_version(path.name, head.get("format_version"), _FORMAT_VERSION):
        raise InputError(wrong)
    names, *rows = [line.split(",") for line in lines if not line.startswith("#")]
    return head, dict(zip(names, np.array(rows, float).T, strict=True))


def write_columns(
    path: Path, head: dict[str, Any], columns: dict[str, Any], digits: int = 6
) -> None:
    """Write a file that ``read_columns`` reads."""
    lines = [
        f"# {name}: {value}" for name, value in {"format_version": _FORMAT_VERSION, **head}.items()
    ]
    rows = [
        ",".join(f"{value:.{digits}g}" for value in row)
        for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join([*lines, ",".join(columns), *rows]) + "\n", encoding="utf-8")
