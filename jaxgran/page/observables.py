"""What a page shows of every observable: texts, numbers, round levels, contours of the excess."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import contourpy
import numpy as np
import xarray as xr
from matplotlib.ticker import MaxNLocator

from jaxgran.maps.schema import FINEST, TENSOR_AXES, path_of
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import with_error
from jaxgran.plotting.encoding import EXCESS_LEVELS
from jaxgran.plotting.plane import contour_variable, interpolated, refined_axes
from jaxgran.plotting.selection import is_plane
from jaxgran.plotting.style import ROUND_STEPS, log_locator
from jaxgran.sampling.observables import unit_text

AXES = {
    "grains": "Grains N",
    "timestep": "Time step dt (1/γ̇)",
    "packing_fraction": "Packing fraction ν",
    "restitution": "Restitution α",
}
"""The dimensions of a page, outermost first, and their labels."""

COLUMNS = ("observable", "value ± error", "theory", "samples", "large system ± 95 %")
"""Columns of the table of a point."""

LEVELS = {"few": 5, "some": 10, "many": 20}
"""Largest numbers of contour levels, by what the reader chooses."""

_LEAST_EXCESS = 0.01  # least contour level of the excess on its scale of Figure 2
_COMPANIONS = ("_stderr", "_large_system", "_large_system_ci95")
_FIRST = ("excess", "force_ratio")  # the page opens with the first
_GROUPS = ("stresses/", "theory/", "diagnostics/")


def with_excess(data: xr.Dataset) -> xr.Dataset:
    """The map with the excess, force ratio − 1, and the errors of the force ratio as its errors."""
    if "force_ratio" not in data or "excess" in data:
        return data
    excess = (data.force_ratio - 1).assign_attrs(long_name="force ratio − 1", units="1")
    errors = {
        f"excess{end}": data[f"force_ratio{end}"] - (end == "_large_system")
        for end in _COMPANIONS
        if f"force_ratio{end}" in data
    }
    return data.assign({"excess": excess, **errors})


def observables_of(data: xr.Dataset) -> Iterator[dict[str, Any]]:
    """The entries of all numbers at the points, and of the components of tensors."""
    names = [str(name) for name in data.data_vars if _is_shown(data, str(name))]
    names.sort(key=lambda name: _FIRST.index(name) if name in _FIRST else len(_FIRST))
    ends = Counter(name.rpartition("/")[2] for name in names)
    for name in names:
        group, _, end = name.rpartition("/") if name.startswith(_GROUPS) else ("", "", name)
        label = f"{end}_{group}" if group and ends[end] > 1 else end
        if TENSOR_AXES[0] not in data[name].dims:
            yield _observable(data, name, label, "", {})
            continue
        sizes = (min(data.sizes[axis], 3) for axis in TENSOR_AXES)
        for place in np.ndindex(*sizes):
            component = "_" + "".join("xyz"[k] for k in place)
            yield _observable(
                data, name, label, component, dict(zip(TENSOR_AXES, place, strict=True))
            )


def _is_shown(data: xr.Dataset, name: str) -> bool:
    """Whether a variable is a number at every point, and not part of another one."""
    variable = data[name]
    dims = set(variable.dims) - set(FINEST)
    belongs = any(name.endswith(end) and name.removesuffix(end) in data for end in _COMPANIONS)
    belongs |= name.startswith("theory/") and path_of(name.removeprefix("theory/")) in data
    apart = name in ("status", "point_grains") or name.startswith("states/")
    plane = {"packing_fraction", "restitution"}
    return (
        variable.dtype.kind in "iuf"
        and dims in (plane, plane | set(TENSOR_AXES))
        and not (belongs or apart or "flag_values" in variable.attrs)
    )


def _observable(
    data: xr.Dataset, name: str, label: str, component: str, place: dict[str, int]
) -> dict[str, Any]:
    def known(path: str) -> np.ndarray | None:
        return column(data[path].isel(place), data) if path in data else None

    attrs = data[name].attrs
    value = column(data[name].isel(place), data)
    error = known(f"{name}_stderr")
    theory = known(f"theory/{label}") if path_of(label) == name else None
    large, half = known(f"{name}_large_system"), known(f"{name}_large_system_ci95")
    words = text_line(label + component).replace("_", " ")
    unit = unit_text(text_line(attrs.get("reduced_unit", attrs.get("units", ""))))
    title = f"{words} ({unit})" if unit else words
    lines = {"error": error, "theory": theory}
    views = [_view(data, title, value, lines, name == "excess")]
    if theory is not None:  # which is that of a large system
        if large is None or half is None:
            measured, stderr = value, error
        else:
            measured, stderr = large, half / HALF_INTERVAL
        compared = {"error": stderr, "theory": theory}
        with np.errstate(divide="ignore", invalid="ignore"):
            quotients = {part: x if x is None else x / theory for part, x in compared.items()}
            quotient = measured / theory
        views.append(_view(data, f"{words} / kinetic theory", quotient, quotients, False))
    texts = [
        _texts(value, error),
        _texts(theory, digits=4),
        _texts(_effective_samples(data, label), digits=3),
        _texts(large, half),
    ]
    meaning = text_line(attrs.get("long_name", label.replace("_", " "))) + component.replace(
        "_", ", "
    )
    return {"label": title, "meaning": meaning, "texts": texts, "views": views}


def _effective_samples(data: xr.Dataset, observable: str) -> np.ndarray | None:
    """The number of independent samples of an observable at each point, if known."""
    strain, correlated = data.get("sums/strain"), data.get("diagnostics/correlation_strain")
    if strain is None or correlated is None or observable not in data.get("observable", ()):
        return None
    return column(strain.sum("seed") / correlated.sel(observable=observable), data)


def _view(
    data: xr.Dataset,
    label: str,
    values: np.ndarray,
    lines: dict[str, np.ndarray | None],
    is_excess: bool,
) -> dict[str, Any]:
    """What is drawn of an observable: numbers, and scales of the plane, linear and logarithmic."""
    with np.errstate(divide="ignore", invalid="ignore"):
        heights = contour_variable(values) if is_excess else np.log10(values)
    parts = values.reshape(data.sizes["grains"] * data.sizes["timestep"], -1)
    scales = []
    for z, log in ((values, False), (heights, True)):
        levels = [[_levels(x, most, log, is_excess) for most in LEVELS.values()] for x in parts]
        scales.append({"z": numbers(z), "levels": levels})
    known = {name: numbers(line) for name, line in lines.items() if line is not None}
    return {"label": label, "scales": scales, **known}


def _levels(values: np.ndarray, most: int, log: bool, is_excess: bool) -> list[tuple[float, str]]:
    """Round levels between the smallest and the largest value, by place on the scale and text."""
    usable = values[np.isfinite(values) & (values > (0 if log else -np.inf))]
    high, low = usable.max(initial=-np.inf), usable.min(initial=np.inf)
    if is_excess and log:
        low = max(low, _LEAST_EXCESS)
    if not low < high:
        return []
    noise = 0 if log else 0.02 * (high - low)  # scatter around a constant gets no level
    locator = log_locator(low, high, most) if log else MaxNLocator(most, steps=ROUND_STEPS)
    ticks = np.array([x for x in locator.tick_values(low, high) if low + noise <= x <= high])
    places = ticks if not log else contour_variable(ticks) if is_excess else np.log10(ticks)
    return [(_rounded(place), plain(_rounded(x))) for place, x in zip(places, ticks, strict=True)]


def excess_lines(data: xr.Dataset) -> list[list[dict[str, Any]]]:
    """The contours of Figure 2, of each number of grains and time step: level, points with None
    between lines, and the place of the label where they meet the right edge.
    """
    if "excess" not in data or not is_plane(data):
        return []
    x, y = refined_axes(data)
    shape = (-1, data.sizes["packing_fraction"], data.sizes["restitution"])
    contours_of_fields = []
    for field in contour_variable(column(data["excess"], data)).reshape(shape):
        generator = contourpy.contour_generator(x, y, interpolated(field))
        contours = []
        for level in EXCESS_LEVELS:
            lines: Any = generator.lines(float(contour_variable(np.array(level))))
            gap = np.full((1, 2), np.nan)
            points = np.concatenate([part for line in lines for part in (line, gap)] or [gap])
            edge = points[np.isclose(points[:, 0], x.max()), 1]
            places = {"x": numbers(points[:, 0]), "y": numbers(points[:, 1])}
            contours.append({"text": f"{level:.2f}", **places, "edge": edge[:1].tolist()})
        contours_of_fields.append(contours)
    return contours_of_fields


def text_line(value: Any) -> str:
    """An attribute or a name as a short line."""
    return " ".join(str(value).split())[:200]


def plain(value: float) -> str:
    """A number as it is written by hand: 0.76, 1e-5."""
    if 0 < abs(value) < 1e-3:
        return np.format_float_scientific(value, trim="-", exp_digits=1)
    return f"{value:.12g}" if np.isfinite(value) else "–"


def _texts(
    values: np.ndarray | None, errors: np.ndarray | None = None, digits: int = 6
) -> list[str] | None:
    """Values with errors as the command line prints them."""
    if values is None:
        return None
    if errors is None:
        return [f"{x:.{digits}g}" if np.isfinite(x) else "–" for x in values]
    pairs = zip(values.tolist(), errors.tolist(), strict=True)
    return [with_error(*pair) if np.isfinite(pair[0]) else "–" for pair in pairs]


def _rounded(value: float) -> float:
    return float(f"{value:.7g}")


def numbers(values: np.ndarray) -> list[float | None]:
    """Numbers to a few digits, or None where they are not finite."""
    return [_rounded(x) if np.isfinite(x) else None for x in values.tolist()]


def column(variable: xr.DataArray, data: xr.Dataset) -> np.ndarray:
    """The values of a variable by point, or the total of an interval; one without numbers of grains
    is repeated.
    """
    if "error_source" in variable.dims:
        variable = variable.sel(error_source="total")
    missing = {name: data[name] for name in AXES if name not in variable.dims}
    return variable.expand_dims(missing).transpose(*AXES).values.astype(float).ravel()
