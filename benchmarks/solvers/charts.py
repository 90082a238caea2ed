"""The figure of the contact solvers: median time to a residual in each group of problems."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.profiles import STYLES
from benchmarks.solvers.groups import CONSTRUCTED, FLOW_GROUPS
from benchmarks.solvers.measure import LIMIT
from jaxgran.plotting.drawing import scientific

DRAWN = (
    *("numba engine", "barzilai-borwein", "Gauss–Seidel"),
    *("Pinocchio PGS", "Pinocchio ADMM", "ProxQP", "OSQP", "Clarabel", "PIQP", "SciPy NNLS"),
)


def draw_times(summary: Sequence[Mapping[str, Any]], targets: Sequence[float] = (1e-4, 1e-8)) -> Figure:
    """Median times by group of problems, a panel for each residual.

    Args:
      summary: lines of ``groups.summary``; a group or a solver may be absent.
      targets: the residuals.
    """
    figure = Figure(figsize=(6.7, 4.2), layout="constrained")
    groups = (*FLOW_GROUPS, *CONSTRUCTED)
    panels = figure.subplots(1, len(targets), sharex=True, sharey=True)
    for axes, target in zip(panels, targets, strict=True):
        seconds = {(row["solver"], row["group"]): row["seconds"] for row in summary if row["target"] == target}
        for name in DRAWN:
            colour, marker, _ = STYLES[name]
            times = np.array([seconds.get((name, group)) for group in groups], float)
            ours = name == DRAWN[0]
            style = {"color": colour, "marker": marker, "linestyle": "none", "ms": 6 if ours else 4.5}
            axes.plot(1e3 * times, range(len(groups)), label=name, **style, mfc=colour if ours else "none")
        axes.set(xscale="log", xlim=(1e-3, 1e3 * LIMIT))
        axes.set_title(f"to a residual of ${scientific(target)}$", fontsize=9)
        axes.set_xlabel("median time of a solve (ms)", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.grid(alpha=0.3)
    panels[0].set_yticks(range(len(groups)), groups)
    panels[0].invert_yaxis()
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=7, frameon=False
    )
    return figure
