"""From times and errors to a table: the time that an error of 3 % takes."""

import math

OBSERVABLES = ("pressure", "shear_stress")
TARGET = 0.03
COST = "cpu_seconds_per_strain"


def largest_error(row: dict, names: tuple[str, ...]) -> float:
    """The largest of some errors of a row, without sign."""
    return max(abs(row["errors"][name][0]) for name in names)


def time_to_target(rows: list[dict], names: tuple[str, ...], cost: str = COST) -> tuple[float, str]:
    """Seconds for a unit of strain at which the front of a curve falls to ``TARGET``.

    The rows stand in the order of their settings, coarse before fine. Errors change sign along a
    curve, so a row that meets the target by chance, while a finer one misses it beyond its standard
    error, is left out. The front is made of the rows that are more accurate than all that are
    cheaper, and is interpolated in logarithms. The sign is "=" for an interpolated time, "<" where
    the cheapest row is better already, ">" where none is as good: the time is that of the cheapest
    or the most accurate row then, and NaN where there is no row.
    """
    front: list[dict] = []
    rows = [row for row in rows if "errors" in row]
    last_miss = max((k for k, row in enumerate(rows) if _misses(row, names)), default=-1)
    rows = [
        row for k, row in enumerate(rows) if k >= last_miss or largest_error(row, names) > TARGET
    ]
    for row in sorted(rows, key=lambda row: row[cost]):
        if not front or largest_error(row, names) < largest_error(front[-1], names):
            front.append(row)
    if not front:
        return math.nan, ">"
    if largest_error(front[0], names) <= TARGET:
        return front[0][cost], "<"
    for dear, cheap in zip(front[1:], front, strict=False):
        if largest_error(dear, names) <= TARGET:
            worse, better = (math.log(largest_error(row, names)) for row in (cheap, dear))
            share = (worse - math.log(TARGET)) / (worse - better)
            return cheap[cost] ** (1 - share) * dear[cost] ** share, "="
    return front[-1][cost], ">"


def _misses(row: dict, names: tuple[str, ...]) -> bool:
    """Whether an error exceeds the target by more than its standard error."""
    return any(
        abs(error) - noise > TARGET for error, noise in (row["errors"][name] for name in names)
    )


def table(flows: list[dict]) -> str:
    """Markdown: seconds of a core for a unit of strain at 3 %, a column for each flow, and their
    ratio to jaxgran's.
    """
    names = [f"α {flow['restitution']:g}, ν {flow['packing_fraction']:g}" for flow in flows]
    lines = ["| | " + " | ".join(f"{name} | over jaxgran's" for name in names) + " |"]
    lines.append("| --- |" + " --- |" * 2 * len(names))
    for curve in dict.fromkeys(row["curve"] for flow in flows for row in flow["rows"]):
        cells = [
            f"{_time(*time_to_target(_rows(flow, curve), OBSERVABLES))} | "
            f"{ratio(flow, curve, COST)}"
            for flow in flows
        ]
        lines.append(f"| {curve} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _rows(flow: dict, curve: str) -> list[dict]:
    return [row for row in flow["rows"] if row["curve"] == curve]


def _time(seconds: float, sign: str) -> str:
    """A time; "not reached" where the target is not met, "< " before that of the cheapest setting
    if it meets it.
    """
    return "not reached" if sign == ">" else f"{'< ' if sign == '<' else ''}{seconds:.2g}"


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):,g}"


def ratio(flow: dict, curve: str, cost: str) -> str:
    """Time of a curve over that of jaxgran, "~" where both have been run no cheaper.

    Where the dearest setting of a curve misses the target beyond its standard error, the target
    costs more than that.
    """
    (ours, our_sign), (theirs, sign) = (
        time_to_target(_rows(flow, name), OBSERVABLES, cost) for name in ("jaxgran", curve)
    )
    last = [row for row in _rows(flow, curve) if "errors" in row][-1:]
    if our_sign != ">" and last and _misses(last[0], OBSERVABLES):
        return f"> {_two_digits(last[0][cost] / ours)}"
    if ">" in (our_sign, sign):
        return "–"
    bounds = {("=", "="): "", ("<", "="): "< ", ("=", "<"): "> ", ("<", "<"): "~ "}
    return f"{bounds[sign, our_sign]}{_two_digits(theirs / ours)}" if curve != "jaxgran" else "1"
