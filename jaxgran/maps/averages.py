"""The columns of a map: what is measured at each point, by the paths of ``VARIABLES``, from the
replicas of its row.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxgran.maps.replica import Replica
from jaxgran.maps.schema import path_of
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.settings_checks import stack_of_any_size
from jaxgran.maps.variables import NOT_RUN, PREDICTED, SCALARS, VARIABLES
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import GIVEN_UP, Status
from jaxgran.sampling.budget import LARGE_SYSTEM, Estimate, large_system
from jaxgran.sampling.correlation_strain import mass_of_grains
from jaxgran.sampling.drift import is_drifting
from jaxgran.sampling.enskog_factors import LENGTHS, measured_over_enskog
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.prediction import kinetic_theory
from jaxgran.sampling.sample import (
    ERROR_OBSERVABLES,
    Sample,
    correlation_strains,
    estimates,
    lengths,
)
from jaxgran.theory.assumptions import ASSUMPTIONS

Seeds = Sequence[Replica | None]  # of a point, in order; None for one that has not run
_LARGEST = 1e12  # a prediction above it has no steady state
_SIZES = {"axis_a": 2, "axis_b": 2, "observable": len(SCALARS)}
_OVER_ENSKOG = {
    "theory/enskog_pressure": "enskog_pressure",
    **{f"theory/enskog_factor_pressure_{name}": f"pressure_{name}" for name in ASSUMPTIONS},
    **{f"theory/{name}": name for name in LENGTHS},
}


def samples_of(flow: ShearFlow, seeds: Seeds) -> list[Sample]:
    """The samples of a point that were not given up.

    Their mass follows from the area, so that samples that were read have the same bits as those
    that have just been taken.
    """
    samples = (x.sample for x in seeds if x is not None and x.status < GIVEN_UP)
    return [
        replace(sample, mass=mass_of_grains(flow.packing_fraction, sample.area))
        for sample in samples
        if sample is not None
    ]


def columns(
    settings: MapSettings,
    samples: Sequence[Sequence[Sample]],
    replicas: Sequence[Seeds],
    fewer_seeds: bool,
) -> dict[str, np.ndarray]:
    """All that is known of the points of a map, (points, ...), but their sums and states.

    Args:
      settings: the map.
      samples: those of each point.
      replicas: those of each point.
      fewer_seeds: whether points may have fewer seeds than others, and are measured then.
    """
    discs = settings.discs
    rows = [
        _measured(flow, measured, discs) if measured else {}
        for flow, measured in zip(settings.flows.values(), samples, strict=True)
    ]
    known = _in_columns(rows)
    drifting = np.array([row.get("drifting", False) for row in rows])
    large = _large_system(settings, known)
    of_seeds = np.array([_worst(seeds, settings, fewer_seeds) for seeds in replicas])
    found = {Status.not_steady: drifting, Status.imprecise: _is_imprecise(settings, large)}
    of_points = [np.where(true, status, NOT_RUN) for status, true in found.items()]
    known["status"] = np.maximum.reduce([of_seeds, *of_points]).astype(np.int8)
    for name, estimate in large.items():
        known[f"{name}_large_system"] = estimate.value
        known[f"{name}_large_system_ci95"] = np.stack(
            [estimate.total, *estimate.sources.values()], axis=-1
        )
    return known | _predicted(settings)


def _measured(flow: ShearFlow, samples: Sequence[Sample], grains: Any) -> dict[str, Any]:
    """The averages of one point over its samples, with their errors, and whether they drift."""
    values, stderrs = estimates(samples)
    _, correlation_time = lengths(samples)
    strain = correlation_time * float(flow.shear_rate)
    independent = correlation_strains(samples)
    of_enskog, of_enskog_stderr = measured_over_enskog(flow, samples, grains)
    row = {path_of(name): value for name, value in values.items()}
    row |= {f"{path_of(name)}_stderr": value for name, value in stderrs.items()}
    row |= {path: of_enskog[name] for path, name in _OVER_ENSKOG.items()}
    row |= {f"{path}_stderr": of_enskog_stderr[name] for path, name in _OVER_ENSKOG.items()}
    return row | {
        "correlation_strain": strain,
        "diagnostics/correlation_strain": np.array([independent[name] for name in SCALARS]),
        "drifting": is_drifting(samples, strain),
    }


def _in_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """The measured columns, NaN at points without a sample."""
    averages = (*map(path_of, OBSERVABLES), *_OVER_ENSKOG)
    known = {}
    for path in (*averages, "correlation_strain", "diagnostics/correlation_strain"):
        about = VARIABLES[path]
        missing = np.full([_SIZES[dim] for dim in about.dims], np.nan)
        for name in (path, f"{path}_stderr") if about.has_error else (path,):
            known[name] = np.stack([np.asarray(row.get(name, missing), float) for row in rows])
    return known


def _worst(seeds: Seeds, settings: MapSettings, fewer_seeds: bool) -> int:
    """The worst status of the seeds of a point; ``NOT_RUN`` if one is missing and the others are
    ok, or, where points may have fewer seeds than others, if all are missing.

    An ``error`` is that of all seeds together, so that one imprecise seed does not count.
    """
    statuses = [NOT_RUN if x is None else int(x.status) for x in seeds]
    if settings.error is not None:
        statuses = [Status.ok if x == Status.imprecise else x for x in statuses]
    worst = max(statuses)
    missing = min(statuses) == NOT_RUN and not fewer_seeds
    return NOT_RUN if missing and worst <= Status.ok else worst


def _large_system(settings: MapSettings, known: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """The averages of a large system, with the errors by source."""
    grains, timestep, packing_fraction, restitution = map(
        np.array, zip(*settings.points, strict=True)
    )
    return large_system(
        {name: known[path_of(name)] for name in OBSERVABLES},
        {name: known[f"{path_of(name)}_stderr"] for name in LARGE_SYSTEM},
        restitution,
        packing_fraction,
        grains,
        timestep,
        settings.solver.tolerance,
    )


def _is_imprecise(settings: MapSettings, large: Mapping[str, Estimate]) -> np.ndarray:
    """Whether an average of a large system has a larger error than the requested one."""
    if settings.error is None:
        return np.zeros(len(settings.points), bool)
    wanted = (large[name] for name in ERROR_OBSERVABLES)
    return np.any([x.total > settings.error * np.abs(x.value) for x in wanted], axis=0)


def _predicted(settings: MapSettings) -> dict[str, np.ndarray]:
    """What kinetic theory predicts; NaN where it has no steady state, as at α = 1."""
    flows = stack_of_any_size(settings.flows.values())
    theory = kinetic_theory(
        flows.restitution,
        flows.packing_fraction,
        flows.shear_rate,
        flows.polydispersity,
        settings.discs,
    )
    known = {name: getattr(theory, name) for name in PREDICTED}
    with np.errstate(invalid="ignore"):
        return {
            f"theory/{name}": np.where(np.isfinite(x) & (x < _LARGEST), x, np.nan)
            for name, x in known.items()
        }
