"""Performance profiles: the share of problems that a solver solves within a factor of the cost of the best.

Dolan and Moré, Math. Program. 91, 201 (2002). A curve that stays below one has failures.
"""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

LARGEST_FACTOR = 1e3
Style = tuple  # colour, marker, line style
STYLES: dict[str, Style] = {  # of the solvers that are known; full lines are those of this program
    "numba engine": ("black", "o", "-"),
    "barzilai-borwein": ("tab:red", "s", "-"),
    "nesterov": ("tab:orange", "^", "-"),
    "jacobi": ("tab:brown", "v", "-"),
    "jacobi-count": ("rosybrown", "<", "-"),
    "jacobi-diagonal": ("tab:gray", "X", "-"),
    "Gauss–Seidel": ("gold", "D", "-"),
    "Pinocchio PGS": ("yellowgreen", "D", "--"),
    "Pinocchio ADMM": ("tab:green", "P", "--"),
    "ProxQP": ("tab:blue", "h", "--"),
    "OSQP": ("tab:cyan", "p", "--"),
    "Clarabel": ("tab:purple", "*", "--"),
    "PIQP": ("magenta", ">", "--"),
    "SciPy NNLS": ("teal", "d", "-."),
}
_EXTRA_COLOURS = ("tab:purple", "tab:green", "tab:brown", "tab:pink", "tab:olive", "navy")
_EXTRA_MARKERS = ("P", "*", "<", ">", "p", "h")


def with_styles(names: list[str], styles: Mapping[str, Style]) -> dict[str, Style]:
    """The style of each name: the known one, or for a solver from elsewhere the next that is free."""
    extra = [name for name in names if name not in styles]
    count = len(_EXTRA_COLOURS)
    new = {name: (_EXTRA_COLOURS[k % count], _EXTRA_MARKERS[k % count], "-") for k, name in enumerate(extra)}
    return {name: styles.get(name, new.get(name)) for name in names}


def draw_shares(axes: Axes, costs: Mapping[str, np.ndarray], styles: Mapping[str, Style]) -> None:
    """A curve for each solver.

    Args:
      costs: by solver, (problems,) in one order; infinite where it fails.
      styles: by solver; see ``with_styles``.
    """
    best = np.min(list(costs.values()), axis=0)
    solved = np.isfinite(best)
    for name, (colour, marker, line) in styles.items():
        factors = np.sort(costs[name][solved] / best[solved])
        finite = factors[np.isfinite(factors)]
        x = np.append(finite, np.max(finite, initial=LARGEST_FACTOR))
        y = np.append(np.arange(1, len(finite) + 1), len(finite)) / len(best)
        options = {"markerfacecolor": "none", "markevery": max(1, len(x) // 8), "ms": 6}
        axes.step(x, y, where="post", color=colour, marker=marker, linestyle=line, label=name, **options)
    axes.set(xscale="log", xlim=(0.95, LARGEST_FACTOR), ylim=(0, 1.02))
    axes.grid(alpha=0.3)
