"""Observables of the user's in a map: their sums, and what identifies their function."""

from dataclasses import replace

import jax

from jaxgran.maps.settings import MapSettings
from jaxgran.sampling.observe import digest_of, observed_shapes

_REFERENCE = {"restitution": 0.5, "packing_fraction": 0.5, "timestep": 1e-3}
"""Flow for the hash of an observable, which maps of other axes have in common."""


def sums_by_name(settings: MapSettings) -> dict[str, jax.ShapeDtypeStruct] | None:
    """Shape and dtype of the sums of each of the user's observables; None without any."""
    if settings.observe is None:
        return None
    return observed_shapes(settings.observe, settings.flow_at(settings.points[0]))


def identity_of(settings: MapSettings) -> str | None:
    """What is compared before a map is continued or replaced: names and ``digest_of`` the function;
    None without one.

    So a function may move to another module, and what it calls counts too.
    """
    if settings.observe is None:
        return None
    flow = replace(settings.flow_at(settings.points[0]), **_REFERENCE)
    return f"{', '.join(sums_by_name(settings) or ())}: {digest_of(settings.observe, flow)}"
