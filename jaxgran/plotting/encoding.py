"""What figures, movies and pages draw alike: levels of contours, and the colours and widths of
grains and forces.
"""

import numpy as np

EXCESS_LEVELS = (0.05, 0.10, 0.25, 0.50, 1.00)
"""Contour values of the excess of the force ratio over one, as in Figure 2."""

GRAIN_RAMPS = {
    "speed": ["#ffffff", "#cfe4f0", "#8fbfd9"],
    "pressure": ["#ffffff", "#fbe3c0", "#eeb46c"],
}
GRAIN_EDGE = "#8c8c8c"
CLUSTER_COLOUR = "#1a1a1a"
BINARY_COLOUR = "#e0552f"
COLOUR_SHARE = 0.98  # of the grains below the deepest colour
WIDTH_SHARE = 0.95  # of the forces below the widest bar


def deepest(values: np.ndarray) -> float:
    """The speed or pressure of the deepest colour."""
    return _quantile(values[values > 0], COLOUR_SHARE)


def widest(forces: np.ndarray) -> float:
    """The force of the widest bar."""
    return _quantile(forces, WIDTH_SHARE)


def _quantile(values: np.ndarray, share: float) -> float:
    """The value below which a share of the values lies, or one if there are no values."""
    return float(np.quantile(values, share)) if values.size else 1.0
