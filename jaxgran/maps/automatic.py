"""What "auto" stands for: the grains that each point needs for an error, and a time step."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from itertools import product
from typing import Any

import numpy as np

from jaxgran.maps.settings import OPTIONS, MapSettings
from jaxgran.maps.settings_checks import (
    FEWEST_STEPS,
    are_numbers,
    point_text,
    stack_of_any_size,
    temperature_of,
)
from jaxgran.model.checks import InputError, refused, two_digits
from jaxgran.model.choices import MAX_GRAINS, MAX_REPLICAS
from jaxgran.sampling.budget import SHARES, fewest_grains, size_error
from jaxgran.sampling.timestep import automatic_timestep

_AUTOMATIC_ERROR = 0.02  # of the stresses from an automatic time step, where no error is given
_SAFE: dict[str, Any] = {"grains": 256, "timestep": 1e-6}  # all flows accept these for "auto"


def chosen_settings(parameters: Mapping[str, Any]) -> tuple[MapSettings, str]:
    """The settings of a map with numbers for "auto", and a sentence about these numbers, or "".

    With an ``error``, the grains are chosen for each point, and the time step for its share of it.

    Args:
      parameters: arguments of ``MapSettings``, also "auto", and lists, arrays or single numbers
        where it has tuples. What is no field of it is ignored.

    Raises:
      InputError: (a ValueError) a parameter is out of its range, or the error needs too many
        grains.
    """
    plain = _plain_settings(parameters)
    if plain.get("strain") is not None and plain.get("error") is not None:
        raise InputError("`strain` and `error` exclude each other.", field="strain")
    automatic = {
        name for name in _SAFE if isinstance(plain.get(name), str) and plain[name] == "auto"
    }
    if not automatic:
        return MapSettings(**plain), ""
    safe = {name: _SAFE[name] for name in automatic}
    checked = MapSettings(**{**plain, **safe, "strain": None})
    in_order = ("restitution", "packing_fraction", "grains_by_point")
    chosen = plain | {name: getattr(checked, name) for name in in_order}
    notes = []
    if "grains" in automatic:
        if checked.error is None:
            raise InputError("`grains='auto'` requires `error`.", field="grains", value="auto")
        by_point = _grains_for(checked, checked.error)
        chosen |= {"grains": max(by_point), "grains_by_point": by_point}
        sizes = " to ".join(str(size) for size in sorted({min(by_point), max(by_point)}))
        notes.append(f"{sizes} grains, {checked.seeds} seed{'s' if checked.seeds > 1 else ''}")
    target = _AUTOMATIC_ERROR if checked.error is None else SHARES["timestep"] * checked.error
    if "timestep" in automatic:
        chosen["timestep"], point = _timestep_for(checked, target, plain.get("strain"))
        notes.append(f"timestep {chosen['timestep']:g} / shear rate, which {point} needs")
    aim = f"{target:g} from the time step" if checked.error is None else f"{checked.error:g}"
    sentence = f"{'; '.join(notes)}: for a relative error of {aim} in the stresses."
    return MapSettings(**chosen), sentence


def _grains_for(settings: MapSettings, error: float) -> tuple[int, ...]:
    """The number of grains that each point needs for its share of an error."""
    points = list(product(settings.packing_fraction, settings.restitution))
    grains = [fewest_grains(alpha, nu, SHARES["size"] * error) for nu, alpha in points]
    if max(grains) > MAX_GRAINS:
        surely = MAX_GRAINS / 2**0.5  # numbers of grains are chosen in steps of √2
        least = max(float(size_error(alpha, nu, surely)) for nu, alpha in points) / SHARES["size"]
        reason = (
            f"must be at least {two_digits(least, up=True)} at these points, to need at most "
            f"{MAX_GRAINS} grains"
        )
        raise refused("error", error, reason)
    return tuple(grains) * len(settings.timesteps)


def _timestep_for(settings: MapSettings, error: float, strain: Any) -> tuple[float, str]:
    """The time step of an error, and the point that needs it: one for all points, so that their
    force ratios compare.
    """
    flows = stack_of_any_size(settings.flows())
    temperature = temperature_of(settings, flows)
    longest = automatic_timestep(temperature, flows.packing_fraction, flows.activation, error)
    steps = (
        np.minimum(longest, strain / FEWEST_STEPS) if isinstance(strain, int | float) else longest
    )
    shortest = int(np.argmin(steps))
    return float(two_digits(steps[shortest], up=False)), point_text(flows, shortest)


def _plain_settings(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that are fields of ``MapSettings``, with tuples for lists, and a plane of one
    point for two numbers.
    """
    names = [row.name for row in fields(MapSettings) if row.name in parameters]
    plain = {name: _plain(parameters[name], OPTIONS[name].kind) for name in names}
    for name in ("restitution", "packing_fraction"):
        if name in plain and are_numbers((plain[name],)):
            plain[name] = (plain[name],)
    by_point = plain.get("grains_by_point")
    if isinstance(by_point, tuple) and by_point and all(isinstance(x, int) for x in by_point):
        plain["grains"] = max(by_point)
    return plain


def _plain(value: Any, kind: Any) -> Any:
    """A number as a Python number, a list or array of numbers as a tuple; ``MapSettings`` checks
    all other values.

    Whole numbers of a list become floats unless ``kind`` is int.
    """
    try:
        if isinstance(value, np.ma.MaskedArray) or (
            isinstance(value, Sequence) and len(value) > MAX_REPLICAS
        ):
            return value
        array = np.asarray(value)
    except (TypeError, ValueError):  # a random key, or lists of different lengths
        return value
    real = array.ndim and array.dtype.kind in "iu" and kind is not int
    plain = array.astype(float).tolist() if real else array.tolist()
    return tuple(plain) if isinstance(plain, list) else plain
