"""Grains and forces at one instant as a page reads them: small whole numbers, enough for a
picture.
"""

import base64
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgran.plotting.encoding import (
    BINARY_COLOUR,
    CLUSTER_COLOUR,
    GRAIN_EDGE,
    GRAIN_RAMPS,
    THINNEST_LINE,
    WIDEST_LINE,
    deepest,
    widest,
)

MOST_GRAINS = 2**16  # of a picture: their numbers have two bytes
ENCODING = {
    "ramp": GRAIN_RAMPS["speed"],
    "edge": GRAIN_EDGE,
    "cluster": CLUSTER_COLOUR,
    "binary": BINARY_COLOUR,
    "thinnest": THINNEST_LINE,
    "widest": WIDEST_LINE,
}


class Scale(NamedTuple):
    """The speed of the deepest colour, in σγ̇, and the force of the widest line, in mσγ̇²."""

    speed: float
    force: float


def scale_of(speed: np.ndarray, force: np.ndarray) -> Scale:
    """The scale of pictures with these speeds and forces."""
    return Scale(deepest(speed), widest(force))


def grain_data(
    positions: Float[np.ndarray, "grains 2"],
    radii: Float[np.ndarray, " grains"],
    speed: Float[np.ndarray, " grains"],
    pairs: Int[np.ndarray, "pairs 2"],
    force: Float[np.ndarray, " pairs"],
    clustered: Bool[np.ndarray, " pairs"],
    side: float,
    tilt: float,
    scale: Scale,
) -> dict[str, Any]:
    """One instant for a page; the arguments are those of a ``ForceNetwork``, and a scale.

    ``data`` has, one after the other and in base64: x and y of the grains in parts of 65536 of the
    cell, with the tilt taken off x; both grains of each pair (16 bits each); radii, speeds and
    forces in parts of 255 of the largest radius and of the scale; and whether a pair is in a
    cluster (8 bits each).
    """
    largest = float(radii.max())
    x, y = positions.T / side
    cell = np.floor(np.stack([x - tilt * y, y]) % 1 * 65536)
    shares = [radii / largest, speed / scale.speed, force / scale.force]
    parts = [
        *(part.astype("<u2") for part in (*cell, *pairs.T)),
        *(np.round(255 * np.clip(share, 0, 1)).astype(np.uint8) for share in shares),
        clustered.astype(np.uint8),
    ]
    numbers = {"side": side, "tilt": tilt, "radius": largest, **scale._asdict()}
    return {
        "grains": len(radii),
        "pairs": len(force),
        **{name: float(f"{number:.6g}") for name, number in numbers.items()},
        "data": base64.b64encode(b"".join(part.tobytes() for part in parts)).decode(),
    }
