"""What accuracy of a contact solve costs, by method: products with W and wall time against residual and against errors.

Every method solves every network of ``networks.collection`` to every tolerance, in float64 and float32. Errors are
those of the stress moment Σ l n⊗n p and of the force ratio Σ p / Σ p_binary of the solve, against the exact solution.
A solve that ends with a bad status is a failure; it is counted and drawn, never left out. Times are those of the solve
in a compiled loop on one core, without compilation; Gauss–Seidel is a loop in numba.
"""

import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.exact_contacts import Exact, exact
from benchmarks.gauss_seidel import gauss_seidel
from benchmarks.networks import INFEASIBLE, Network, collection
from benchmarks.output import Output
from benchmarks.profiles import draw_shares
from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import Solution, solve
from jaxgran.model.status import Status

CAP, QUICK_CAP = 5000, 2000  # products with W
RELAXATION = {"jacobi": 1.8, "jacobi-count": 1.8, "jacobi-diagonal": 1.0}
METHODS = {  # name: colour, marker, line style
    "nesterov": ("black", "o", "-"),
    "barzilai-borwein": ("tab:red", "s", "--"),
    "jacobi": ("tab:blue", "^", "-."),
    "jacobi-count": ("tab:cyan", "v", ":"),
    "jacobi-diagonal": ("tab:gray", "X", (0, (1, 3))),
    "Gauss–Seidel": ("tab:orange", "D", (0, (6, 2, 1, 2, 1, 2))),
}
TOLERANCES = {"float64": tuple(10.0**-k for k in range(1, 11)), "float32": tuple(10.0**-k for k in range(1, 6))}
_CONSTRUCTED = ("chains", "size ratio 10", "mass ratio 10⁴", "hexagonal cluster", INFEASIBLE)
_QUICK_FLOAT32 = ("nesterov", "Gauss–Seidel")
_SHORTEST_TIMING, _MOST_SOLVES = 2e-3, 200  # seconds of one timing, and solves in it


class Row(NamedTuple):
    """One solve: of a network of a group, by a method, in a precision, to a tolerance.

    ``residual``, ``stress_error`` and ``force_ratio_error`` are relative and computed in float64; the errors are not a
    number where there is no exact solution. ``products`` and ``seconds`` are those until the solve ended.
    """

    group: str
    network: int
    precision: str
    method: str
    tolerance: float
    products: int
    seconds: float
    residual: float
    stress_error: float
    force_ratio_error: float
    status: int


def chart(output: Output) -> None:
    """Measure, print the table of median products, and write ``methods.json`` and its figures."""
    rows = measured(collection(output.quick), output.quick)
    print(table(rows))
    head = {"cap": QUICK_CAP if output.quick else CAP, "relaxation": RELAXATION}
    lines = summary(rows)
    output.write_rows("methods", head, "summary", lines)
    write_charts(output, lines)
    output.write_picture(draw_profile(rows), "methods", "_profile.png")


def write_charts(output: Output, lines: list[dict]) -> None:
    """Write the charts of the lines of ``methods.json``."""
    flows = [group for group in dict.fromkeys(line["group"] for line in lines) if group not in _CONSTRUCTED]
    solvable = [group for group in _CONSTRUCTED if group != INFEASIBLE]
    for name, groups, precision in (
        ("", flows, "float64"),
        ("_constructed", solvable, "float64"),
        ("_float32", flows, "float32"),
    ):
        output.write_picture(draw(lines, groups, precision), "methods", f"{name}.png")


def measured(networks: dict[str, list[Network]], quick: bool) -> list[Row]:
    """All solves. The iterates do not depend on the tolerance, so after a failure at a tolerance the finer ones fail
    alike and are not repeated."""
    rows = []
    for group, members in networks.items():
        for number, network in enumerate(members):
            reference = exact(network.contacts, network.masses)
            for precision, tolerances in TOLERANCES.items():
                if quick:
                    tolerances = tolerances[1:8:2] if precision == "float64" else tolerances[3:4]
                for method in METHODS:
                    if quick and precision == "float32" and method not in _QUICK_FLOAT32:
                        continue
                    rows += _rows(group, number, network, reference, precision, method, tolerances, quick)
    return rows


def _rows(
    group: str,
    number: int,
    network: Network,
    reference: Exact,
    precision: str,
    method: str,
    tolerances: Iterable[float],
    quick: bool,
) -> list[Row]:
    contacts, rows = _cast(network.contacts, precision), []
    for tolerance in tolerances:
        if rows and rows[-1].status != Status.ok:
            rows.append(rows[-1]._replace(tolerance=tolerance))
            continue
        same = partial(_solver(method), contacts, network.grains, tolerance, QUICK_CAP if quick else CAP)
        seconds, solution = timed(same, 1 if quick else 3)
        rows.append(
            Row(
                group,
                number,
                precision,
                method,
                tolerance,
                int(solution.iterations),
                seconds,
                *errors(network.contacts, network.grains, np.asarray(solution.impulses, float), reference),
                int(solution.status),
            )
        )
    return rows


def _cast(contacts: Contacts, precision: str) -> Contacts:
    return jax.tree.map(lambda x: x.astype(precision) if x.dtype == float else x, contacts)


Repeated = Callable[[int], Solution]  # the same solve so many times over


def _solver(method: str) -> Callable[[Contacts, int, float, int, int], Solution]:
    return _swept if method == "Gauss–Seidel" else partial(_iterated, method)


def _swept(contacts: Contacts, grains: int, tolerance: float, cap: int, repeats: int) -> Solution:
    for _ in range(max(1, repeats)):
        solution = gauss_seidel(contacts, grains, tolerance, cap)
    return solution


def _iterated(method: str, contacts: Contacts, grains: int, tolerance: float, cap: int, repeats: int) -> Solution:
    kind = contacts.normals.dtype
    numbers = jnp.asarray(tolerance, kind), jnp.asarray(RELAXATION.get(method, 1.0), kind)
    return jax.block_until_ready(_compiled(contacts, grains, method, *numbers, jnp.int32(cap), jnp.int32(repeats)))


@partial(jax.jit, static_argnums=(1, 2))
def _compiled(
    contacts: Contacts,
    grains: int,
    method: str,
    tolerance: jax.Array,
    relaxation: jax.Array,
    cap: jax.Array,
    repeats: jax.Array,
) -> Solution:
    """The last of several equal solves; a barrier keeps the compiler from doing only one."""

    def once(_: jax.Array, last: tuple[Contacts, Solution]) -> tuple[Contacts, Solution]:
        same, _ = lax.optimization_barrier(last)
        return same, solve(same, grains, 1.0, tolerance, cap, relaxation, method, jnp.asarray(True))

    shapes = jax.eval_shape(lambda: once(jnp.int32(0), (contacts, jnp.int32(0)))[1])
    start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return lax.fori_loop(0, repeats, once, (contacts, start))[1]


def timed(solve_repeatedly: Repeated, timings: int) -> tuple[float, Solution]:
    """Median seconds of a solve, over several timings of as many solves as make one long enough, and its solution."""
    solve_repeatedly(0)  # compiles
    start = time.perf_counter()
    solution = solve_repeatedly(1)
    once = time.perf_counter() - start
    if once > 10 * _SHORTEST_TIMING:
        return once, solution
    repeats = int(np.clip(_SHORTEST_TIMING / once, 1, _MOST_SOLVES))
    seconds = []
    for _ in range(timings):
        start = time.perf_counter()
        solve_repeatedly(repeats)
        seconds.append((time.perf_counter() - start) / repeats)
    return float(np.median(seconds)), solution


def errors(contacts: Contacts, grains: int, impulses: np.ndarray, reference: Exact) -> tuple[float, float, float]:
    """Relative residual, and relative errors of the stress moment and of the force ratio, in float64.

    The binary impulses are the same for both solutions, so the error of the force ratio is that of Σ p.
    """
    i, j, normals, distances, approach, inverse_i, inverse_j, used = (np.asarray(x) for x in vars(contacts).values())
    kicks = np.zeros((grains, 2))
    np.add.at(kicks, i, (impulses * inverse_i)[:, None] * normals)
    np.add.at(kicks, j, -(impulses * inverse_j)[:, None] * normals)
    after = np.sum(normals * (kicks[i] - kicks[j]), axis=1) + approach
    least = np.minimum((inverse_i + inverse_j) * impulses, after)[used]
    residual = np.linalg.norm(least) / np.linalg.norm(np.minimum(approach, 0))
    if not reference.feasible:
        return float(residual), np.nan, np.nan
    moment, true = (np.einsum("c,ca,cb", p * distances, normals, normals) for p in (impulses, reference.impulses))
    stress = np.linalg.norm(moment - true) / np.linalg.norm(true)
    return float(residual), float(stress), float(abs(np.sum(impulses) / np.sum(reference.impulses) - 1))


def summary(rows: list[Row]) -> list[dict]:
    """Median and worst over the networks of a group; a failure counts as infinitely dear, written as null."""
    lines = []
    for (group, precision, method, tolerance), members in _grouped(rows).items():
        line = {"group": group, "precision": precision, "method": method, "tolerance": float(f"{tolerance:.0e}")}
        line["networks"] = len(members)
        line["statuses"] = {
            status.name: count for status in Status if (count := sum(row.status == status for row in members))
        }
        for name in ("products", "seconds"):
            line[name] = {"median": _rounded(_cost(members, name)), "worst": _rounded(_cost(members, name, max))}
        for name in ("residual", "stress_error", "force_ratio_error"):
            values = [getattr(row, name) for row in members]
            line[name] = {"median": _rounded(np.median(values)), "worst": _rounded(np.max(values))}
        lines.append(line)
    return lines


def _grouped(rows: list[Row]) -> dict[tuple[str, str, str, float], list[Row]]:
    groups: dict[tuple[str, str, str, float], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.group, row.precision, row.method, row.tolerance), []).append(row)
    return groups


def _cost(rows: list[Row], name: str, statistic: Callable = np.median) -> float:
    """Median (of an even number the larger) or worst cost, infinite for a failure."""
    costs = sorted(getattr(row, name) if row.status == Status.ok else np.inf for row in rows)
    return costs[-1] if statistic is max else costs[len(costs) // 2]


def _rounded(value: float) -> float | None:
    return float(f"{value:.3g}") if np.isfinite(value) else None


def table(rows: list[Row], tolerances: tuple[float, float] = (1e-4, 1e-6)) -> str:
    """Median products, and milliseconds, to two tolerances in float64; – where the median solve fails."""
    groups = _grouped([row for row in rows if row.precision == "float64"])
    names = list(dict.fromkeys(row.group for row in rows))
    # Half of the groups of a quick run lack one of the tolerances: those nearest to the two are shown.
    present = sorted({key[3] for key in groups}, key=np.log)
    shown = [min(present, key=lambda have: abs(np.log(have / wanted))) for wanted in tolerances]
    lines = [f"median products to {shown[0]:.0e} / {shown[1]:.0e} (milliseconds to the first), float64"]
    lines += [f"{'':22s}" + "".join(f"{method:>26s}" for method in METHODS)]
    for name in names:
        cells = []
        for method in METHODS:
            counts = [_cost(groups[name, "float64", method, tolerance], "products") for tolerance in shown]
            seconds = _cost(groups[name, "float64", method, shown[0]], "seconds")
            words = ["–" if np.isinf(count) else f"{count:.0f}" for count in counts]
            cells.append(f"{'/'.join(words)} ({'–' if np.isinf(seconds) else f'{1e3 * seconds:.3g}'})")
        lines.append(f"{name:22s}" + "".join(f"{cell:>26s}" for cell in cells))
    flagged = {
        method: sum(row.status == Status.infeasible for row in groups[INFEASIBLE, "float64", method, present[0]])
        for method in METHODS
    }
    total = len(groups[INFEASIBLE, "float64", "nesterov", present[0]])
    lines.append(f"infeasible networks of {total} that are flagged so: {flagged}")
    return "\n".join(lines)


_COLUMNS = (
    ("residual", "products", "relative residual", "products with W"),
    ("stress_error", "seconds", "relative error of the stress moment", "time of a solve (ms)"),
)


def draw(lines: list[dict], groups: list[str], precision: str) -> Figure:
    """A row of panels for each group: cost against accuracy, by method, from the lines of ``summary``.

    Markers are medians over the networks, thin lines reach up to the worst. Above the grey line: failures, a marker
    where the median solve fails, a dash where only some do.
    """
    figure = Figure(figsize=(7.5, 2.4 * len(groups) + 1.2), layout="constrained")
    panels = figure.subplots(len(groups), len(_COLUMNS), squeeze=False)
    for group, line in zip(groups, panels, strict=True):
        solves = [one for one in lines if (one["group"], one["precision"]) == (group, precision)]
        for axes, (accuracy, cost, x_label, y_label) in zip(line, _COLUMNS, strict=True):
            _draw_panel(axes, solves, accuracy, cost)
            axes.set_ylabel(y_label)
            if group == groups[-1]:
                axes.set_xlabel(x_label)
        line[0].set_title(group, loc="left", fontsize="medium", fontweight="bold")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    figure.supxlabel(
        f"{precision}; markers: median over the networks of a group; thin lines: up to the worst;\n"
        "above the grey line: failures (a dash where only some networks of the group fail)",
        fontsize="medium",
    )
    return figure


def _draw_panel(axes: Axes, solves: list[dict], accuracy: str, cost: str) -> None:
    unit = 1e3 if cost == "seconds" else 1.0
    failed = 4 * unit * max(value for one in solves for value in one[cost].values() if value is not None)
    axes.set(xscale="log", yscale="log")
    axes.axhline(failed / 2, color="0.6", lw=0.8)
    floor = 1e-16
    for place, (method, (colour, marker, style)) in enumerate(METHODS.items()):
        lines = [one for one in solves if one["method"] == method]
        tolerance = np.array([one["tolerance"] for one in lines])
        medians, worst = (
            np.array([np.inf if one[cost][which] is None else unit * one[cost][which] for one in lines])
            for which in ("median", "worst")
        )
        reached = np.array([one[accuracy]["median"] for one in lines], float)
        reached = np.where(np.isfinite(medians) | (accuracy != "residual"), np.maximum(reached, floor), tolerance)
        # Diverged impulses may have any error: they are drawn at the edge of the panel.
        reached = np.clip(np.nan_to_num(reached, nan=10.0), floor, 10.0)
        at = failed * 1.5 ** (place - 2.5)
        ends = np.where(np.isfinite(worst), worst, at)
        options = {"color": colour, "marker": marker, "ms": 5, "markerfacecolor": "none"}
        good = np.isfinite(medians)
        axes.plot(reached[good], medians[good], linestyle=style, lw=1.3, label=method, **options)
        axes.vlines(reached[good], medians[good], ends[good], color=colour, lw=0.5)
        some = good & ~np.isfinite(worst)
        axes.plot(reached[some], np.full(np.sum(some), at), color=colour, marker="_", linestyle="none", ms=6)
        axes.plot(reached[~good], np.full(np.sum(~good), at), linestyle="none", **options)
    axes.invert_xaxis()
    axes.text(0.01, 0.99, "failed", transform=axes.transAxes, va="top", fontsize="x-small", color="0.4")
    axes.set_ylim(top=failed * 12)
    axes.grid(alpha=0.3)


def draw_profile(rows: list[Row]) -> Figure:
    """Share of all solvable networks that a method solves within a factor of the cost of the best, see ``profiles``."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    solves = [row for row in rows if row.precision == "float64" and row.group != INFEASIBLE]
    present = sorted({row.tolerance for row in solves}, key=np.log)
    panels = figure.subplots(2, 2, sharey=True)
    for line, wanted in zip(panels, (1e-4, 1e-8), strict=True):
        tolerance = min(present, key=lambda have: abs(np.log(have / wanted)))
        for axes, name in zip(line, ("products", "seconds"), strict=True):
            costs = {
                method: np.array(
                    [
                        getattr(row, name) if row.status == Status.ok else np.inf
                        for row in solves
                        if (row.method, row.tolerance) == (method, tolerance)
                    ]
                )
                for method in METHODS
            }
            draw_shares(axes, costs, METHODS)
            axes.set_title(f"to a residual of {tolerance:.0e}")
            axes.set_xlabel("products over those of the best" if name == "products" else "time over that of the best")
        line[0].set_ylabel(f"share of {len(costs['nesterov'])} networks")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure
