"""A made-up map for pages."""

from functools import cache

import numpy as np
import xarray as xr
from synthetic import random_replica, random_state

from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status

MARKUP = (
    '<script>window.hacked = 1</script><img src=x onerror="window.hacked = 2">&amp; <b>bold</b>'
)
"""An attribute that would run as a script, if it were markup."""


@cache
def page_map() -> xr.DataTree:
    """A map of 2 × 2 × 3 points: one is bad, one was not run; names and attributes hold markup."""
    plane, numbers = ((0.5, 0.7, 0.9), (0.5, 0.6)), {"grains": 64, "seeds": 2, "strain": 2.0}
    settings = MapSettings(*plane, **numbers, timestep=(1e-3, 5e-4), snapshots=True)
    rng, results = np.random.default_rng(0), []
    for point in range(len(settings.points)):
        status = Status.deep_overlap if point == 7 else Status.ok
        if point != 8:
            state = random_state(point, 64)
            first = random_replica(rng, settings, status, point)
            results.append(first._replace(state=state))
            results.append(random_replica(rng, settings, status, point, 1))
    data = map_dataset(settings, results, {"title": MARKUP})
    own = data.force_ratio.assign_attrs(long_name=MARKUP, units="<i>σ</i>") ** 2
    data["own <u>name</u>"] = own.assign_attrs(long_name=MARKUP, units="<i>σ</i>")
    return data
