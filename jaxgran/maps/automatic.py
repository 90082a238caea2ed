"""What "auto" stands for: the grains and the time step that a map needs for an error, at the least
cost.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from jaxgran.dynamics.batch import predicted_cost
from jaxgran.maps.batches import replica_cost, replica_ids
from jaxgran.maps.progress import duration
from jaxgran.maps.replica import Point
from jaxgran.maps.settings import OPTIONS, MapSettings, rounded
from jaxgran.maps.settings_checks import FEWEST_STEPS, point_text, stack_of_any_size, temperature_of
from jaxgran.model.checks import InputError, refused, two_digits
from jaxgran.model.choices import HALF_INTERVAL, MAX_GRAINS, MAX_REPLICAS
from jaxgran.model.display import to_two_digits
from jaxgran.model.flow import ShearFlow
from jaxgran.reference.surface import coordinates
from jaxgran.reference.table import CORRECTED, THEORY, shipped_table
from jaxgran.sampling.budget import sampling_target
from jaxgran.sampling.correlation_strain import flow_correlation_strain
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.thresholds import (
    LEAST_PREPARATION,
    LEAST_SAMPLE,
    LONGEST_CORRELATION_STRAINS,
    LONGEST_STRAIN,
    SAMPLE_CORRELATION_STRAINS,
)
from jaxgran.sampling.timestep import COARSE_TIMESTEP, automatic_timestep

_AUTOMATIC_ERROR = 0.02  # of the stresses from an automatic time step, where no error is given
_TIMESTEP_SHARE = 0.3  # of an error: short steps cost little
# Shares of an error for sampling: where the other parts leave less than the first one, the error is
# hardly reached, and the sample is for the second one.
_LEAST_SAMPLING_SHARE, _SAMPLING_SHARE = 0.2, 0.5
_WARMEST = 2.0  # temperature over the expected one
_SAFE: dict[str, Any] = {"grains": 256, "timestep": 1e-6}  # all flows accept these for "auto"
_SIZES = np.rint(256 * 2 ** np.arange(0, 20, 0.5)).astype(int)  # few, as each one is compiled
_SHORT_FLOATS: tuple[Any, ...] = (np.float16, np.float32)
PREPARED = 3.3  # correlation strains until most flows are steady
SECONDS = 5e-7  # of processor time for a unit of ``predicted_cost``, at 1000 grains


class Plan(NamedTuple):
    """What every point of a map needs for an error.

    =======  =======================================================================================
    grains   number of grains
    strain   strain of a sample
    seconds  processor time of all seeds, infinite where the error is not reached
    =======  =======================================================================================
    """

    grains: np.ndarray
    strain: np.ndarray
    seconds: np.ndarray


def cheapest(settings: MapSettings, error: float) -> Plan:
    """The numbers of grains (points,) that reach an error at the least cost; InputError where none
    reaches it.
    """
    sizes = _with_all(settings.diameters, _SIZES)
    plans = plans_of_sizes(settings, error, sizes[sizes <= MAX_GRAINS])
    best = np.argmin(plans.seconds, axis=1)
    plan = Plan(*(x[np.arange(len(best)), best] for x in plans))
    if not np.isfinite(plan.seconds).all():
        worst = int(np.argmax(plan.seconds))
        where = point_text(stack_of_any_size(settings.flows.values()), worst)
        reason = (
            f"is out of reach at {where} with up to {MAX_GRAINS} grains; take a larger one, more "
            "seeds or a shorter time step"
        )
        raise refused("error", error, reason)
    return plan


def _with_all(diameters: Any, sizes: ArrayLike) -> np.ndarray:
    """Numbers of grains, raised so that there are as many of each of the given diameters."""
    kinds = len(diameters) if isinstance(diameters, tuple) and diameters else 1
    return -(-np.asarray(sizes) // kinds) * kinds


def plans_of_sizes(settings: MapSettings, error: float, sizes: np.ndarray) -> Plan:
    """What reaches an error with each number of grains, (points, sizes).

    Of the error, time step and tolerance take what is given. The error of the size falls with N,
    and sampling may take what is left. With few grains that is little, and averages scatter more,
    so the sample is long. With many grains the preparation is long, as the correlation strain grows
    as √N. Strain and cost are right within a factor of two or three.
    """
    flows = stack_of_any_size(settings.flows.values())
    correlation = expected_correlation_strain(settings, flows, sizes[:, None]).T
    alpha = np.asarray(flows.restitution)[:, None]
    target = _targets(settings, error, flows, sizes)
    scatter = expected_scatter(alpha, sizes)
    enough = target > _LEAST_SAMPLING_SHARE * error / HALF_INTERVAL
    samples = np.where(enough, (scatter / np.where(enough, target, 1)) ** 2, np.inf)
    prepared, least, longest = _strains(correlation)
    sampled = np.maximum(2 * least, samples / settings.seeds * correlation)
    coarse = np.maximum(COARSE_TIMESTEP, np.asarray(flows.timestep))
    strain_cost = SECONDS * (sizes / 1000) ** 0.2 * sizes / flows.grains
    seconds = strain_cost * (
        prepared * predicted_cost(flows, coarse)[:, None] + sampled * predicted_cost(flows)[:, None]
    )
    seconds = np.where(sampled <= longest, settings.seeds * seconds, np.inf)
    return Plan(np.broadcast_to(sizes, seconds.shape), sampled, seconds)


def expected_costs(settings: MapSettings) -> dict[Point, float]:
    """Relative cost of a whole replica of each point, if it becomes steady and precise when most
    do.
    """
    flows = list(settings.flows.values())
    count = np.array([flow.grains for flow in flows])
    correlation = expected_correlation_strain(settings, stack_of_any_size(flows), count)
    prepared, sampled, longest = _strains(correlation)
    if settings.error is not None:
        sizes, place = np.unique(count, return_inverse=True)
        planned = plans_of_sizes(settings, settings.error, sizes).strain
        sampled = np.minimum(planned[np.arange(count.size), place], longest)
    strains = (
        expected if given is None else np.full(count.shape, given)
        for given, expected in ((settings.equilibrate, prepared), (settings.strain, sampled))
    )
    costs = map(replica_cost, flows, *(x.tolist() for x in strains))
    return dict(zip(settings.points, costs, strict=True))


def expected_seconds(settings: MapSettings, costs: Mapping[Point, float]) -> float:
    """Processor time of the replicas by ``expected_costs``, within a factor of three."""
    replicas = replica_ids(settings)
    return SECONDS * sum(costs[x.point] * (x.grains / 1000) ** 0.2 for x in replicas)


def _strains(correlation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strain of the preparation, and the least and the longest one of a sample, at some correlation
    strains.
    """
    return (
        np.maximum(LEAST_PREPARATION, PREPARED * correlation),
        np.maximum(LEAST_SAMPLE, SAMPLE_CORRELATION_STRAINS * correlation),
        np.maximum(LONGEST_STRAIN, LONGEST_CORRELATION_STRAINS * correlation),
    )


def expected_correlation_strain(
    settings: MapSettings, flows: ShearFlow, count: ArrayLike
) -> np.ndarray:
    """``flow_correlation_strain`` at the averages of kinetic theory, times what the corrected
    theory gives over it, here or at the nearest flow in its range; within a factor of 1.4 of that
    of the reference map.

    Args:
      settings: have the sizes of the grains.
      flows: a batch, (points,); its number of grains does not count.
      count: numbers of grains, (points,), or (sizes, 1) for those of each flow at each size.
    """
    table = shipped_table()
    where = coordinates(
        *(np.clip(getattr(flows, x), *table.range(x)) for x in ("restitution", "packing_fraction"))
    )
    logs = table.series(where)
    theory = predicted(flows, settings.discs)
    averages = {
        name: np.asarray(getattr(theory, name), float) * np.exp(logs[CORRECTED + name] - logs[name])
        for name in THEORY
    }
    area = np.pi / 4 * np.asarray(count) / np.asarray(flows.packing_fraction)
    return flow_correlation_strain(averages, count, count, area, 1.0)


def expected_scatter(restitution: ArrayLike, grains: ArrayLike) -> np.ndarray:
    """Relative standard error of the stresses in one correlation strain: a fit to the reference
    maps, within a factor of 1.5.
    """
    alpha, count = np.asarray(restitution), np.asarray(grains)
    return 0.0245 * np.exp(0.85 * (1 - alpha)) * (count / 1600) ** -0.415


def sampling_targets(settings: MapSettings, flows: ShearFlow) -> np.ndarray | None:
    """The relative standard error (replicas,) that each seed of some points is sampled to; None
    without an error.
    """
    if settings.error is None:
        return None
    left = _targets(settings, settings.error, flows, np.array([flows.grains]))[:, 0]
    error = settings.error / HALF_INTERVAL
    target = np.where(left > _LEAST_SAMPLING_SHARE * error, left, _SAMPLING_SHARE * error)
    return target * np.sqrt(settings.seeds)


def _targets(
    settings: MapSettings, error: float, flows: ShearFlow, sizes: np.ndarray
) -> np.ndarray:
    """``sampling_target`` (points, sizes) of some points, with room for warmer flows."""
    alpha, nu, timestep = (
        np.asarray(x)[:, None] for x in (flows.restitution, flows.packing_fraction, flows.timestep)
    )
    crossing = timestep * np.sqrt(_WARMEST * temperature_of(settings, flows))[:, None]
    return sampling_target(error, alpha, nu, sizes, crossing, settings.solver.tolerance)


def chosen_settings(parameters: Mapping[str, Any]) -> tuple[MapSettings, str]:
    """The settings of a map with numbers for "auto", and a sentence about these numbers, or "".

    With an ``error``, the grains are chosen for each point, and the time step for its share of it.

    Args:
      parameters: arguments of ``MapSettings``, also "auto", and lists, arrays or single numbers
        where it has tuples. What is no field of it is ignored.

    Raises:
      InputError: (a ValueError) a parameter is out of its range, or no number of grains reaches the
        error.
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
    if "grains" in safe:
        safe["grains"] = int(_with_all(plain.get("diameters"), safe["grains"]))
    checked = MapSettings(**{**plain, **safe, "strain": None})
    in_order = ("restitution", "packing_fraction", "grains_by_point")
    chosen = plain | {name: getattr(checked, name) for name in in_order}
    target = _AUTOMATIC_ERROR if checked.error is None else _TIMESTEP_SHARE * checked.error
    aim = f"{target:g} from the time step" if checked.error is None else f"{checked.error:g}"
    notes = []
    if "timestep" in automatic:
        chosen["timestep"], point = _timestep_for(checked, target, plain.get("strain"))
        notes = [f"timestep {chosen['timestep']:g} / shear rate, which {point} needs"]
    if "grains" in automatic:
        if checked.error is None:
            raise InputError("`grains='auto'` requires `error`.", field="grains", value="auto")
        timestep = chosen.get("timestep", checked.timestep)
        plan = cheapest(replace(checked, timestep=timestep), checked.error)
        of_flow = plan.grains.reshape(len(checked.timestep), -1).max(axis=0)
        by_point = (*of_flow.tolist(),) * len(checked.timestep)  # dt compare at one N
        chosen |= {"grains": max(by_point), "grains_by_point": by_point}
        seconds = plan.seconds.sum()
        time = f"about {duration(seconds)}" if seconds > 10 else "a few seconds"
        notes = [
            f"{_range(plan.grains)} grains, {checked.seeds} seed{'s' if checked.seeds > 1 else ''}",
            *notes,
            f"strains of about {_range(plan.strain)} for each seed",
            f"{time} of processor time",
        ]
    sentence = f"{'; '.join(notes)}: for a relative error of {aim} in force ratio and stresses."
    return MapSettings(**chosen), sentence


def _range(numbers: np.ndarray) -> str:
    """The least and the largest number, with two digits unless they are whole."""
    exact = numbers.dtype.kind == "i"
    ends = sorted(
        {*map(str if exact else to_two_digits, (numbers.min(), numbers.max()))}, key=float
    )
    return " to ".join(ends)


def _timestep_for(settings: MapSettings, error: float, strain: Any) -> tuple[float, str]:
    """The time step of an error, and the point that needs it: one for all points, so that their
    force ratios compare.
    """
    flows = stack_of_any_size(settings.flows.values())
    temperature = temperature_of(settings, flows)
    grains = np.array([flow.grains for flow in settings.flows.values()])
    longest = automatic_timestep(
        temperature, flows.packing_fraction, flows.activation, grains, error
    )
    steps = (
        np.minimum(longest, strain / FEWEST_STEPS) if isinstance(strain, int | float) else longest
    )
    shortest = int(np.argmin(steps))
    return float(two_digits(steps[shortest], up=False)), point_text(flows, shortest)


def _plain_settings(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that are fields of ``MapSettings``, with tuples for lists."""
    names = [row.name for row in fields(MapSettings) if row.name in parameters]
    plain = {name: _plain(parameters[name], OPTIONS[name].kind) for name in names}
    by_point = plain.get("grains_by_point")
    if isinstance(by_point, tuple) and by_point and all(isinstance(x, int) for x in by_point):
        plain["grains"] = max(by_point)
    return plain


def _plain(value: Any, kind: Any) -> Any:
    """A number as a Python number, a list or array of numbers as a tuple; ``MapSettings`` checks
    all other values.

    Whole numbers of a list become floats unless ``kind`` is int, and one of float32 becomes the
    decimal that it stands for, such as 0.3.
    """
    try:
        if isinstance(value, np.ma.MaskedArray) or (
            isinstance(value, Sequence) and len(value) > MAX_REPLICAS
        ):
            return value
        if isinstance(value, (list, tuple)):
            if any(isinstance(x, bool) for x in value):  # which NumPy would take for numbers
                return tuple(value)
            value = [rounded(x) if isinstance(x, _SHORT_FLOATS) else x for x in value]
        array = np.asarray(value)
    except (TypeError, ValueError):  # a random key, or lists of different lengths
        return value
    real = array.ndim and array.dtype.kind in "iu" and kind is not int
    if array.dtype.type in _SHORT_FLOATS:
        array = np.reshape([rounded(x) for x in array.flat], array.shape)
    plain = array.astype(float).tolist() if real else array.tolist()
    return tuple(plain) if isinstance(plain, list) else plain
