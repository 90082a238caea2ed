"""From times and errors to a table: what stresses within 3 % take, at equal overlaps."""

import math

OBSERVABLES = ("pressure", "shear_stress")
TARGET = 0.03
COST = "cpu_seconds_per_strain"
TIME_STEPPED = "numba loop", "JAX engine", "projected Jacobi"


def rows_of(flow: dict, curve: str) -> list[dict]:
    """The rows of a program that ran, coarse before fine."""
    return [row for row in flow["rows"] if row["curve"] == curve and "errors" in row]


def cheapest(rows: list[dict]) -> tuple[dict, bool] | None:
    """The coarsest setting whose stresses are within the target, or the finest if none is; and
    whether it is within.

    Errors change sign along a curve. So a setting that meets the target by chance, while a finer
    one misses it beyond twice its standard error, is passed over.
    """
    if not rows:
        return None
    misses = [k for k, row in enumerate(rows) if _misses(row)]
    reached = [row for row in rows[max(misses, default=-1) + 1 :] if _largest_error(row) <= TARGET]
    return (reached[0], True) if reached else (rows[-1], False)


def ratio(flow: dict, curve: str) -> str:
    """Time of another program over that of jaxgran, of the cheapest settings within the target;
    jaxgran's overlaps are no deeper than those of the other. "> " where that does not reach it.

    That of soft discs is given from the stiffness before the cheapest one within the target to this
    one, as the target is reached somewhere between.
    """
    rows, own = rows_of(flow, curve), rows_of(flow, "jaxgran")
    if (best := cheapest(rows)) is None:
        return "–"
    theirs, reached = best
    shallow = [row for row in own if row["largest_overlap"] <= theirs["largest_overlap"]]
    ours = cheapest(shallow or own[-1:])
    if ours is None or not ours[1]:
        return "–"
    place = rows.index(theirs)
    before = max(0, place - 1) if curve == "LAMMPS" else place
    costs = [row[COST] / ours[0][COST] for row in rows[before : place + 1]]
    if not reached:
        return f"> {_two_digits(costs[-1])}"
    first, last = _two_digits(min(costs)), _two_digits(max(costs))
    return first if first == last else f"{first}–{last}"


def ratio_at_equal_timesteps(flow: dict, curve: str) -> str:
    """Time of a program with a time step over that of jaxgran at the same ones, their geometric
    mean.
    """
    ours = {row["setting"]: row[COST] for row in rows_of(flow, "jaxgran")}
    logs = [math.log(row[COST] / ours[row["setting"]]) for row in rows_of(flow, curve)]
    return _two_digits(math.exp(sum(logs) / len(logs)))


def table(flows: list[dict]) -> str:
    """Markdown: for each flow the cheapest setting of each program, its microseconds for a grain
    and a unit of strain, its time over jaxgran's at overlaps no deeper, and, where there are time
    steps, at the same ones.
    """
    times = "µs", "over jaxgran", "at equal dt"
    heads = "α, ν", "program", "setting", *times, "error of p", "of τ", "overlap (σ)"
    lines = [f"| {' | '.join(heads)} |", "| --- |" + " --- |" * (len(heads) - 1)]
    for flow in flows:
        where = f"{flow['restitution']:g}, {flow['packing_fraction']:g}"
        for curve in ("jaxgran", *TIME_STEPPED, "LAMMPS", "event-driven", "TC model"):
            if all(row["curve"] != curve for row in flow["rows"]):  # it was left out
                continue
            best = cheapest(rows_of(flow, curve))
            if best is None:
                lines.append(f"| {where} | {curve} | – | {failure_of(curve)} | – | – | – | – | – |")
                continue
            row, _ = best
            errors = [f"{100 * e:+.1f} ± {100 * s:.1f} %" for e, s in _errors(row)]
            cost = _two_digits(1e6 * row[COST] / flow["discs"])
            over = "1" if curve == "jaxgran" else ratio(flow, curve)
            overlap = _two_digits(row["largest_overlap"])
            equal = ratio_at_equal_timesteps(flow, curve) if curve in TIME_STEPPED else "–"
            cells = where, curve, _setting(curve, row), cost, over, equal, *errors, overlap
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
    """The time step, the stiffness or the duration of a contact."""
    if curve == "event-driven":
        return "–"
    name = {"LAMMPS": "k", "TC model": "t_c"}.get(curve, "dt")
    return f"{name} = {row['setting']:.0e}".replace("e-0", "e-").replace("e+0", "e")
