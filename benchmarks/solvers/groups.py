"""What the problems of the collection are put together by, and what is said of each group."""

from collections.abc import Sequence

import numpy as np

from benchmarks.solvers.measure import Row

FLOWS = ("flow", "sheared")
SMALL, MEDIUM = 30, 300  # contacts
FLOW_GROUPS = (
    f"flows, up to {SMALL} contacts",
    f"flows, {SMALL + 1} to {MEDIUM}",
    f"flows, more than {MEDIUM}",
)
CONSTRUCTED = ("static packing", "chain", "size ratio 10", "mass ratio 10000", "hexagonal cluster")
INFEASIBLE = "no solution"
OUTCOMES = ("ok", "missed", "slow", "skipped")
GROUPS = (*FLOW_GROUPS, *CONSTRUCTED, INFEASIBLE)


def group_of(row: Row) -> str:
    """The group of a problem: its family; flows by their size."""
    if row.target == 0:
        return INFEASIBLE
    if row.family not in FLOWS:
        return row.family
    return FLOW_GROUPS[(row.contacts > SMALL) + (row.contacts > MEDIUM)]


def cost(row: Row, of: str = "seconds") -> float:
    """A cost, infinite for a failure."""
    return getattr(row, of) if row.outcome == "ok" else np.inf


def grouped(rows: Sequence[Row]) -> dict[tuple[str, str, float], list[Row]]:
    """Rows by group, solver and target."""
    members: dict[tuple[str, str, float], list[Row]] = {}
    for row in rows:
        members.setdefault((group_of(row), row.solver, row.target), []).append(row)
    return members


def median(costs: Sequence[float]) -> float:
    """Of an even number the larger one, so that a half of failures is a failure."""
    return sorted(costs)[len(costs) // 2]


def summary(rows: Sequence[Row]) -> list[dict]:
    """Of each group, solver and target: how many are solved, on how many none is faster, and
    medians of the costs.

    A median is null where the median solve fails. Errors are the worst of those that are solved.
    """
    lines, best = [], fastest(rows)
    for (group, solver, target), members in grouped(rows).items():
        line = {"group": group, "solver": solver, "target": target, "problems": len(members)}
        line |= {outcome: sum(row.outcome == outcome for row in members) for outcome in OUTCOMES}
        line["fastest"] = sum(best[row.problem, target] == solver for row in members)
        for key in ("seconds", "iterations"):
            line[key] = _rounded(median([cost(row, key) for row in members]))
        for key in ("residual", "velocity_error", "stress_error"):
            values = [getattr(row, key) for row in members if row.outcome == "ok"]
            line[f"worst_{key}"] = _rounded(max(values)) if values else None
        lines.append(line)
    return lines


def fastest(rows: Sequence[Row]) -> dict[tuple[str, float], str | None]:
    """The solver that is fastest on each problem, to each target; None where all fail."""
    best: dict[tuple[str, float], Row] = {}
    for row in rows:
        key = row.problem, row.target
        if key not in best or cost(row) < cost(best[key]):
            best[key] = row
    return {key: row.solver if row.outcome == "ok" else None for key, row in best.items()}


def _rounded(value: float) -> float | None:
    return float(f"{value:.3g}") if np.isfinite(value) else None


def table(rows: Sequence[Row], targets: Sequence[float] = (1e-4, 1e-8), shown: int = 3) -> str:
    """Who is best where: the fastest solvers of each group, with median microseconds and what they
    solve of it.
    """
    members, lines = grouped(rows), []
    for group in GROUPS:
        for target in (0.0,) if group == INFEASIBLE else targets:
            rows_of = {
                key[1]: each
                for key, each in members.items()
                if key[0] == group and key[2] == target
            }
            if not rows_of:
                continue
            ranked = sorted(rows_of, key=lambda name: median([cost(row) for row in rows_of[name]]))
            cells = [table_cell(name, rows_of[name]) for name in ranked[:shown]]
            lines.append(f"| {group} | {target:.0e} | " + " | ".join(cells) + " |")
    head = "| problems | residual | " + " | ".join(f"{n + 1}." for n in range(shown)) + " |"
    return "\n".join([head, "| --- " * (shown + 2) + "|", *lines])


def table_cell(name: str, members: Sequence[Row]) -> str:
    """A solver with its median time, and the share that it solves unless that is all."""
    time, solved = (
        median([cost(row) for row in members]),
        sum(row.outcome == "ok" for row in members),
    )
    share = "" if solved == len(members) else f", {solved} of {len(members)}"
    return f"{name}: {1e6 * time:.3g} µs{share}" if np.isfinite(time) else f"{name}: –{share}"
