"""The presets: parameters that a map starts from, by name."""

from typing import Any

PRESETS: dict[str, dict[str, Any]] = {
    "quick": {
        "restitution": (0.2, 0.35, 0.5, 0.65, 0.8),
        "packing_fraction": (0.5, 0.6, 0.65, 0.7, 0.75, 0.79),
        "grains": 256,
        "seeds": 2,
        "timestep": 1e-3,
    },
    "paper": {
        "restitution": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.98),
        "packing_fraction": (0.1, 0.2, 0.3, 0.4, 0.5, 0.56, 0.6, 0.65, 0.7, 0.75, 0.8, 0.82),
        "grains": 1000,
        "seeds": 1,
        "timestep": 1e-5,
    },
    "dense": {
        "restitution": (0.2, 0.5),
        "packing_fraction": (0.79, 0.8, 0.805, 0.81, 0.815, 0.82, 0.825, 0.83),
        "grains": 1000,
        "seeds": 1,
        "timestep": 1e-4,
        "strain": 16.0,
    },
}
