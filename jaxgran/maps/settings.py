"""MapSettings: all parameters that the numbers of a ratio map depend on, checked before the run."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, require_solver
from jaxgran.dynamics.engine import Numerics, checked_numerics, select_engine
from jaxgran.maps.own_observables import require_observe
from jaxgran.maps.parameters import MapParameters, default
from jaxgran.model.checks import (
    InputError,
    refused,
    require_flag,
    require_number,
    require_whole,
    two_digits,
)
from jaxgran.model.choices import MAX_GRAINS, MAX_REPLICAS, MAX_STEPS, SHORTEST_TIMESTEP
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains, own_grains
from jaxgran.sampling.batch import stack
from jaxgran.sampling.budget import SHARES, fewest_grains, size_error
from jaxgran.sampling.correlation_strain import LEAST_SAMPLE
from jaxgran.sampling.packing import require_room
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.timestep import automatic_timestep, expected_temperature, longest_timestep

_FEWEST_STEPS = 160  # of a sample: five time steps in each of its 32 blocks
_LARGEST_SEED = 2**30
_AUTOMATIC_ERROR = 0.02  # of the stresses from an automatic time step, where no error is given
_SAFE: dict[str, Any] = {"grains": 256, "timestep": 1e-6}  # all flows accept these for "auto"


@dataclass(frozen=True)
class MapSettings(MapParameters):
    """The parameters that the numbers of a map depend on, checked, without "auto", and with tuples
    for lists.

    ``solver`` and ``engine`` are values, see ``ProjectedMethod`` and ``dynamics.engine``; None
    stands for the default solver and for the automatic choice of an engine. A given ``tolerance``
    becomes that of the solver.
    """

    if TYPE_CHECKING:
        restitution: tuple[float, ...] = ()
        packing_fraction: tuple[float, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "solver", _with_tolerance(self.solver, self.tolerance))
        object.__setattr__(self, "tolerance", None)
        checked_numerics(self.solver, self.engine)
        for name, values in self.axes.items():
            _require_axis(name, values)
        require_whole("seeds", self.seeds, 1, MAX_REPLICAS, "the most replicas of a map")
        require_whole(
            "first_seed",
            self.first_seed,
            0,
            _LARGEST_SEED,
            "to fit into 32 bits with all that follow",
        )
        require_flag("snapshots", self.snapshots)
        plane = len(self.packing_fraction) * len(self.restitution)
        self._require_grains_by_point(len(self._timesteps) * plane)
        self._sort_plane()
        count = math.prod(map(len, self.axes.values())) * self.seeds
        if count > MAX_REPLICAS:
            raise InputError(
                f"a map must have at most {MAX_REPLICAS} replicas, points times seeds, "
                f"not {count}.",
                field="seeds",
            )
        for row in fields(MapParameters):
            value, ranged = getattr(self, row.name), row.metadata["option"].range
            if ranged is not None and value is not None and row.name not in self.axes:
                require_number(row.name, value, *ranged)
        self._require_diameters()
        self._require_part()
        flows = stack_of_any_size(self._checked_flows())
        if self.observe is not None:
            require_observe(self.observe, self._checked_flows()[0])
        shortest, longest = min(self._timesteps), max(self._timesteps)
        if shortest < SHORTEST_TIMESTEP:
            raise refused(
                "timestep", shortest, f"must be at least {SHORTEST_TIMESTEP:g} / shear rate"
            )
        strain = LEAST_SAMPLE if self.strain is None else self.strain
        if strain > MAX_STEPS * shortest:
            most = f"{MAX_STEPS} time steps, that is {MAX_STEPS * shortest:g}"
            raise refused("strain", strain, f"must be at most {most}")
        limits = longest_timestep(
            _temperature(self, flows), flows.packing_fraction, flows.activation
        )
        excess = np.asarray(flows.timestep) / limits
        worst = int(np.argmax(excess))
        if excess[worst] > 1:
            raise refused(
                "timestep",
                float(np.asarray(flows.timestep)[worst]),
                f"must be at most {two_digits(limits[worst], up=False)} at {_point(flows, worst)} "
                "to avoid deep "
                "overlaps, or auto",
            )
        if round(strain / longest) < _FEWEST_STEPS:
            least = f"{_FEWEST_STEPS} time steps, that is {_FEWEST_STEPS * longest:g}"
            raise refused("strain", strain, f"must be at least {least}")

    @property
    def axes(self) -> dict[str, tuple[float, ...]]:
        """Values of the dimensions of a map by name, outermost first.

        ``grains`` and ``timestep`` are among them if they are lists.
        """
        optional: dict[str, Any] = {"grains": self.grains, "timestep": self.timestep}
        lists = {name: values for name, values in optional.items() if isinstance(values, tuple)}
        plane: dict[str, Any] = {
            "packing_fraction": self.packing_fraction,
            "restitution": self.restitution,
        }
        return lists | plane

    @property
    def numerics(self) -> Numerics:
        """Solver and engine as one value."""
        return Numerics(self.solver, self.engine)

    @property
    def sizes(self) -> tuple[int, ...]:
        """The numbers of grains, at least one."""
        if self.grains_by_point is not None:
            return tuple(sorted(set(self.grains_by_point)))
        return self.axes.get("grains", (self.grains,))  # type: ignore[return-value]

    @property
    def _timesteps(self) -> tuple[float, ...]:
        return self.axes.get("timestep", (self.timestep,))  # type: ignore[arg-type]

    def require_engine(self) -> None:
        """Raise an InputError if the engine that is asked for cannot run this map here."""
        if self.engine is not None:
            select_engine(
                self.flows()[0], self.numerics, option="" if self.observe is None else "observe"
            )

    def _require_grains_by_point(self, points: int) -> None:
        """Raise an InputError unless grains by point are given for all points, and not as a list
        too.
        """
        values = self.grains_by_point
        listed = isinstance(values, tuple) and len(values) == points and _are_numbers(values)
        if values is not None and (not listed or "grains" in self.axes):
            raise refused(
                "grains_by_point", values, f"must be a list of {points} numbers, one for each point"
            )

    def _sort_plane(self) -> None:
        """Put restitutions and packing fractions, and the grains of their points, in ascending
        order.
        """
        if self.grains_by_point is not None:
            by_point = np.reshape(
                self.grains_by_point, (-1, len(self.packing_fraction), len(self.restitution))
            )
            by_point = by_point[:, np.argsort(self.packing_fraction)][
                ..., np.argsort(self.restitution)
            ]
            object.__setattr__(self, "grains_by_point", tuple(by_point.ravel().tolist()))
        for name in ("restitution", "packing_fraction"):
            object.__setattr__(self, name, tuple(sorted(getattr(self, name))))

    def _require_diameters(self) -> None:
        if self.diameters is None:
            return
        own_grains(self.diameters)  # type: ignore[arg-type]
        if self.polydispersity != default("polydispersity"):
            reason = "must be left out where `diameters` are given"
            raise refused("polydispersity", self.polydispersity, reason)
        if any(size % len(self.diameters) for size in self.sizes):
            sizes = ", ".join(map(str, self.sizes))
            reason = f"must be a list whose length divides the number of grains, {sizes}"
            raise refused("diameters", list(self.diameters), reason)
        densest = max(self._checked_flows(), key=lambda flow: float(flow.packing_fraction))
        for size in self.sizes:
            require_room(replace(densest, grains=size), own_grains(np.resize(self.diameters, size)))

    def _require_part(self) -> None:
        if self.part is None:
            return
        found = (
            re.fullmatch(r"([1-9]\d{0,5})/([1-9]\d{0,5})", self.part)
            if isinstance(self.part, str)
            else None
        )
        points = math.prod(map(len, self.axes.values()))
        if found is None or not int(found[1]) <= int(found[2]) <= points:
            raise refused(
                "part",
                self.part,
                f"must be K/N with K at most N, and N at most {points}, the number of points",
            )

    def grains_of(self, size: int, replicas: int) -> Grains | None:
        """The discs (replicas, size) that a flow is given; None where their diameters are
        uniform.
        """
        if self.diameters is None:
            return None
        discs = own_grains(np.resize(self.diameters, size))
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (replicas, size)), discs)

    def size_classes(self, replicas: int) -> Grains | None:
        """Discs in the proportions of the given diameters, for kinetic theory; None where diameters
        are uniform.
        """
        return None if self.diameters is None else self.grains_of(8 * len(self.diameters), replicas)

    def flows(self) -> list[ShearFlow]:
        """One flow for each point, in the order of ``axes``: the last one changes fastest."""
        return list(_flows(self))

    def _checked_flows(self) -> list[ShearFlow]:
        """New flows for all points; InputError if a number is out of range."""
        points = list(product(self._timesteps, self.packing_fraction, self.restitution))
        if self.grains_by_point is None:
            numbers = [(grains, *point) for grains in self.sizes for point in points]
        else:
            numbers = [
                (grains, *point) for grains, point in zip(self.grains_by_point, points, strict=True)
            ]
        return [
            ShearFlow(
                grains=grains,
                restitution=alpha,
                packing_fraction=nu,
                timestep=dt,
                activation=self.activation,
                polydispersity=self.polydispersity,
            )
            for grains, dt, nu, alpha in numbers
        ]


@lru_cache(maxsize=4)
def _flows(settings: MapSettings) -> tuple[ShearFlow, ...]:
    """The flows of a map, kept for its batches: a map of thousands of points has hundreds of
    batches.
    """
    return tuple(settings._checked_flows())


def stack_of_any_size(flows: Sequence[ShearFlow]) -> ShearFlow:
    """The flows as one batch at their largest number of grains, for what does not depend on this
    number.
    """
    largest = max(flow.grains for flow in flows)
    return stack(
        [flow if flow.grains == largest else replace(flow, grains=largest) for flow in flows]
    )


def chosen_settings(asked: MapParameters) -> tuple[MapSettings, str]:
    """The settings of a map with numbers for "auto", and a sentence about these numbers, or "".

    With an ``error``, the grains are chosen for each point, and the time step for its share of it.

    Raises:
      InputError: (a ValueError) a parameter is out of its range, or the error needs too many
        grains.
    """
    rows = fields(MapParameters)
    chosen: dict[str, Any] = {
        one.name: _plain(getattr(asked, one.name), one.metadata["option"].kind) for one in rows
    }
    for name in ("restitution", "packing_fraction"):
        if _are_numbers((chosen[name],)):
            chosen[name] = (chosen[name],)
    by_point = chosen["grains_by_point"]
    if (
        isinstance(by_point, tuple)
        and by_point
        and all(isinstance(grains, int) for grains in by_point)
    ):
        chosen["grains"] = max(by_point)
    automatic = {name for name in _SAFE if isinstance(chosen[name], str) and chosen[name] == "auto"}
    if not automatic:
        return MapSettings(**chosen), ""
    checked = MapSettings(**{**chosen, **{name: _SAFE[name] for name in automatic}, "strain": None})
    chosen |= {
        name: getattr(checked, name)
        for name in ("restitution", "packing_fraction", "grains_by_point")
    }
    target = _AUTOMATIC_ERROR if checked.error is None else SHARES["timestep"] * checked.error
    notes = []
    if "grains" in automatic:
        if checked.error is None:
            raise InputError("`grains='auto'` requires `error`.", field="grains", value="auto")
        by_point = _grains_for(checked, checked.error)
        chosen |= {"grains": max(by_point), "grains_by_point": by_point}
        sizes = " to ".join(str(size) for size in sorted({min(by_point), max(by_point)}))
        notes.append(f"{sizes} grains, {checked.seeds} seed{'s' if checked.seeds > 1 else ''}")
    if "timestep" in automatic:
        flows = stack_of_any_size(replace(checked, timestep=_SAFE["timestep"], strain=1.0).flows())
        steps = automatic_timestep(
            _temperature(checked, flows), flows.packing_fraction, flows.activation, target
        )
        if isinstance(chosen["strain"], int | float):
            steps = np.minimum(steps, chosen["strain"] / _FEWEST_STEPS)
        shortest = int(np.argmin(steps))  # one for all points, so that their force ratios compare
        chosen["timestep"] = float(two_digits(steps[shortest], up=False))
        notes.append(
            f"timestep {chosen['timestep']:g} / shear rate, which {_point(flows, shortest)} needs"
        )
    aim = f"{target:g} from the time step" if checked.error is None else f"{checked.error:g}"
    return MapSettings(
        **chosen
    ), f"{'; '.join(notes)}: for a relative error of {aim} in the stresses."


def _grains_for(settings: MapSettings, error: float) -> tuple[int, ...]:
    """The number of grains that each point needs for its share of an error."""
    points = [(nu, alpha) for nu, alpha in product(settings.packing_fraction, settings.restitution)]
    grains = [fewest_grains(alpha, nu, SHARES["size"] * error) for nu, alpha in points]
    if max(grains) > MAX_GRAINS:
        surely = MAX_GRAINS / 2**0.5  # numbers of grains are chosen in steps of √2
        least = max(float(size_error(alpha, nu, surely)) for nu, alpha in points) / SHARES["size"]
        reason = (
            f"must be at least {two_digits(least, up=True)} at these points, to need at most "
            f"{MAX_GRAINS} grains"
        )
        raise refused("error", error, reason)
    return tuple(grains) * len(settings._timesteps)


def _with_tolerance(solver: Any, tolerance: Any) -> Any:
    """The solver with a given tolerance, or its own without one."""
    solver = DEFAULT_SOLVER if solver is None else solver
    require_solver(solver)
    return solver if tolerance is None else replace(solver, tolerance=tolerance)


def _require_axis(name: str, values: Any) -> None:
    """Raise an InputError unless these are different numbers."""
    if not isinstance(values, tuple) or len(values) > MAX_REPLICAS:
        raise refused(name, values, f"must be a list of at most {MAX_REPLICAS} numbers")
    if len(values) == 0:
        raise refused(name, [], "must be a list of at least one number")
    if not _are_numbers(values):
        raise refused(name, values, "must be a list of numbers")
    if len(set(values)) < len(values):
        raise refused(name, list(values), "must be a list without repetition, in any order")


def _are_numbers(values: tuple) -> bool:
    return all(
        isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool)
        for x in values
    )


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


def _temperature(settings: MapSettings, flows: ShearFlow) -> np.ndarray:
    """Expected granular temperature of each flow, in mσ²/t²."""
    theory = predicted(
        flows, settings.size_classes(np.size(flows.restitution))
    ).granular_temperature
    return expected_temperature(theory, flows.packing_fraction, flows.shear_rate)


def _point(flows: ShearFlow, k: int) -> str:
    """Restitution and packing fraction of flow ``k`` of a batch, for a message."""
    alpha, nu = (float(np.asarray(x)[k]) for x in (flows.restitution, flows.packing_fraction))
    return f"restitution {alpha:g} and packing fraction {nu:g}"
