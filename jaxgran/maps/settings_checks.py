"""What is accepted as the settings of a map, and as the options of its run.

``settings`` calls these checks, and nothing of it is needed here: the rows of a value are its
``fields``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, require_solver
from jaxgran.dynamics.batch import stack
from jaxgran.dynamics.engine import Jax, Numba, checked_numerics, select_engine
from jaxgran.io.paths import as_path, require_place
from jaxgran.model.checks import (
    InputError,
    refused,
    require_flag,
    require_number,
    require_static_function,
    require_whole,
    short_repr,
    two_digits,
)
from jaxgran.model.choices import MAX_REPLICAS, MAX_STEPS, SHORTEST_TIMESTEP
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import own_grains
from jaxgran.sampling.observe import observed_shapes
from jaxgran.sampling.packing import require_room
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.thresholds import LEAST_SAMPLE
from jaxgran.sampling.timestep import expected_temperature, longest_timestep

if TYPE_CHECKING:
    from jaxgran.maps.settings import MapSettings, RunOptions

FEWEST_STEPS = 160  # of a sample: five time steps in each of its 32 blocks
_LARGEST_SEED = 2**30
_MOST_WORKERS = 1024


def with_tolerance(solver: Any, tolerance: Any) -> Any:
    """The solver with a given tolerance, or its own without one."""
    solver = DEFAULT_SOLVER if solver is None else solver
    require_solver(solver)
    return solver if tolerance is None else replace(solver, tolerance=tolerance)


def check_axes(settings: MapSettings) -> None:
    """Raise an InputError unless the axes are lists of different numbers, and grains by point are
    given for all points, and not as a list too.
    """
    for name, values in settings.axes.items():
        if len(values) > MAX_REPLICAS:
            raise refused(name, values, f"must be a list of at most {MAX_REPLICAS} numbers")
        if len(values) == 0:
            raise refused(name, [], "must be a list of at least one number")
        if not are_numbers(values):
            value = values[0] if len(values) == 1 else values
            raise refused(name, value, "must be a number or a list of numbers")
        if len(set(values)) < len(values):
            raise refused(name, list(values), "must be a list without repetition, in any order")
    by_point = settings.grains_by_point
    if by_point is None:
        return
    points = len(settings.timestep) * len(settings.packing_fraction) * len(settings.restitution)
    listed = isinstance(by_point, tuple) and len(by_point) == points and are_numbers(by_point)
    if not listed or len(settings.grains) > 1:
        reason = f"must be a list of {points} numbers, one for each point"
        raise refused("grains_by_point", by_point, reason)


def check_settings(settings: MapSettings) -> None:
    """Raise an InputError unless a map of these settings can be run."""
    checked_numerics(settings.solver, settings.engine)
    require_whole("seeds", settings.seeds, 1, MAX_REPLICAS, "the most replicas of a map")
    because = "to fit into 32 bits with all that follow"
    require_whole("first_seed", settings.first_seed, 0, _LARGEST_SEED, because)
    require_flag("snapshots", settings.snapshots)
    points = math.prod(map(len, settings.axes.values()))
    if points * settings.seeds > MAX_REPLICAS:
        raise InputError(
            f"a map must have at most {MAX_REPLICAS} replicas, points times seeds, "
            f"not {points * settings.seeds}.",
            field="seeds",
        )
    for row in fields(settings):
        value, accepted = getattr(settings, row.name), row.metadata["option"].range
        if accepted is not None and value is not None:
            for number in value if row.name in settings.axes else (value,):
                require_number(row.name, number, *accepted)
    if settings.equilibrate is None and max(settings.restitution) == 1:
        reason = "must be below 1 unless `equilibrate` is given, as elastic grains only heat up"
        raise refused("restitution", 1.0, reason)
    flows = list(settings.flows.values())
    _check_diameters(settings, flows)
    _check_part(settings, points)
    if settings.observe is not None:
        _check_observe(settings.observe, flows[0])
    _check_timesteps(settings, stack_of_any_size(flows))


def _check_diameters(settings: MapSettings, flows: Sequence[ShearFlow]) -> None:
    if settings.diameters is None:
        return
    own_grains(settings.diameters)  # type: ignore[arg-type]
    defaults = {row.name: row.default for row in fields(settings)}
    if settings.polydispersity != defaults["polydispersity"]:
        reason = "must be left out where `diameters` are given"
        raise refused("polydispersity", settings.polydispersity, reason)
    sizes = dict.fromkeys(settings.grains_by_point or settings.grains)
    if any(size % len(settings.diameters) for size in sizes):
        words = ", ".join(map(str, sizes))
        reason = f"must be a list whose length divides the number of grains, {words}, or `grains` "
        reason += f"a multiple of {len(settings.diameters)}"
        raise refused("diameters", list(settings.diameters), reason)
    densest = max(flows, key=lambda flow: float(flow.packing_fraction))
    for size in sizes:
        discs = own_grains(np.resize(settings.diameters, size))
        require_room(replace(densest, grains=size), discs)


def _check_part(settings: MapSettings, points: int) -> None:
    if settings.part is None:
        return
    text = settings.part if isinstance(settings.part, str) else ""
    share = re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", text)
    if share is None or not int(share[1]) <= int(share[2]) <= points:
        reason = f"must be K/N with K at most N, and N at most {points}, the number of points"
        raise refused("part", settings.part, reason)


def _check_observe(observe: Any, flow: ShearFlow) -> None:
    """Raise an InputError unless a function returns numbers or arrays, summed over contacts, by
    name.
    """
    if not callable(observe):
        reason = "must be a function that is passed to `ratio_map`, or None"
        raise refused("observe", observe, reason)
    require_static_function("observe", observe)
    shapes = observed_shapes(observe, flow)
    names = list(shapes) if isinstance(shapes, dict) else []
    if not names or not all(isinstance(x, jax.ShapeDtypeStruct) for x in shapes.values()):
        raise InputError(
            "observe must return a dictionary of numbers or arrays by name.", field="observe"
        )
    if not all(isinstance(name, str) and name.isidentifier() for name in names):
        raise InputError(
            f"observe must return names without spaces and signs, not {short_repr(names)}."
        )


def _check_timesteps(settings: MapSettings, flows: ShearFlow) -> None:
    """Raise an InputError if a time step does not fit to the flows or to the sampled strain."""
    shortest, coarsest = min(settings.timestep), max(settings.timestep)
    if shortest < SHORTEST_TIMESTEP:
        reason = f"must be at least {SHORTEST_TIMESTEP:g} / shear rate"
        raise refused("timestep", shortest, reason)
    strain = LEAST_SAMPLE if settings.strain is None else settings.strain
    if strain > MAX_STEPS * shortest:
        longest = two_digits(MAX_STEPS * shortest, up=False)
        most = f"{MAX_STEPS} time steps, that is {longest}"
        raise refused("strain", strain, f"must be at most {most}")
    temperature = temperature_of(settings, flows)
    limits = longest_timestep(temperature, flows.packing_fraction, flows.activation)
    excess = np.asarray(flows.timestep) / limits
    worst = int(np.argmax(excess))
    if excess[worst] > 1:
        most = two_digits(limits[worst], up=False)
        reason = f"must be at most {most} at {point_text(flows, worst)} to avoid deep overlaps"
        reason += ", which is safe for all points, or auto" if len(limits) > 1 else ", or auto"
        raise refused("timestep", float(np.asarray(flows.timestep)[worst]), reason)
    if round(strain / coarsest) < FEWEST_STEPS:
        least = f"{FEWEST_STEPS} time steps, that is {FEWEST_STEPS * coarsest:g}"
        raise refused("strain", strain, f"must be at least {least}")


def require_engine(settings: MapSettings) -> None:
    """Raise an InputError if the engine that is asked for cannot run this map here."""
    if settings.engine is None:
        return
    if settings.engine not in (Jax(), Numba()):
        raise refused("engine", settings.engine, "must be Jax(), Numba() or None, without options")
    select_engine(settings.numerics)


def check_run(run: RunOptions) -> None:
    """Raise an InputError unless a map can be run and kept with these options."""
    require_flag("overwrite", run.overwrite)
    require_flag("resume", run.resume)
    if run.workers is not None:
        require_whole("workers", run.workers, 1, _MOST_WORKERS)
    if not isinstance(run.progress, bool) and not callable(run.progress):
        raise refused("progress", run.progress, "must be True, False or a function of one number")
    has_port = isinstance(run.scheduler, str) and ":" in run.scheduler
    if run.scheduler is not None and not has_port:
        reason = "must be an address such as tcp://127.0.0.1:8786"
        raise refused("scheduler", run.scheduler, reason)
    several = run.workers is not None and run.workers > 1
    if run.scheduler is not None and several:
        raise InputError("`scheduler` and `workers` exclude each other.", field="scheduler")
    if run.record is not None and not callable(run.record):
        raise refused("record", run.record, "must be a function")
    if run.record is not None and (run.resume or several or run.scheduler is not None):
        raise InputError("`record` requires one worker, and excludes `resume`.", field="record")
    if run.attributes is not None and not isinstance(run.attributes, dict):
        raise refused("attributes", run.attributes, "must be a dictionary")
    if run.output is None:
        if run.resume:
            raise InputError("`resume` requires `output`.", field="resume")
        return
    require_place(as_path("output", run.output), "output", ".nc")


def are_numbers(values: Sequence[Any]) -> bool:
    """Whether all values are single real numbers."""
    return all(
        isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool)
        for x in values
    )


def stack_of_any_size(flows: Iterable[ShearFlow]) -> ShearFlow:
    """The flows as one batch at their largest number of grains, for what does not depend on this
    number.
    """
    flows = list(flows)
    largest = max(flow.grains for flow in flows)
    return stack(
        [flow if flow.grains == largest else replace(flow, grains=largest) for flow in flows]
    )


def temperature_of(settings: MapSettings, flows: ShearFlow) -> np.ndarray:
    """Expected granular temperature of each flow, in mσ²/t²."""
    theory = predicted(flows, settings.discs).granular_temperature
    return expected_temperature(theory, flows.packing_fraction, flows.shear_rate)


def point_text(flows: ShearFlow, k: int) -> str:
    """Restitution and packing fraction of flow ``k`` of a batch, for a message."""
    alpha, nu = (float(np.asarray(x)[k]) for x in (flows.restitution, flows.packing_fraction))
    return f"restitution {alpha:g} and packing fraction {nu:g}"
