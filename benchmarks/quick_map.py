"""The curves of the map that ``jaxgran map`` makes when it is given no option.

python -m benchmarks quick_map            # half a minute on two cores
python -m benchmarks quick_map --quick    # 64 grains, one seed
"""

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.presets import PRESETS
from jaxgran.plotting.ratio import ratio_curves

SMALLER = {"grains": 64, "seeds": 1, "strain": 2.0}


def run(output: Output) -> None:
    """Map, and draw both ratios against the packing fraction."""
    data = jg.ratio_map(**PRESETS["quick"] | (SMALLER if output.quick else {}), workers=usable_cores())
    output.write_picture(ratio_curves(data), "quick", "_curves.png")
