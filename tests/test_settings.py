"""Mistakes in the parameters of a map are sentences that name the range, before it runs."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import refused

import jaxgran as jg
from jaxgran.cli.map import MAP_OPTIONS
from jaxgran.contact.projected_methods import Jacobi
from jaxgran.dynamics.batch import predicted_cost, stack
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.automatic import (
    PREPARED,
    SECONDS,
    cheapest,
    chosen_settings,
    expected_scatter,
    plans_of_sizes,
    sampling_targets,
)
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.settings import OPTIONS, MapSettings
from jaxgran.maps.start import with_start
from jaxgran.model.checks import InputError
from jaxgran.sampling.budget import SIZE_LAWS
from jaxgran.sampling.timestep import COARSE_TIMESTEP

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
GOOD: dict[str, Any] = {
    "restitution": (0.5, 0.9),
    "packing_fraction": (0.6,),
    "grains": 64,
    "seeds": 2,
    "timestep": 1e-3,
    "strain": 2.0,
}


def test_a_plane_in_any_order_is_sorted_with_the_grains_of_its_points() -> None:
    mixed = {"packing_fraction": (0.7, 0.6), "restitution": (0.9, 0.1, 0.5)}
    grains = dict(zip(product((1e-3, 1e-4), *mixed.values()), range(16, 28), strict=True))
    given = {**GOOD, **mixed, "timestep": (1e-3, 1e-4), "grains_by_point": list(grains.values())}
    settings, _ = chosen(**given)
    assert settings.axes == {
        "grains": (27,),
        "timestep": (1e-3, 1e-4),
        "packing_fraction": (0.6, 0.7),
        "restitution": (0.1, 0.5, 0.9),
    }
    for flow in settings.flows.values():
        assert grains[flow.timestep, flow.packing_fraction, flow.restitution] == flow.grains


def test_grains_and_time_step_are_dimensions_where_they_have_several_values() -> None:
    one = MapSettings(**GOOD)
    some = replace(one, grains=(64, 256), timestep=(1e-3, 1e-4))
    assert one.dimensions == ("packing_fraction", "restitution")
    assert some.dimensions == ("grains", "timestep", "packing_fraction", "restitution")
    points = [tuple(getattr(flow, x) for x in some.dimensions) for flow in some.flows.values()]
    assert points == some.points == list(product(*some.axes.values()))
    assert some.points[:2] == one.points


def chosen(**parameters: Any) -> tuple[MapSettings, str]:
    return chosen_settings(parameters)


def test_the_automatic_time_step_of_several_numbers_of_grains_is_that_of_the_fewest() -> None:
    """Which jam at lower packing fractions."""
    dense = {**GOOD, "packing_fraction": (0.8,), "timestep": "auto"}
    few, many, several = (chosen(**{**dense, "grains": n}) for n in (64, 1024, (64, 1024)))
    assert several == (replace(few[0], grains=(64, 1024)), few[1])
    assert few[0].timestep[0] < 0.7 * many[0].timestep[0]


def test_the_automatic_time_step_is_the_shortest_that_a_point_needs() -> None:
    plane = {"restitution": (0.9, 0.2), "packing_fraction": (0.6, 0.82)}
    given = {**GOOD, **plane, "timestep": "auto", "grains": (64, 256), "strain": None}
    settings, sentence = chosen(**given)
    points = [dict(zip(plane, point, strict=True)) for point in product(*plane.values())]
    alone = [chosen(**{**given, **point})[0].timestep[0] for point in points]
    assert settings.timestep == (min(alone),) and len({*alone}) > 1
    assert f"timestep {min(alone):g} / shear rate" in sentence
    assert chosen(**{**given, "strain": 1e-3})[0].timestep[0] <= 1e-3 / 160


def test_automatic_choices_are_finer_for_a_smaller_error() -> None:
    given = {**GOOD, "restitution": (0.1, 0.9), "strain": None, "timestep": "auto"}
    found = [chosen(**given, error=error) for error in (0.1, 0.01, 0.001)]
    timesteps = [settings.timestep for settings, _ in found]
    assert timesteps == sorted(timesteps, reverse=True) and timesteps[-1] < timesteps[0]
    assert all("restitution 0.9 and packing fraction 0.6" in sentence for _, sentence in found)


def test_numbers_of_grains_may_be_given_by_point() -> None:
    settings, _ = chosen(**{**GOOD, "grains_by_point": [64, 128]})
    assert [point.grains for point in settings.points] == [64, 128] and settings.grains == (128,)
    for wrong in ([64], 64, [64, 8], [64, 128.5]):
        with pytest.raises(InputError, match="grains"):
            chosen(**{**GOOD, "grains_by_point": wrong})


def test_a_given_tolerance_is_that_of_the_solver() -> None:
    settings, _ = chosen(**{**GOOD, "solver": Jacobi(relaxation=1.5), "tolerance": 1e-3})
    assert settings.solver == Jacobi(tolerance=1e-3, relaxation=1.5)


def test_the_command_and_the_function_start_alike() -> None:
    """Python alone has what has no text form, the command what is of figures and terminal."""
    python_only = {"observe", "grains_by_point", "progress", "record", "attributes"}
    assert set(MAP_OPTIONS) - {"format", "json", "quiet"} == set(OPTIONS) - python_only
    assert with_start(None, None, {}) == PRESETS["quick"]
    implied = {"grains": "auto", "timestep": "auto", "seeds": 1}
    assert with_start(None, None, {"error": 0.1}).items() >= implied.items()
    assert with_start("paper", None, {"seeds": 3})["seeds"] == 3
    for wrong in (("slow", None), ("quick", "map.nc"), (None, "no.nc")):
        with refused():
            with_start(*wrong, {})


def test_an_error_chooses_grains_by_point_and_one_time_step() -> None:
    given = {"restitution": (0.2, 0.9), "packing_fraction": (0.6, 0.82), "error": 0.1, "seeds": 1}
    settings, sentence = chosen(**given, grains="auto", timestep="auto")
    flows = list(settings.flows.values())
    for flow in flows:
        law = SIZE_LAWS["pressure"]
        assert law.error(flow.restitution, flow.packing_fraction, flow.grains) < 0.1
        assert np.all(sampling_targets(settings, stack([flow])) > 0.02 / 1.96)
    assert len({flow.grains for flow in flows}) > 1
    assert f"{settings.grains[0]} grains, 1 seed" in sentence and "error of 0.1" in sentence
    assert "strains of about" in sentence and "processor time" in sentence
    assert len(settings.timestep) == 1


def test_the_chosen_grains_cost_least_of_those_that_reach_the_error() -> None:
    plane = {"restitution": (0.2, 0.6, 0.95), "packing_fraction": (0.3, 0.65, 0.8)}
    settings, _ = chosen(**plane, seeds=2, timestep=2e-4, strain=None, error=0.05, grains="auto")
    best = cheapest(settings, 0.05)
    assert settings.grains_by_point == (*best.grains.tolist(),) and min(best.grains) >= 256
    for size in (256, 512, 2048, 8192, 32768):
        other = plans_of_sizes(settings, 0.05, np.array([size]))
        assert np.all(other.seconds[:, 0] >= best.seconds * (1 - 1e-12))
        assert np.array_equal(other.seconds[:, 0] == best.seconds, best.grains == size)


def test_an_error_out_of_reach_names_the_point_and_what_helps() -> None:
    given = {"restitution": (0.9, 0.2), "packing_fraction": (0.6,), "grains": "auto"}
    with refused("is out of reach at restitution 0.2 and packing fraction 0.6") as caught:
        chosen(**given, timestep=1e-4, error=1e-3)
    assert "more seeds or a shorter time step" in str(caught.value)
    with refused("is out of reach"):  # the time step alone takes more
        chosen(**given, timestep=1.2e-3, error=2e-3)


def test_strain_and_time_of_a_plan_are_those_that_maps_took() -> None:
    """Scatter and preparation of flows that the laws were not fitted to, within a factor of two on
    average, and the processor time of their map within a factor of three.
    """
    data = jg.open_map(RESULTS / "reference_check_small.nc")
    settings = MapSettings(**from_attrs(data))
    flows = list(settings.flows.values())
    alphas, sizes = np.array([(flow.restitution, flow.grains) for flow in flows]).T
    strains = data["sums/strain"].values.reshape(len(flows), -1)
    prepared = data["sums/equilibration_strain"].values.reshape(len(flows), -1)
    correlation = data.correlation_strain.values.ravel()
    names = "pressure", "shear_stress"
    errors = [(data[f"{name}_stderr"] / data[name]).values.ravel() for name in names]
    scatter = np.max(errors, axis=0) * np.sqrt(strains.sum(axis=1) / correlation)
    logs = np.log(scatter / expected_scatter(alphas, sizes))
    assert 0.5 < np.exp(logs.mean()) < 2 and np.exp(logs.std()) < 2
    assert 0.5 < np.median(prepared / correlation[:, None]) / PREPARED < 2
    cost = sum(
        (flow.grains / 1000) ** 0.2
        * (own.sum() * predicted_cost(flow) + before.sum() * predicted_cost(flow, COARSE_TIMESTEP))
        for flow, own, before in zip(flows, strains, prepared, strict=True)
    )
    spent = data.attrs["workers"] * data.attrs["wall_time_seconds"]
    assert 1 / 3 < SECONDS * cost / spent < 3


@pytest.mark.parametrize(
    "lists", [np.linspace(0.1, 0.9, 9), [np.float32(0.3), 0.5], np.float32(0.3)], ids=str
)
def test_the_numbers_of_an_axis_are_the_decimals_that_they_stand_for(lists: Any) -> None:
    """0.30000000000000004 would be another point, of other random numbers, than 0.3."""
    settings, _ = chosen(**{**GOOD, "restitution": lists, "timestep": 3 * (1e-3 / 10)})
    assert settings.restitution == tuple(float(f"{x:.3g}") for x in np.atleast_1d(lists))
    assert 0.3 in {point.restitution for point in settings.points}
    assert settings.timestep == (3e-4,)
    with refused("without repetition"):
        chosen(**{**GOOD, "restitution": [0.3, 0.1 + 0.2]})


@pytest.mark.parametrize("kinds", [3, 4, 8])
@pytest.mark.parametrize("error", [0.11, 0.09])
def test_automatic_grains_are_as_many_of_each_diameter(kinds: int, error: float) -> None:
    flow = {"restitution": (0.2,), "packing_fraction": (0.6,), "strain": None}
    sizes = {"diameters": tuple(np.linspace(1, 1.4, kinds).tolist()), "grains": "auto"}
    settings, _ = chosen(**flow, **sizes, seeds=2, timestep=1e-3, error=error)
    assert settings.grains[0] % kinds == 0
