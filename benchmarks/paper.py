"""The map of the paper: the force ratio over the plane of restitution and packing fraction, N =
1000, dt = 1e-5.

The same as ``jaxgran map --preset paper``: curves and contours of the ratio, errors of kinetic
theory and their factors, and the dataset with all values.

    python -m benchmarks paper            # 20 minutes on two cores
    python -m benchmarks paper --quick    # a plane of 3 × 3 points, 64 grains, dt = 5e-4
"""

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.results import write_dataset
from jaxgran.plotting.factors import enskog_factors
from jaxgran.plotting.ratio import ratio_contours, ratio_curves
from jaxgran.plotting.style import FILE_DPI, write
from jaxgran.plotting.theory import theory_errors

QUICK = {"restitution": (0.1, 0.5, 0.9), "packing_fraction": (0.5, 0.7, 0.8)}
QUICK |= {"grains": 64, "seeds": 1, "timestep": 5e-4, "equilibrate": 1.0, "strain": 2.0}
FIGURES = {
    "curves": ratio_curves,
    "contours": ratio_contours,
    "theory": theory_errors,
    "factors": enskog_factors,
}


def run(output: Output) -> None:
    """Map, and write the dataset and its main figures."""
    data = jg.ratio_map(
        **QUICK if output.quick else PRESETS["paper"], snapshots=True, workers=usable_cores()
    )
    data.attrs |= {"command": "python -m benchmarks paper", "commit": output.hardware["commit"]}
    write_dataset(data, output.path("paper", ".nc"))
    for name, draw in FIGURES.items():
        write(draw(data), output.path("paper", f"_{name}.png"), FILE_DPI, False)
