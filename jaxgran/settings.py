"""MapSettings: everything that decides the numbers of a ratio map, validated before anything runs."""

from dataclasses import dataclass

import numpy as np

from jaxgran.flow import Activation, InputError, ShearFlow, Solver, require
from jaxgran.protocol import check_timestep, predicted, stack

_FEWEST_STEPS = 160  # ten time steps in each block of a sample


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
        if self.equilibrate is not None:
            require("equilibrate", self.equilibrate, lambda x: (x >= 0) & np.isfinite(x), "a number of at least 0")
        flows = stack(self.flows())
        check_timestep(flows, predicted(flows))
        longest = max(flow.timestep for flow in self.flows())
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

    def flows(self) -> list[ShearFlow]:
        """One flow a point, in the order of ``axes``; raises ValueError where a number is out of range."""
        timesteps = self.timestep if isinstance(self.timestep, tuple) else (self.timestep,)
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
            for dt in timesteps
            for nu in self.packing_fraction
            for alpha in self.restitution
        ]
