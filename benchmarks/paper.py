"""The map of the paper: the force ratio over the plane of restitution and packing fraction, N = 1000, dt = 1e-5.

The same as ``jaxgran map --preset paper``: contours and curves of the ratio, errors of kinetic theory, the share of
clusters, and the dataset with all numbers.

    python -m benchmarks paper            # half an hour on two cores
    python -m benchmarks paper --quick    # a plane of 3 × 3 points, 64 grains, dt = 5e-4
"""

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.results import write_dataset
from jaxgran.plotting.map_figures import save_figures

QUICK = {"restitution": (0.1, 0.5, 0.9), "packing_fraction": (0.5, 0.7, 0.8)}
QUICK |= {"grains": 64, "seeds": 1, "timestep": 5e-4, "equilibrate": 1.0, "strain": 2.0}


def run(output: Output) -> None:
    """Map, and write the dataset and all figures that a map has."""
    data = jg.ratio_map(**QUICK if output.quick else PRESETS["paper"], snapshots=True, workers=usable_cores())
    data.attrs |= {"command": "python -m benchmarks paper", "commit": output.hardware["commit"]}
    write_dataset(data, output.path("paper", ".nc"))
    save_figures(data, output.path("paper", ""))
