"""Progress of a map: the share of its work that is done, and the time that the rest takes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.output import RESULTS
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.automatic import (
    chosen_settings,
    expected_correlation_strain,
    expected_costs,
    expected_seconds,
)
from jaxgran.maps.batches import predicted_cost, replica_ids
from jaxgran.maps.progress import Meter
from jaxgran.maps.replica import Advance
from jaxgran.maps.results import open_map
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.settings_checks import stack_of_any_size
from jaxgran.sampling.prediction import predicted

MAP: dict[str, Any] = {
    "restitution": (0.2, 0.9),
    "packing_fraction": (0.8,),
    "grains": 64,
    "timestep": 1e-4,
}
SETTINGS, _ = chosen_settings({**MAP, "seeds": 2, "strain": 4.0, "equilibrate": 1.0})
FLOW = SETTINGS.flows[SETTINGS.points[0]]


def shares(meter: Meter) -> tuple[str, str]:
    """Points that are done, and the share of the work."""
    share, points, *_ = meter._line().split(", ")
    return points, share


def test_a_map_whose_points_are_all_unfinished_has_done_a_part_of_its_work() -> None:
    meter = Meter(SETTINGS, expected_costs(SETTINGS), quiet=True)
    assert (
        shares(meter) == ("0/2 points", "0 % of the work done")
        and "unknown time left" in meter._line()
    )
    ids = replica_ids(SETTINGS)
    for timestep, strain in ((1e-3, 1.0), (1e-4, 0.5), (1e-4, 2.0)):
        meter.advanced(Advance(ids, np.full(4, timestep), np.full(4, strain / timestep)))
    coarse, fine = (predicted_cost(FLOW, timestep) for timestep in (1e-3, 1e-4))
    expected = (coarse + 2.5 * fine) / (coarse + 4.5 * fine)
    assert shares(meter) == ("0/2 points", f"{100 * expected:.0f} % of the work done")
    assert meter.done_steps == pytest.approx(4 * 26_000)


def test_the_time_that_is_left_is_known_before_anything_is_done() -> None:
    costs = expected_costs(SETTINGS)
    seconds = expected_seconds(SETTINGS, costs)
    meter = Meter(SETTINGS, costs, quiet=True, seconds=7200)
    assert meter.first_line().endswith("about 2:00:00 expected")
    assert "about 2:00:00 left" in meter._line()
    one_seed = expected_seconds(replace(SETTINGS, seeds=1), costs)
    assert 0 < seconds == pytest.approx(2 * one_seed)


def test_a_map_of_which_every_replica_was_resumed_has_no_work_left() -> None:
    """In any order of their costs, whose sums differ by rounding."""
    settings, _ = chosen_settings({**MAP, "restitution": (0.2, 0.5, 0.9), "seeds": 5})
    ids, costs = replica_ids(settings), expected_costs(settings)
    for seed in range(50):
        meter = Meter(settings, costs, quiet=True)
        meter.resumed(ids[k] for k in np.random.default_rng(seed).permutation(len(ids)))
        assert shares(meter) == ("3/3 points", "100 % of the work done")


def test_work_before_a_replica_is_finished_counts_up_to_its_expected_cost() -> None:
    meter = Meter(SETTINGS, expected_costs(SETTINGS), quiet=True)
    first, second = replica_ids(SETTINGS)[:2]
    meter.advanced(Advance([first], [1e-4], [100]))
    assert "unknown time left" in meter._line()  # most of it was compilation
    for _ in range(100):
        meter.advanced(Advance([first], [1e-4], [10_000]))
    assert "unknown time" not in meter._line()
    cost = meter.costs[first.point] / meter.total
    assert shares(meter) == ("0/2 points", f"{95 * cost:.0f} % of the work done")
    meter.finished(first)
    meter.finished(second)
    assert shares(meter) == ("1/2 points", f"{200 * cost:.0f} % of the work done")


def test_the_correlation_strain_that_a_map_expects_is_that_of_the_reference_map() -> None:
    data = open_map(RESULTS / "reference.nc").to_dataset()
    settings = MapSettings(**from_attrs(data))
    flows = stack_of_any_size(settings.flows.values())
    count = [point.grains for point in settings.points]
    ratio = (
        expected_correlation_strain(settings, flows, count) / data.correlation_strain.values.ravel()
    )
    assert ratio.max() < 1.4 and ratio.min() > 1 / 1.4
    once, twice = expected_correlation_strain(settings, flows, np.multiply([[1], [4]], count))
    assert np.all(twice <= 2 * once * (1 + 1e-12)) and np.median(twice / once) == pytest.approx(2)


def test_outside_the_reference_map_the_expected_correlation_strain_is_that_of_kinetic_theory() -> (
    None
):
    """As the density vanishes and at α → 1 the two agree: nT/τ."""
    nearly_elastic = {"restitution": (0.98, 0.99), "packing_fraction": (0.02,), "timestep": 1e-5}
    settings, _ = chosen_settings({**MAP, **nearly_elastic})
    flows = stack_of_any_size(settings.flows.values())
    theory = predicted(flows)
    number_density = 4 / np.pi * 0.02
    heating = number_density * theory.granular_temperature / theory.shear_stress
    np.testing.assert_allclose(
        expected_correlation_strain(settings, flows, [64, 64]), heating, rtol=0.1
    )
