"""What a page shows of every observable: values, errors and theory at the points, and texts."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from jaxgran.maps.replica import AXES
from jaxgran.maps.schema import TENSOR_AXES, path_of
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import with_error
from jaxgran.sampling.observables import unit_text

COLUMNS = ("observable", "value ± error", "theory", "samples", "large system ± 95 %")
"""Columns of the table of a point."""

_COMPANIONS = ("_stderr", "_large_system", "_large_system_ci95")
_GROUPS = ("stresses/", "theory/", "diagnostics/")


def observables_of(data: xr.Dataset) -> Iterator[dict[str, Any]]:
    """The entries of all numbers at the points, and of the components of tensors; the force ratio
    is the first.
    """
    names = [str(name) for name in data.data_vars if _is_shown(data, str(name))]
    ends = Counter(name.rpartition("/")[2] for name in names)
    for name in sorted(names, key=lambda name: name != "force_ratio"):
        group, _, end = name.rpartition("/") if name.startswith(_GROUPS) else ("", "", name)
        label = f"{end}_{group}" if group and ends[end] > 1 else end
        axes = [axis for axis in TENSOR_AXES if axis in data[name].dims]
        for place in np.ndindex(*(data.sizes[axis] for axis in axes)):
            component = "".join("xyz"[k] for k in place)
            chosen = dict(zip(axes, place, strict=True))
            yield _observable(data, name, f"{label}_{component}" if component else label, chosen)


def _is_shown(data: xr.Dataset, name: str) -> bool:
    """Whether a variable is a number at every point, and not part of another one."""
    variable = data[name]
    dims = set(variable.dims) | set(AXES)
    belongs = any(name.endswith(end) and name.removesuffix(end) in data for end in _COMPANIONS)
    belongs |= name.startswith("theory/") and path_of(name.removeprefix("theory/")) in data
    apart = name in ("status", "point_grains") or name.startswith("states/")
    return (
        variable.dtype.kind in "iuf"
        and dims in ({*AXES}, {*AXES, *TENSOR_AXES})
        and not (belongs or apart or "flag_values" in variable.attrs)
    )


def _observable(data: xr.Dataset, name: str, label: str, place: dict[str, int]) -> dict[str, Any]:
    def known(path: str) -> np.ndarray | None:
        return column(data[path].isel(place, missing_dims="ignore"), data) if path in data else None

    value, error = column(data[name].isel(place), data), known(f"{name}_stderr")
    theory = known(f"theory/{label}") if path_of(label) == name else None
    large, half = known(f"{name}_large_system"), known(f"{name}_large_system_ci95")
    attrs, words = data[name].attrs, text_line(label).replace("_", " ")
    unit = unit_text(text_line(attrs.get("reduced_unit", attrs.get("units", ""))))
    title = f"{words} ({unit})" if unit else words
    views = [_view(title, value, error, theory)]
    if theory is not None:  # which is that of a large system
        measured, stderr = (value, error) if half is None else (large, half / HALF_INTERVAL)
        with np.errstate(divide="ignore", invalid="ignore"):
            quotients = [x if x is None else x / theory for x in (measured, stderr, theory)]
        views.append(_view(f"{words} / kinetic theory", *quotients))
    texts = [
        _texts(value, error),
        _texts(theory, digits=4),
        _texts(_effective_samples(data, label), digits=3),
        _texts(large, half),
    ]
    meaning = text_line(attrs.get("long_name", words))
    return {"label": title, "meaning": meaning, "texts": texts, "views": views}


def _view(
    label: str, value: np.ndarray | None, error: np.ndarray | None, theory: np.ndarray | None
) -> dict[str, Any]:
    """What is drawn of an observable."""
    drawn = {"value": value, "error": error, "theory": theory}
    return {"label": label} | {name: numbers(column) for name, column in drawn.items()}


def _effective_samples(data: xr.Dataset, observable: str) -> np.ndarray | None:
    """The number of independent samples of an observable at each point, if known."""
    strain, correlated = data.get("sums/strain"), data.get("diagnostics/correlation_strain")
    if strain is None or correlated is None or observable not in data.get("observable", ()):
        return None
    return column(strain.sum("seed") / correlated.sel(observable=observable), data)


def column(variable: xr.DataArray, data: xr.Dataset) -> np.ndarray:
    """The values of a variable, or the total of an interval, by point, in order of dimensions."""
    if "error_source" in variable.dims:
        variable = variable.sel(error_source="total")
    by_point = variable.broadcast_like(data.force_ratio).transpose(*AXES)
    return by_point.values.astype(float).ravel()


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


def numbers(values: np.ndarray | None) -> list[float | None] | None:
    """Numbers to a few digits, or None where they are not finite."""
    if values is None:
        return None
    return [float(f"{x:.7g}") if np.isfinite(x) else None for x in values.tolist()]


def text_line(value: Any) -> str:
    """An attribute or a name as a short line."""
    return " ".join(str(value).split())[:200]
