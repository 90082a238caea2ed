"""From times and errors to a table: what stresses within 3 % take, at equal overlaps."""

from typing import NamedTuple

OBSERVABLES = ("pressure", "shear_stress")
TARGET = 0.03
COST = "cpu_seconds_per_strain"


class Choice(NamedTuple):
    """A setting of a program, and whether its stresses are within the target."""

    row: dict
    reached: bool


def rows_of(flow: dict, curve: str) -> list[dict]:
    """The rows of a program that ran, coarse before fine."""
    return [row for row in flow["rows"] if row["curve"] == curve and "errors" in row]


def cheapest(rows: list[dict]) -> Choice | None:
    """The coarsest setting whose stresses are within the target, or the finest if none is.

    Errors change sign along a curve. So a setting that meets the target by chance, while a finer
    one misses it beyond twice its standard error, is passed over.
    """
    if not rows:
        return None
    misses = [k for k, row in enumerate(rows) if _misses(row)]
    reached = [row for row in rows[max(misses, default=-1) + 1 :] if _largest_error(row) <= TARGET]
    return Choice(reached[0], True) if reached else Choice(rows[-1], False)


def equal_work(flow: dict, curve: str) -> tuple[Choice, Choice] | None:
    """The cheapest settings of jaxgran and of another program within the target, where jaxgran's
    overlaps are no deeper than those of the other; its finest setting where all are deeper.
    """
    theirs = cheapest(rows_of(flow, curve))
    if theirs is None:
        return None
    depth = theirs.row["largest_overlap"]
    rows = rows_of(flow, "jaxgran")
    ours = cheapest([row for row in rows if row["largest_overlap"] <= depth] or rows[-1:])
    return None if ours is None else (ours, theirs)


def ratio(flow: dict, curve: str) -> str:
    """Time of another program over that of jaxgran; "> " where it does not reach the target."""
    pair = equal_work(flow, curve)
    if pair is None:
        return "–"
    ours, theirs = pair
    if not ours.reached:
        return "–"
    sign = "" if theirs.reached else "> "
    return f"{sign}{_two_digits(theirs.row[COST] / ours.row[COST])}"


def table(flows: list[dict]) -> str:
    """Markdown: for each flow the cheapest setting of each program, its microseconds for a grain
    and a unit of strain, and its time over jaxgran's at overlaps no deeper.
    """
    heads = "α, ν", "program", "setting", "µs", "over jaxgran", "error of p", "of τ", "overlap (σ)"
    lines = [f"| {' | '.join(heads)} |", "| --- |" + " --- |" * (len(heads) - 1)]
    for flow in flows:
        where = f"{flow['restitution']:g}, {flow['packing_fraction']:g}"
        for curve in ("jaxgran", "numba loop", "LAMMPS", "event-driven"):
            if all(row["curve"] != curve for row in flow["rows"]):  # it was left out
                continue
            best = cheapest(rows_of(flow, curve))
            if best is None:
                lines.append(f"| {where} | {curve} | – | {failure_of(curve)} | – | – | – | – |")
                continue
            errors = [f"{100 * e:+.1f} ± {100 * s:.1f} %" for e, s in _errors(best.row)]
            cost = _two_digits(1e6 * best.row[COST] / flow["discs"])
            over = "1" if curve == "jaxgran" else ratio(flow, curve)
            overlap = _two_digits(best.row["largest_overlap"])
            cells = where, curve, _setting(curve, best.row), cost, over, *errors, overlap
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def failure_of(curve: str) -> str:
    """What a program does of which no setting runs to the end."""
    return "collapses" if curve == "event-driven" else "fails"


def _errors(row: dict) -> list[tuple[float, float]]:
    return [row["errors"][name] for name in OBSERVABLES]


def _largest_error(row: dict) -> float:
    return max(abs(error) for error, _ in _errors(row))


def _misses(row: dict) -> bool:
    """Whether an error exceeds the target by more than twice its standard error."""
    return any(abs(error) - 2 * noise > TARGET for error, noise in _errors(row))


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):,g}"


def _setting(curve: str, row: dict) -> str:
    """The time step or the stiffness of a row."""
    if curve == "event-driven":
        return "–"
    return f"{'k' if curve == 'LAMMPS' else 'dt'} = {row['setting']:.0e}".replace(
        "e-0", "e-"
    ).replace("e+0", "e")
