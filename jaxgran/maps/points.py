"""The points of a map: their dimensions, and the averages of the replicas of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.settings_checks import stack_of_any_size
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.status import GIVEN_UP
from jaxgran.sampling.correlation_strain import mass_of_grains
from jaxgran.sampling.drift import is_drifting
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.sample import (
    Sample,
    correlation_strains,
    estimates,
    lengths,
)


@dataclass(frozen=True)
class PointGrid:
    """The dimensions of a point, outermost first, their sizes, and the flow of each point."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    flows: Sequence[ShearFlow] = ()
    classes: Grains | None = None  # (points, grains) in the proportions of given diameters

    @classmethod
    def of(cls, settings: MapSettings) -> "PointGrid":
        """The grid of a map."""
        flows, shape = settings.flows(), tuple(map(len, settings.axes.values()))
        return cls(tuple(settings.axes), shape, flows, settings.size_classes(len(flows)))

    @cached_property
    def batch(self) -> ShearFlow:
        """The flows as one batch, for what does not depend on their numbers of grains."""
        return stack_of_any_size(self.flows)

    @property
    def grains(self) -> np.ndarray:
        """The number of grains of every point."""
        return np.array([flow.grains for flow in self.flows])

    def variable(self, values: np.ndarray, attrs: Mapping[str, Any], *further: str) -> xr.Variable:
        """A variable of values (points, ...) in the order of ``flows``; ``further`` are its last
        dims.
        """
        return xr.Variable(
            (*self.dims, *further), values.reshape(*self.shape, *values.shape[1:]), dict(attrs)
        )


class PointAverages(NamedTuple):
    """Averages over the seeds of each point that were not given up, in the order of
    ``settings.flows()``, or NaN.

    ============================  ==============  ==================================================
    values, stderrs               (points, ...)   each observable and its standard error, by name
    correlation_strain            (points,)       strain over which the flow is correlated
    observable_correlation        (points,)       strain of one independent sample, for averages of
                                                  scalars, by name
    drifting                      (points,)       whether the averages still change
    samples                       by point        samples of these seeds
    ============================  ==============  ==================================================
    """

    values: dict[str, np.ndarray]
    stderrs: dict[str, np.ndarray]
    correlation_strain: np.ndarray
    observable_correlation: dict[str, np.ndarray]
    drifting: np.ndarray
    samples: dict[int, Sequence[Sample]]


def point_averages(settings: MapSettings, replicas: Mapping[Key, Replica | None]) -> PointAverages:
    """The averages of every point over its replicas that were not given up."""
    flows = settings.flows()
    count = len(flows)
    scalars = [name for name, row in OBSERVABLES.items() if not (row.extreme or row.tensor)]
    averages = PointAverages(
        values={name: np.full((count, *row.shape), np.nan) for name, row in OBSERVABLES.items()},
        stderrs={name: np.full((count, *row.shape), np.nan) for name, row in OBSERVABLES.items()},
        correlation_strain=np.full(count, np.nan),
        observable_correlation={name: np.full(count, np.nan) for name in scalars},
        drifting=np.zeros(count, bool),
        samples=_samples(settings, replicas),
    )
    for point, samples in averages.samples.items():
        flow = flows[point]
        values, stderrs = estimates(samples)
        for name in OBSERVABLES:
            averages.values[name][point] = values[name]
            averages.stderrs[name][point] = stderrs[name]
        _, correlation_time = lengths(samples)
        strain = correlation_time * float(flow.shear_rate)
        averages.correlation_strain[point] = strain
        averages.drifting[point] = is_drifting(samples, strain)
        independent = correlation_strains(samples)
        for name in scalars:
            averages.observable_correlation[name][point] = independent[name]
    return averages


def _samples(
    settings: MapSettings, replicas: Mapping[Key, Replica | None]
) -> dict[int, Sequence[Sample]]:
    """The samples of each point that has any, in the order of the seeds, without those that were
    given up.
    """
    by_point: dict[int, Sequence[Sample]] = {}
    for point, flow in enumerate(settings.flows()):
        seeds = [replicas.get((point, seed)) for seed in range(settings.seeds)]
        samples = [
            replace(x.sample, mass=mass_of_grains(flow.packing_fraction, x.sample.area))
            for x in seeds
            if x is not None and x.status < GIVEN_UP
        ]  # the same bits whether the replicas have run or were read
        if samples:
            by_point[point] = samples
    return by_point
