"""The picture of grains and forces of ``flow_figure`` in small whole numbers, for a page."""

import base64
from typing import Any

import numpy as np
from matplotlib.colors import to_hex

from jaxgran.analysis.contacts import ForceNetwork
from jaxgran.plotting import flow

MOST_GRAINS = 2**16
"""Grains of a picture on a page."""

PARTS = 2**14
"""Parts of the side of the window, the unit of lengths on a page."""

ENCODING = {
    "ramp": [to_hex(flow.SPEED_COLOURS(share)) for share in np.linspace(0, 1, 64)],
    "edge": flow.GRAIN_EDGE,
    "bars": [flow.BINARY_COLOUR, flow.CLUSTER_COLOUR],
    "parts": PARTS,
}


def grain_data(network: ForceNetwork) -> dict[str, Any]:
    """The grains and bars in the window of a picture, and its caption.

    ``grains`` has x, y, radii and numbers of colours, one after the other; ``bars`` has x and y of
    the middles, those of half the branches, widths, and whether a bar is in a cluster. Both are
    numbers of 16 bits in base64; lengths are in 16384 parts of the side.
    """
    scale, unit = flow.common_scale([network]), PARTS / network.side
    grains, centres = flow.grain_images(network)
    shares = np.clip(network.speed[grains] / scale.speed, 0, 1) * (len(ENCODING["ramp"]) - 1)
    pairs, middles, along, widths = flow.bar_images(network, scale.force)
    bars = [*middles.T * unit, *along.T * unit, widths * unit, network.clustered[pairs]]
    return {
        "grains": _packed([*centres.T * unit, network.radii[grains] * unit, shares]),
        "bars": _packed(bars),
        "caption": "Black: forces within clusters of three or more grains. Red: binary collisions. "
        f"The widest bar is a force of {scale.force:.2g} mσγ̇² or more; all are those of one time "
        f"step. Blue: peculiar speed, deepest from {scale.speed:.2g} σγ̇. "
        f"The window is {network.side:.3g} σ wide.",
    }


def _packed(columns: list[np.ndarray]) -> str:
    return base64.b64encode(np.round(columns).astype("<i2").tobytes()).decode()
