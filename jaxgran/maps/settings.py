"""MapSettings: all parameters that the numbers of a ratio map depend on, checked before the run."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod, require_solver
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics, select_engine
from jaxgran.model.checks import InputError, require_number, require_whole, short_repr, two_digits
from jaxgran.model.choices import MAX_GRAINS, MAX_REPLICAS, MAX_STEPS, SHORTEST_TIMESTEP, Activation
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.batch import stack
from jaxgran.sampling.budget import SHARES, fewest_grains, size_error
from jaxgran.sampling.correlation_strain import LEAST_SAMPLE
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.timestep import automatic_timestep, automatic_tolerance, expected_temperature, longest_timestep

_FEWEST_STEPS = 160  # of a sample: five time steps in each of its 32 blocks
_LONGEST_EQUILIBRATION = 1e6  # strain before the sample
_LARGEST_SEED = 2**30
_ACCEPTED_TIMESTEP = 1e-6  # 1/γ̇; all flows accept it


@dataclass(frozen=True)
class MapSettings:
    """All parameters that the numbers of a map depend on; see ``ratio_map`` for their meaning."""

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    grains: int | tuple[int, ...] = 256
    seeds: int = 2
    timestep: float | tuple[float, ...] = 1e-3
    equilibrate: float | None = None
    strain: float | None = None
    error: float | None = None
    solver: ProjectedMethod = DEFAULT_SOLVER
    activation: Activation = "midpoint"
    engine: Engine | None = None
    grains_by_point: tuple[int, ...] | None = None  # in the order of ``flows``; ``grains`` is then the largest
    snapshots: bool = False
    first_seed: int = 0

    def __post_init__(self):
        for name, values in self.axes.items():
            if not isinstance(values, tuple) or len(values) > MAX_REPLICAS:
                raise InputError(f"{name} must be a list of at most {MAX_REPLICAS} numbers, not {short_repr(values)}.")
            if len(values) == 0:
                raise InputError(f"{name} must be a list of at least one number, and it is empty.")
            if not all(
                isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool) for x in values
            ):
                raise InputError(f"{name} must be a list of numbers, not {short_repr(values)}.")
            if len(set(values)) < len(values) or (
                list(values) != sorted(values) and list(values) != sorted(values)[::-1]
            ):
                raise InputError(f"{name} must be sorted and without repetition, not {short_repr(list(values))}.")
        require_whole("seeds", self.seeds, 1, MAX_REPLICAS, "the most replicas of a map")
        require_whole("first_seed", self.first_seed, 0, _LARGEST_SEED, "to fit into 32 bits with all that follow")
        if not isinstance(self.snapshots, bool):
            raise InputError(f"snapshots must be True or False, not {short_repr(self.snapshots)}.")
        count = math.prod(map(len, self.axes.values())) * self.seeds
        if count > MAX_REPLICAS:
            raise InputError(f"a map must have at most {MAX_REPLICAS} replicas, points times seeds, not {count}.")
        if self.strain is not None:
            require_number("strain", self.strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
        if self.error is not None:
            require_number("error", self.error, lambda x: (x >= 1e-3) & (x <= 0.5), "between 1e-3 and 0.5")
        if self.equilibrate is not None:
            most, words = _LONGEST_EQUILIBRATION, f"a number of at least 0 and at most {_LONGEST_EQUILIBRATION:g}"
            require_number("equilibrate", self.equilibrate, lambda x: (x >= 0) & (x <= most), words)
        if not isinstance(self.timestep, tuple):
            require_number("timestep", self.timestep, lambda x: x > 0, "a positive number")
        checked_numerics(self.solver, self.engine)
        flows = stack_of_any_size(self._checked_flows())
        if self.engine is not None:
            select_engine(flows, self.numerics)
        shortest, longest = min(self._timesteps), max(self._timesteps)
        if shortest < SHORTEST_TIMESTEP:
            raise InputError(
                f"timestep must be at least {SHORTEST_TIMESTEP:g} / shear rate, or the steps of a run would be too "
                f"many to count, not {shortest:g}."
            )
        strain = LEAST_SAMPLE if self.strain is None else self.strain
        if strain > MAX_STEPS * shortest:
            raise InputError(
                f"strain must be at most {MAX_STEPS} time steps, that is {MAX_STEPS * shortest:g}, not {strain:g}."
            )
        limits = longest_timestep(_temperature(flows), flows.packing_fraction, self.activation)
        excess = np.asarray(flows.timestep) / limits
        worst = int(np.argmax(excess))
        if excess[worst] > 1:
            raise InputError(
                f"timestep must be at most {two_digits(limits[worst], up=False)} at {_point(flows, worst)}, or grains "
                "would overlap deeply; auto chooses one."
            )
        if round(strain / longest) < _FEWEST_STEPS:
            raise InputError(
                f"strain must be at least {_FEWEST_STEPS} time steps, that is {_FEWEST_STEPS * longest:g}, "
                f"not {strain:g}."
            )

    @property
    def axes(self) -> dict[str, tuple[float, ...]]:
        """Values of the dimensions of a map by name, outermost first.

        ``grains`` and ``timestep`` are among them if they are lists.
        """
        further = {"grains": self.grains, "timestep": self.timestep}
        lists = {name: values for name, values in further.items() if isinstance(values, tuple)}
        return {**lists, "packing_fraction": self.packing_fraction, "restitution": self.restitution}

    @property
    def numerics(self) -> Numerics:
        """Solver and engine as one value."""
        return Numerics(self.solver, self.engine)

    @property
    def sizes(self) -> tuple[int, ...]:
        """The numbers of grains, at least one."""
        if self.grains_by_point is not None:
            return tuple(sorted(set(self.grains_by_point)))
        return self.grains if isinstance(self.grains, tuple) else (self.grains,)

    @property
    def _timesteps(self) -> tuple[float, ...]:
        return self.timestep if isinstance(self.timestep, tuple) else (self.timestep,)

    def flows(self) -> list[ShearFlow]:
        """One flow for each point, in the order of ``axes``: the last one changes fastest."""
        return list(_flows(self))

    def _checked_flows(self) -> list[ShearFlow]:
        """New flows for all points; InputError if a number is out of range."""
        points = list(product(self._timesteps, self.packing_fraction, self.restitution))
        if self.grains_by_point is None:
            numbers = [(grains, *point) for grains in self.sizes for point in points]
        else:
            numbers = [(grains, *point) for grains, point in zip(self.grains_by_point, points, strict=True)]
        return [
            ShearFlow(
                grains=grains,
                restitution=alpha,
                packing_fraction=nu,
                timestep=dt,
                activation=self.activation,
            )
            for grains, dt, nu, alpha in numbers
        ]


@lru_cache(maxsize=4)
def _flows(settings: MapSettings) -> tuple[ShearFlow, ...]:
    """The flows of a map, kept for its batches: a map of thousands of points has hundreds of batches."""
    return tuple(settings._checked_flows())


def stack_of_any_size(flows: Sequence[ShearFlow]) -> ShearFlow:
    """The flows as one batch at their largest number of grains, for what does not depend on this number."""
    largest = max(flow.grains for flow in flows)
    return stack([flow if flow.grains == largest else replace(flow, grains=largest) for flow in flows])


def automatic(choices: Mapping[str, Any], target_error: float) -> tuple[dict[str, Any], str]:
    """The parameters of a map with numbers in place of "auto", and a sentence about these numbers, or "".

    Args:
      choices: keyword arguments of ``MapSettings``, and ``tolerance``, a number in place of that of the solver.
        ``grains``, ``timestep`` and ``tolerance`` may be "auto". The grains are then chosen by point, for the ``error``
        of the map.
      target_error: largest accepted relative error of pressure and shear stress from the time step. A given ``error``
        sets it.
    """
    require_number("target_error", target_error, lambda x: (x >= 1e-4) & (x <= 0.1), "between 1e-4 and 0.1")
    chosen, words = dict(choices), []
    tolerance, solver = chosen.pop("tolerance", None), chosen.get("solver", DEFAULT_SOLVER)
    require_solver(solver)
    error = chosen.get("error")
    if error is not None:
        MapSettings(**{**chosen, "grains": 256, "timestep": _ACCEPTED_TIMESTEP})  # checks the lists
        target_error = SHARES["timestep"] * error
    if isinstance(chosen.get("grains"), str):
        if error is None:
            raise InputError("grains may be auto only with a given error, which they are chosen for.")
        grid = [(alpha, nu) for nu, alpha in product(chosen["packing_fraction"], chosen["restitution"])]
        grains = [fewest_grains(*point, SHARES["size"] * error) for point in grid]
        if max(grains) > MAX_GRAINS:
            surely = MAX_GRAINS / 2**0.5  # numbers of grains are chosen in steps of √2
            least = max(float(size_error(*point, surely)) for point in grid) / SHARES["size"]
            raise InputError(
                f"error must be at least {two_digits(least, up=True)} at these points, not {error:g}: it would "
                f"need more than {MAX_GRAINS} grains."
            )
        steps = len(chosen["timestep"]) if isinstance(chosen.get("timestep"), tuple) else 1
        chosen |= {"grains": max(grains), "grains_by_point": tuple(grains) * steps}
        chosen.setdefault("seeds", 1)  # a longer sample is cheaper than a second preparation
        sizes = " to ".join(str(size) for size in sorted({min(grains), max(grains)}))
        words.append(f"{sizes} grains, {chosen['seeds']} seed{'s' if chosen['seeds'] > 1 else ''}")
    if isinstance(chosen.get("timestep"), str) and chosen["timestep"] == "auto":
        flows = stack_of_any_size(MapSettings(**{**chosen, "timestep": _ACCEPTED_TIMESTEP, "strain": 1.0}).flows())
        steps = automatic_timestep(
            _temperature(flows), flows.packing_fraction, chosen.get("activation", "midpoint"), target_error
        )
        least = int(np.argmin(steps))
        chosen["timestep"] = float(two_digits(steps[least], up=False))
        words.append(f"timestep {chosen['timestep']:g} / shear rate, set by {_point(flows, least)}")
    if isinstance(tolerance, str) and tolerance == "auto":
        tolerance = float(two_digits(automatic_tolerance(target_error), up=False))
        words.append(f"tolerance {tolerance:g}")
    if tolerance is not None:
        chosen["solver"] = replace(solver, tolerance=tolerance)
    aim = f"{target_error:g} from the time step" if error is None else f"{error:g}"
    return chosen, f"{'; '.join(words)}: for an error of {aim} in the stresses." if words else ""


def _temperature(flows: ShearFlow) -> np.ndarray:
    """Expected granular temperature of each flow, in mσ²/t²."""
    theory = predicted(flows).granular_temperature
    return expected_temperature(theory, flows.packing_fraction, flows.shear_rate)


def _point(flows: ShearFlow, k: int) -> str:
    """Flow ``k`` of a batch in words."""
    alpha, nu = (float(np.asarray(x)[k]) for x in (flows.restitution, flows.packing_fraction))
    return f"restitution {alpha:g} and packing fraction {nu:g}"
