"""Contact solvers side by side: this program's and those of other packages, on the collection of
contact problems.

python -m benchmarks solvers          # about 9 minutes
python -m benchmarks solvers --quick  # every tenth problem and the smallest ones, under 3 minutes

The other packages come with pip install "jaxgran[solver-peers]"; without them, this program's
solvers are compared alone. All solve in this process, on one core, with one thread; times are those
of the processor. A call from Python is part of them: about 2 µs for the numba engine, 80 µs for
JAX, 300 µs for OSQP.
"""

import itertools
import os
import time
from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.collection import Entry, load
from benchmarks.networks import SLOTS
from benchmarks.output import Output
from benchmarks.solvers.groups import FLOWS, summary, table
from benchmarks.solvers.measure import LIMIT, TARGETS, Attempt, run_solvers, stress_error
from benchmarks.solvers.roster import (
    DEFAULT,
    NUMBA_ENGINE,
    Solver,
    our_solvers,
    package_solvers,
    versions,
)

_QUICK_STEP, _QUICK_CONTACTS = 10, 600
_AGREED = 1e-8  # residual of solutions whose velocities are compared


def run(output: Output) -> None:
    """Measure, print the tables, and write ``solvers`` as JSON."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    solvers = roster()
    entries = load(most_contacts=_QUICK_CONTACTS)[::_QUICK_STEP] if output.quick else load()
    start, load_before = time.perf_counter(), os.getloadavg()
    compile_for(entries, solvers)
    finest: dict[str, dict[str, np.ndarray]] = {}
    stress: dict[str, dict[float, float]] = {name: {} for name in (NUMBA_ENGINE, DEFAULT)}

    def note(name: str, entry: Entry, runs: list[Attempt]) -> None:
        if entry.solution.feasible and runs[-1].residual <= _AGREED:
            after = entry.matrix @ runs[-1].impulses + entry.problem.approach
            finest.setdefault(entry.name, {})[name] = after / -np.min(entry.problem.approach)
        if name in stress and entry.family in FLOWS:
            for run in runs:
                ratio = stress_error(entry, run.impulses) / run.tolerance
                stress[name][run.tolerance] = max(stress[name].get(run.tolerance, 0.0), ratio)

    rows = run_solvers(solvers, entries, note)
    agreed = agreement(finest)
    print(table(rows), agreement_lines(agreed, solvers), sep="\n\n")
    head = {
        "packages": versions(),
        "settings": {name: solver.settings for name, solver in solvers.items()},
        "counts": {name: solver.counts for name, solver in solvers.items()},
        "targets": TARGETS,
        "limit_seconds": LIMIT,
        "problems": len(entries),
        "load_averages": [load_before, os.getloadavg()],
        "wall_seconds": round(time.perf_counter() - start),
        "agreement": agreed,
        "worst_stress_error_of_flows_over_tolerance": {
            name: {f"{tolerance:.0e}": float(f"{ratio:.3g}") for tolerance, ratio in ratios.items()}
            for name, ratios in stress.items()
        },
    }
    output.write_rows("solvers", head, "summary", summary(rows))


def roster() -> dict[str, Solver]:
    """Our solvers, and those of the other packages if they are installed."""
    try:
        return {**our_solvers(), **package_solvers()}
    except ModuleNotFoundError as error:
        print(f"{error}; only this program's solvers are compared.", flush=True)
        return our_solvers()


def compile_for(entries: Sequence[Entry], solvers: Mapping[str, Solver]) -> None:
    """Compile ours for each of the shapes that problems are filled up to."""
    shapes = {}
    for entry in entries:
        shapes.setdefault(
            min(slots for slots in SLOTS if slots >= len(entry.problem.approach)), entry
        )
    for entry, solver in itertools.product(shapes.values(), solvers.values()):
        if solver.ours:
            solver.prepare(entry, 0.1)()


def agreement(finest: Mapping[str, Mapping[str, np.ndarray]]) -> list[dict]:
    """Of each pair of solvers: problems that both solve to 1e-8, and the largest difference of
    velocities.

    Velocities are in units of the fastest approach of the problem.
    """
    names = sorted({name for impulses in finest.values() for name in impulses})
    pairs = []
    for first, second in itertools.combinations(names, 2):
        both = [
            impulses for impulses in finest.values() if first in impulses and second in impulses
        ]
        if both:
            largest = max(
                float(np.max(np.abs(impulses[first] - impulses[second]))) for impulses in both
            )
            pairs.append(
                {
                    "solvers": [first, second],
                    "problems": len(both),
                    "largest_difference": float(f"{largest:.2g}"),
                }
            )
    return pairs


def agreement_lines(pairs: Sequence[Mapping], solvers: Mapping[str, Solver]) -> str:
    """The agreement as text: the pairs of ours with others, and the worst of all."""
    lines = [
        "largest difference of velocities between solutions to 1e-8, over the fastest approach"
    ]
    mixed = [pair for pair in pairs if sum(solvers[name].ours for name in pair["solvers"]) == 1]
    lines += [
        f"{' / '.join(pair['solvers'])}: {pair['largest_difference']:.1e} ({pair['problems']})"
        for pair in mixed
    ]
    return "\n".join(lines)
