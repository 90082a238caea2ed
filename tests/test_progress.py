"""Progress of a map: the share of its work that is done, and the time that the rest takes."""

from typing import Any

import numpy as np
import pytest

from jaxgran.maps.automatic import chosen_settings
from jaxgran.maps.batches import predicted_cost
from jaxgran.maps.progress import Meter
from jaxgran.maps.replica import Advance

MAP: dict[str, Any] = {
    "restitution": (0.2, 0.9),
    "packing_fraction": (0.8,),
    "grains": 64,
    "timestep": 1e-4,
}
SETTINGS, _ = chosen_settings({**MAP, "seeds": 2, "strain": 4.0, "equilibrate": 1.0})


def shares(meter: Meter) -> tuple[str, str]:
    """Points that are done, and the share of the work."""
    share, points, *_ = meter._line().split(", ")
    return points, share


def test_a_map_whose_points_are_all_unfinished_has_done_a_part_of_its_work() -> None:
    meter = Meter(SETTINGS, quiet=True)
    assert (
        shares(meter) == ("0/2 points", "0 % of the work done")
        and "unknown time left" in meter._line()
    )
    keys = [(0, 0), (0, 1), (1, 0), (1, 1)]
    for timestep, strain in ((1e-3, 1.0), (1e-4, 0.5), (1e-4, 2.0)):
        meter.advanced(Advance(keys, np.full(4, timestep), np.full(4, strain / timestep)))
    coarse, fine = (predicted_cost(SETTINGS.flows()[0], timestep) for timestep in (1e-3, 1e-4))
    expected = (coarse + 2.5 * fine) / (coarse + 4.5 * fine)
    assert shares(meter) == ("0/2 points", f"{100 * expected:.0f} % of the work done")
    assert meter.done_steps == pytest.approx(4 * 26_000)


def test_work_before_a_replica_is_finished_counts_up_to_its_expected_cost() -> None:
    meter = Meter(SETTINGS, quiet=True)
    meter.advanced(Advance([(0, 0)], [1e-4], [100]))
    assert "unknown time left" in meter._line()  # most of it was compilation
    for _ in range(100):
        meter.advanced(Advance([(0, 0)], [1e-4], [10_000]))
    assert "unknown time" not in meter._line()
    cost = meter.costs[0] / meter.total
    assert shares(meter) == ("0/2 points", f"{95 * cost:.0f} % of the work done")
    meter.finished((0, 0))
    meter.finished((0, 1))
    assert shares(meter) == ("1/2 points", f"{200 * cost:.0f} % of the work done")
