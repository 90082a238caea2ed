"""What went wrong at the points of a map: sentences for the command line and for the warnings of
``ratio_map``.
"""

import math

import numpy as np

from jaxgran.maps.schema import MapData, flag_names, flattened, parts
from jaxgran.model.display import counted
from jaxgran.model.status import MEANINGS
from jaxgran.sampling.thresholds import FEWEST_CORRELATION_STRAINS

_MOST_NAMED = 6  # points of a map in one sentence


class BadPoints(UserWarning):
    """Points of a map have a bad status, or their samples are short."""


def bad_points(data: MapData) -> dict[str, list[str]]:
    """Descriptions of the points whose status is not ok, by the name of the status."""
    names = flag_names(data.status)
    bad: dict[str, list[str]] = {}
    if "part_points" in data.attrs:  # the other points are those of other parts
        in_part = np.isin(np.arange(data.status.size), data.attrs["part_points"]).reshape(
            data.status.shape
        )
        data = flattened(data).assign(
            status=data.status.where(in_part, 0).assign_attrs(data.status.attrs)
        )
    for part in parts(data):
        which = f", {part.attrs['grains']} grains" if "grains" in data.dims else ""
        which += f", time step {part.attrs['timestep']:g}" if "timestep" in data.dims else ""
        for nu in part.packing_fraction.values:
            for alpha in part.restitution.values:
                name = names[int(part.status.sel(packing_fraction=nu, restitution=alpha))]
                if name != "ok":
                    bad.setdefault(name, []).append(
                        f"(restitution {alpha:g}, packing fraction {nu:g}{which})"
                    )
    return bad


def bad_points_message(data: MapData, bad: dict[str, list[str]]) -> str:
    """How many points have a bad status, which ones, and what to do."""
    failed = sum(map(len, bad.values()))
    count = (
        "the flow" if data.status.size == 1 else f"{failed} of {counted(data.status.size, 'point')}"
    )
    parts = [f"{name.replace('_', ' ')} at {_some(points)}" for name, points in bad.items()]
    hints = [f"{name.replace('_', ' ')}: {MEANINGS[name]}" for name in bad if name in MEANINGS]
    return f"{count} failed: {'; '.join(parts)}. Meaning: {'; '.join(hints)}."


def short_samples_message(data: MapData, points: list[str]) -> str:
    """Which samples are shorter than a few correlation strains, and the strain that they need."""
    code = data.status.attrs["flag_meanings"].split().index("short_sample")
    is_short = data.status == data.status.attrs["flag_values"][code]
    enough = FEWEST_CORRELATION_STRAINS * float(data.correlation_strain.where(is_short).max())
    which = "" if data.status.size == 1 else f" at {_some(points)}"
    return (
        f"short sample{which}: less than {FEWEST_CORRELATION_STRAINS:g} correlation strains, so "
        f"its errors may be too small: it needs `strain={math.ceil(enough)}`."
    )


def _some(points: list[str]) -> str:
    """The first points of a list, and how many more there are."""
    more = len(points) - _MOST_NAMED
    return ", ".join(points[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
