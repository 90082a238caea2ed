"""MapSettings: everything that decides the numbers of a ratio map, validated before anything runs."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxgran.accuracy import automatic_timestep, automatic_tolerance, expected_temperature, longest_timestep
from jaxgran.batch import stack
from jaxgran.flow import Activation, InputError, ShearFlow, Solver, require, two_digits
from jaxgran.protocol import predicted

_FEWEST_STEPS = 160  # five time steps in each block of a sample
_SHORT = 1e-6  # a time step that all flows accept


@dataclass(frozen=True)
class MapSettings:
    """Everything that decides the numbers of a map; see ``ratio_map`` for the meaning of each."""

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

    def __post_init__(self):
        for name, values in self.axes.items():
            if len(values) == 0:
                raise InputError(f"{name} must be a list of at least one number, and it is empty.")
            require(name, np.asarray(values), lambda x: x.ndim == 1, "a list of numbers")
            if len(set(values)) < len(values) or (
                list(values) != sorted(values) and list(values) != sorted(values)[::-1]
            ):
                raise InputError(f"{name} must be sorted and without repetition, not {list(values)}.")
        if isinstance(self.seeds, bool) or not isinstance(self.seeds, (int, np.integer)) or self.seeds < 1:
            raise InputError(f"seeds must be a whole number of at least 1, not {self.seeds!r}.")
        require("strain", self.strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
        if self.error is not None:
            require("error", self.error, lambda x: (x >= 1e-3) & (x <= 0.5), "between 1e-3 and 0.5")
        if self.equilibrate is not None:
            require("equilibrate", self.equilibrate, lambda x: (x >= 0) & np.isfinite(x), "a number of at least 0")
        flows = stack(self.flows())
        limits = longest_timestep(_temperature(flows), flows.packing_fraction, self.activation)
        excess = np.asarray(flows.timestep) / limits
        worst = int(np.argmax(excess))
        if excess[worst] > 1:
            raise InputError(
                f"timestep must be at most {two_digits(limits[worst], up=False)} at {_point(flows, worst)}, or grains "
                "would overlap deeply; auto chooses one."
            )
        longest = max(self._timesteps)
        if round(self.strain / longest) < _FEWEST_STEPS:
            raise InputError(
                f"strain must be at least {_FEWEST_STEPS} time steps, that is {_FEWEST_STEPS * longest:g}, "
                f"not {self.strain:g}."
            )

    @property
    def axes(self) -> dict[str, tuple[float, ...]]:
        """Values of the dimensions of a map by name, the slowest first; the time step is one where it is a list."""
        steps = {"timestep": self.timestep} if isinstance(self.timestep, tuple) else {}
        return {**steps, "packing_fraction": self.packing_fraction, "restitution": self.restitution}

    @property
    def _timesteps(self) -> tuple[float, ...]:
        return self.timestep if isinstance(self.timestep, tuple) else (self.timestep,)

    def flows(self) -> list[ShearFlow]:
        """One flow a point, in the order of ``axes``; raises ValueError where a number is out of range."""
        return [
            ShearFlow(
                grains=self.grains,
                restitution=alpha,
                packing_fraction=nu,
                timestep=dt,
                tolerance=self.tolerance,
                solver=self.solver,
                activation=self.activation,
            )
            for dt in self._timesteps
            for nu in self.packing_fraction
            for alpha in self.restitution
        ]


def automatic(choices: Mapping[str, Any], target_error: float) -> tuple[dict[str, Any], str]:
    """The choices of a map with numbers in place of "auto", and what was chosen in words, empty if nothing was.

    Args:
      choices: keyword arguments of ``MapSettings``, in which ``timestep`` and ``tolerance`` may be "auto".
      target_error: relative error of pressure and shear stress to stay within.
    """
    require("target_error", target_error, lambda x: (x >= 1e-4) & (x <= 0.1), "between 1e-4 and 0.1")
    chosen, words = dict(choices), []
    if chosen.get("timestep") == "auto":
        flows = stack(MapSettings(**{**chosen, "timestep": _SHORT, "tolerance": 1e-4, "strain": 1.0}).flows())
        steps = automatic_timestep(_temperature(flows), flows.packing_fraction, flows.activation, target_error)
        least = int(np.argmin(steps))
        chosen["timestep"] = float(two_digits(steps[least], up=False))
        words.append(f"timestep {chosen['timestep']:g} / shear rate, set by {_point(flows, least)}")
    if chosen.get("tolerance") == "auto":
        chosen["tolerance"] = float(two_digits(automatic_tolerance(target_error), up=False))
        words.append(f"tolerance {chosen['tolerance']:g}")
    return chosen, f"{'; '.join(words)}: for an error of {target_error:g} in the stresses." if words else ""


def _temperature(flows: ShearFlow) -> np.ndarray:
    theory = predicted(flows).granular_temperature
    return expected_temperature(theory, flows.packing_fraction, flows.shear_rate)


def _point(flows: ShearFlow, k: int) -> str:
    alpha, nu = (float(np.asarray(x)[k]) for x in (flows.restitution, flows.packing_fraction))
    return f"restitution {alpha:g} and packing fraction {nu:g}"
