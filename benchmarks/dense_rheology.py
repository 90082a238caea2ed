"""The friction law of dense flows: macroscopic friction and packing fraction against the inertial number, with fits.

python -m benchmarks dense_rheology            # 3 minutes on two cores
python -m benchmarks dense_rheology --quick    # two restitutions, 256 grains, half the strain
"""

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.plotting.friction import friction_figure

FULL = PRESETS["quick"] | {
    "restitution": (0.2, 0.5, 0.8),
    "packing_fraction": (0.7, 0.73, 0.75, 0.77, 0.785, 0.795, 0.805, 0.815),
    "grains": 400,
    "timestep": 5e-4,
}
QUICK = FULL | {"restitution": (0.2, 0.5), "packing_fraction": (0.75, 0.77, 0.785, 0.795), "grains": 256, "strain": 4.0}


def run(output: Output) -> None:
    """Map, and draw the friction law."""
    data = jg.ratio_map(**QUICK if output.quick else FULL, workers=usable_cores())
    output.write_picture(friction_figure(data), "dense", "_rheology.png", dpi=200)
