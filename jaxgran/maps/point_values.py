"""What is known of the points of a map, from its settings and replicas."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any

import jax
import numpy as np

from jaxgran.maps.points import PointAverages, PointGrid, point_averages
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.seeds import NOT_RUN, replica_statuses, seed_strains, worst_status
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import first_of_points, state_values
from jaxgran.maps.sums import sum_variables
from jaxgran.model.status import Status
from jaxgran.sampling.budget import Estimate, large_system
from jaxgran.sampling.enskog_factors import measured_over_enskog
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.sampling.sample import ERROR_OBSERVABLES

_LARGEST = 1e12  # a prediction above it has no steady state


@dataclass(frozen=True)
class PointValues:
    """Values (points, ...) in the order of ``settings.flows()``, each computed once."""

    settings: MapSettings
    replicas: Mapping[Key, Replica | None]
    fewer_seeds: bool = False  # whether points may have fewer seeds than others

    @cached_property
    def grid(self) -> PointGrid:
        return PointGrid.of(self.settings)

    @cached_property
    def averages(self) -> PointAverages:
        return point_averages(self.settings, self.replicas)

    @cached_property
    def statuses(self) -> np.ndarray:
        """Of each seed, (points, seeds)."""
        return replica_statuses(self.settings, self.replicas)

    @property
    def status(self) -> np.ndarray:
        """The worst of all seeds, and of their samples together.

        An ``error`` is that of all seeds together, so that one imprecise seed does not count.
        """
        pooled = (self.statuses == Status.imprecise) & (self.settings.error is not None)
        worst = worst_status(np.where(pooled, Status.ok, self.statuses), self.fewer_seeds)
        drifting = np.where(self.averages.drifting, Status.not_steady, NOT_RUN)
        imprecise = np.where(self._is_imprecise, Status.imprecise, NOT_RUN)
        return np.maximum.reduce([worst, drifting, imprecise]).astype(np.int8)

    @property
    def _is_imprecise(self) -> np.ndarray:
        """Whether an average of a large system has a larger error than the requested one."""
        if self.settings.error is None:
            return np.zeros(len(self.grid.flows), bool)
        wanted = (self.large_system[name] for name in ERROR_OBSERVABLES)
        return np.any([x.total > self.settings.error * np.abs(x.value) for x in wanted], axis=0)

    @cached_property
    def large_system(self) -> dict[str, Estimate]:
        """The averages of a large system, with the errors by source."""
        flows = self.grid.batch
        return large_system(
            self.averages.values,
            self.averages.stderrs,
            flows.restitution,
            flows.packing_fraction,
            self.grid.grains,
            flows.timestep,
            self.settings.solver.tolerance,
        )

    @cached_property
    def strains(self) -> tuple[np.ndarray, np.ndarray]:
        """The sampled strain of each seed and that before the sample, (points, seeds)."""
        return seed_strains(self.settings, self.replicas)

    @cached_property
    def sums(self) -> dict[str, np.ndarray]:
        return sum_variables(self.settings, self.grid, self.replicas)

    @cached_property
    def states(self) -> dict[str, np.ndarray]:
        """The last states; none unless the map has ``snapshots``."""
        if not self.settings.snapshots:
            return {}
        return state_values(len(self.grid.flows), first_of_points(self.replicas))

    def prediction(self, name: str) -> np.ndarray:
        """Of kinetic theory; NaN where it has no steady state, as at α = 1."""
        values = getattr(self._kinetic_theory, name)
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(values) & (values < _LARGEST), values, np.nan)

    @cached_property
    def _kinetic_theory(self) -> Any:
        flows = self.grid.batch
        return kinetic_theory(
            flows.restitution,
            flows.packing_fraction,
            flows.shear_rate,
            flows.polydispersity,
            self.grid.classes,
        )

    @cached_property
    def over_enskog(self) -> tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]:
        """Values and standard errors by the names of ``measured_over_enskog``."""
        grid = self.grid
        values, stderrs = (_columns(len(grid.flows)) for _ in range(2))
        for point, samples in self.averages.samples.items():
            grains = None if grid.classes is None else jax.tree.map(itemgetter(point), grid.classes)
            value, stderr = measured_over_enskog(grid.flows[point], samples, grains)
            for name in value:
                values[name][point], stderrs[name][point] = value[name], stderr[name]
        return values, stderrs


def _columns(points: int) -> defaultdict[str, np.ndarray]:
    """Columns by name, NaN at every point."""
    return defaultdict(lambda: np.full(points, np.nan))
