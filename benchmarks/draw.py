"""Figures of committed results, drawn again without a measurement: ``python -m benchmarks draw``.

The picture of a single flow (``flow``) keeps no result, so its benchmark draws it.
"""

from collections.abc import Callable, Sequence

import pandas as pd
from matplotlib.figure import Figure

from benchmarks import (
    dissipation,
    paper,
    reference_figure,
    scaling,
    size_figures,
    stability,
    timestep_study,
    validation,
)
from benchmarks.output import RESULTS, Output
from benchmarks.pages import read
from benchmarks.peers import chart
from jaxgran.maps.results import open_map
from jaxgran.reference.table import shipped_table
from jaxgran.theory.corrected_shear import MEASURED_LAWS

PICTURES: dict[str, Callable[[], Figure]] = {
    "dissipation": lambda: dissipation.draw(
        *(pd.DataFrame(read("dissipation")[name]) for name in ("points", "judged_points")),
        MEASURED_LAWS,
    ),
    "size_study": lambda: size_figures.draw_sizes(read("size_study")["flows"]),
    "size_study_waves": lambda: size_figures.draw_waves(read("size_study")["flows"]),
    "reference": lambda: reference_figure.draw(shipped_table()),
    "scaling": lambda: scaling.draw(read("scaling"), read("scaling")["exponents"]),
    "speed_vs_accuracy": lambda: chart.draw(read("speed_vs_accuracy")),
    "stability": lambda: stability.draw(read("stability")["rows"]),
    "timestep_study": lambda: timestep_study.draw(read("timestep_study")["flows"]),
    "validation": lambda: validation.draw(read("validation")["rows"]),
    **{
        f"paper_{name}": lambda draw=draw: draw(open_map(RESULTS / "paper.nc"))
        for name, draw in paper.FIGURES.items()
    },
}


def redraw(names: Sequence[str]) -> None:
    """Write the pictures of these names, or all."""
    if unknown := [name for name in names if name not in PICTURES]:
        raise SystemExit(f"draw: there is no {unknown[0]}; there are {', '.join(PICTURES)}.")
    output = Output(RESULTS, quick=False, hardware={})
    for name in names or PICTURES:
        output.write_picture(PICTURES[name](), name)
        print(output.path(name, ".png"), flush=True)
