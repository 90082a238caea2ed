"""MapSettings: all parameters that the numbers of a ratio map depend on, checked before the run."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from jaxgran.dynamics.engine import select_engine
from jaxgran.model.checks import InputError, require_number, require_whole, shown, two_digits
from jaxgran.model.choices import MAX_REPLICAS, MAX_STEPS, SHORTEST_TIMESTEP, Activation, Engine, Solver
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.batch import stack
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.timestep import automatic_timestep, automatic_tolerance, expected_temperature, longest_timestep

_FEWEST_STEPS = 160  # of a sample: five time steps in each of its 32 blocks
_LONGEST_EQUILIBRATION = 1e6  # strain before the sample
_ACCEPTED_TIMESTEP = 1e-6  # 1/γ̇; all flows accept it


@dataclass(frozen=True)
class MapSettings:
    """All parameters that the numbers of a map depend on; see ``ratio_map`` for their meaning."""

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    grains: int = 256
    seeds: int = 2
    timestep: float | tuple[float, ...] = 1e-3
    equilibrate: float | None = None
    strain: float = 10.0
    error: float | None = None
    tolerance: float = 1e-4
    solver: Solver = "barzilai-borwein"
    activation: Activation = "midpoint"
    engine: Engine = "auto"

    def __post_init__(self):
        for name, values in self.axes.items():
            if not isinstance(values, tuple) or len(values) > MAX_REPLICAS:
                raise InputError(f"{name} must be a list of at most {MAX_REPLICAS} numbers, not {shown(values)}.")
            if len(values) == 0:
                raise InputError(f"{name} must be a list of at least one number, and it is empty.")
            if not all(
                isinstance(x, (int, float, np.integer, np.floating)) and not isinstance(x, bool) for x in values
            ):
                raise InputError(f"{name} must be a list of numbers, not {shown(values)}.")
            if len(set(values)) < len(values) or (
                list(values) != sorted(values) and list(values) != sorted(values)[::-1]
            ):
                raise InputError(f"{name} must be sorted and without repetition, not {shown(list(values))}.")
        require_whole("seeds", self.seeds, 1, MAX_REPLICAS, "the most replicas of a map")
        count = math.prod(map(len, self.axes.values())) * self.seeds
        if count > MAX_REPLICAS:
            raise InputError(f"a map must have at most {MAX_REPLICAS} replicas, points times seeds, not {count}.")
        require_number("strain", self.strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
        if self.error is not None:
            require_number("error", self.error, lambda x: (x >= 1e-3) & (x <= 0.5), "between 1e-3 and 0.5")
        if self.equilibrate is not None:
            most, words = _LONGEST_EQUILIBRATION, f"a number of at least 0 and at most {_LONGEST_EQUILIBRATION:g}"
            require_number("equilibrate", self.equilibrate, lambda x: (x >= 0) & (x <= most), words)
        if not isinstance(self.timestep, tuple):
            require_number("timestep", self.timestep, lambda x: x > 0, "a positive number")
        require_number("tolerance", self.tolerance, lambda x: x > 0, "between 1e-12 and 0.1")
        flows = stack(self._checked_flows())
        if self.engine != "auto":
            select_engine(flows)
        shortest, longest = min(self._timesteps), max(self._timesteps)
        if shortest < SHORTEST_TIMESTEP:
            raise InputError(
                f"timestep must be at least {SHORTEST_TIMESTEP:g} / shear rate, or the steps of a run would be too "
                f"many to count, not {shortest:g}."
            )
        if self.strain > MAX_STEPS * shortest:
            raise InputError(
                f"strain must be at most {MAX_STEPS} time steps, that is {MAX_STEPS * shortest:g}, not {self.strain:g}."
            )
        limits = longest_timestep(_temperature(flows), flows.packing_fraction, self.activation)
        excess = np.asarray(flows.timestep) / limits
        worst = int(np.argmax(excess))
        if excess[worst] > 1:
            raise InputError(
                f"timestep must be at most {two_digits(limits[worst], up=False)} at {_point(flows, worst)}, or grains "
                "would overlap deeply; auto chooses one."
            )
        if round(self.strain / longest) < _FEWEST_STEPS:
            raise InputError(
                f"strain must be at least {_FEWEST_STEPS} time steps, that is {_FEWEST_STEPS * longest:g}, "
                f"not {self.strain:g}."
            )

    @property
    def axes(self) -> dict[str, tuple[float, ...]]:
        """Values of the dimensions of a map by name, outermost first; ``timestep`` is one of them if it is a list."""
        steps = {"timestep": self.timestep} if isinstance(self.timestep, tuple) else {}
        return {**steps, "packing_fraction": self.packing_fraction, "restitution": self.restitution}

    @property
    def _timesteps(self) -> tuple[float, ...]:
        return self.timestep if isinstance(self.timestep, tuple) else (self.timestep,)

    def flows(self) -> list[ShearFlow]:
        """One flow for each point, in the order of ``axes``: the last one changes fastest."""
        return list(_flows(self))

    def _checked_flows(self) -> list[ShearFlow]:
        """New flows for all points; InputError if a number is out of range."""
        return [
            ShearFlow(
                grains=self.grains,
                restitution=alpha,
                packing_fraction=nu,
                timestep=dt,
                tolerance=self.tolerance,
                solver=self.solver,
                activation=self.activation,
                engine=self.engine,
            )
            for dt in self._timesteps
            for nu in self.packing_fraction
            for alpha in self.restitution
        ]


@lru_cache(maxsize=4)
def _flows(settings: MapSettings) -> tuple[ShearFlow, ...]:
    """The flows of a map, kept for its batches: a map of thousands of points has hundreds of batches."""
    return tuple(settings._checked_flows())


def automatic(choices: Mapping[str, Any], target_error: float) -> tuple[dict[str, Any], str]:
    """The parameters of a map with numbers in place of "auto", and a sentence about these numbers, or "".

    Args:
      choices: keyword arguments of ``MapSettings``; ``timestep`` and ``tolerance`` may be "auto".
      target_error: largest accepted relative error of pressure and shear stress.
    """
    require_number("target_error", target_error, lambda x: (x >= 1e-4) & (x <= 0.1), "between 1e-4 and 0.1")
    chosen, words = dict(choices), []
    auto = {name for name in ("timestep", "tolerance") if isinstance(chosen.get(name), str) and chosen[name] == "auto"}
    if "timestep" in auto:
        flows = stack(
            MapSettings(**{**chosen, "timestep": _ACCEPTED_TIMESTEP, "tolerance": 1e-4, "strain": 1.0}).flows()
        )
        steps = automatic_timestep(
            _temperature(flows), flows.packing_fraction, chosen.get("activation", "midpoint"), target_error
        )
        least = int(np.argmin(steps))
        chosen["timestep"] = float(two_digits(steps[least], up=False))
        words.append(f"timestep {chosen['timestep']:g} / shear rate, set by {_point(flows, least)}")
    if "tolerance" in auto:
        chosen["tolerance"] = float(two_digits(automatic_tolerance(target_error), up=False))
        words.append(f"tolerance {chosen['tolerance']:g}")
    return chosen, f"{'; '.join(words)}: for an error of {target_error:g} in the stresses." if words else ""


def _temperature(flows: ShearFlow) -> np.ndarray:
    """Expected granular temperature of each flow, in mσ²/t²."""
    theory = predicted(flows).granular_temperature
    return expected_temperature(theory, flows.packing_fraction, flows.shear_rate)


def _point(flows: ShearFlow, k: int) -> str:
    """Flow ``k`` of a batch in words."""
    alpha, nu = (float(np.asarray(x)[k]) for x in (flows.restitution, flows.packing_fraction))
    return f"restitution {alpha:g} and packing fraction {nu:g}"
