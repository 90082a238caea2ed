"""Speed against accuracy: what a unit of strain costs, and how wrong pressure and shear stress are.

jaxgran, a loop of the classical Gauss–Seidel scheme, soft discs in LAMMPS and an event-driven
program (the modules in ``peers``) shear the same discs from the same steady state. Each
trades time for accuracy by one setting: contact dynamics by its time step, soft discs by their
stiffness, whose time step is a fixed share of a contact. Event-driven discs have none; where they
collapse the row says so; with a duration of contact they do not, and are an independent answer
where flows are dense. All programs share one core and take turns, round after round, each in its
own process. Times are medians of the processor time over the rounds. What a first call takes longer
(compilation) is reported apart. Errors are relative to a reference: the loop, which shares no code
with jaxgran, at a time step of 3e-5 and a tolerance of 1e-6 over a longer strain; of the force
ratio, which depends on the time step in dense flows, at 1e-5.

``peers/front.py`` compares equal work: the cheapest settings within 3 %, at overlaps no deeper than
those of the other program. ``peers/chart.py`` draws the figure.

    python -m benchmarks speed_vs_accuracy           # about an hour
    python -m benchmarks speed_vs_accuracy --quick   # one flow of 256 discs, under 3 minutes
"""

import os
import time
from typing import NamedTuple

import jax
import numpy as np

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.peers import event_driven, jaxgran_itself, lammps, numba_rival
from benchmarks.peers.chart import draw
from benchmarks.peers.front import OBSERVABLES, TARGET, table
from benchmarks.peers.problem import Discs, Flow, averages, relative
from benchmarks.peers.workers import Worker

ONE_CORE = True

PEERS = (jaxgran_itself, numba_rival, lammps, event_driven)
REFERENCE_TIMESTEP, FORCE_TIMESTEP = 3e-5, 1e-5
FORCE_ROUNDS = 5  # times fewer rounds suffice for the force ratio


class Case(NamedTuple):
    """A flow, the strain of a round, the most rounds of a setting and the rounds of the
    reference.
    """

    flow: Flow
    strain: float
    rounds: int
    reference_rounds: int


class Plan(NamedTuple):
    """Flows, discs of each, and the seconds after which a setting has no more rounds; it has
    ``FEWEST_ROUNDS`` in any case.
    """

    cases: tuple[Case, ...]
    discs: int
    seconds: float


FEWEST_ROUNDS = 12
CASES = (
    Case(Flow(0.8, 0.6), 4, 60, 600),
    Case(Flow(0.5, 0.7), 4, 60, 600),
    Case(Flow(0.5, 0.8), 4, 60, 120),
)
FULL = Plan(CASES, 1000, 25)
QUICK = Plan((Case(Flow(0.8, 0.6), 2, 4, 40),), 256, 1)


def run(output: Output) -> None:
    """Compare in all flows, print the tables, and write JSON."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    plan = QUICK if output.quick else FULL
    left_out = {peer.__name__.rpartition(".")[2]: why for peer in PEERS if (why := peer.missing())}
    for why in left_out.values():
        print(why, flush=True)
    peers = [peer for peer in PEERS if not peer.missing()]
    flows = []
    for case in plan.cases:
        begin, load = time.perf_counter(), os.getloadavg()
        flows.append(compare_peers(plan, case, peers))
        flows[-1] |= {
            "load_averages": [load, os.getloadavg()],
            "wall_seconds": time.perf_counter() - begin,
        }
        report(flows[-1])
    print(table(flows))
    result = {
        "hardware": output.hardware | ({"lammps": lammps.version()} if lammps in peers else {}),
        "target": TARGET,
        "left_out": left_out,
        "flows": flows,
    }
    output.write_json("speed_vs_accuracy", result)
    output.write_picture(draw(result), "speed_vs_accuracy")


def compare_peers(plan: Plan, case: Case, peers: list) -> dict:
    """Reference, and errors and times of every setting of every peer, for one flow."""
    flow = case.flow
    law = jg.ShearFlow(plan.discs, flow.restitution, flow.packing_fraction, 1e-3)
    discs = jaxgran_itself.discs_of(jg.prepare(law, jax.random.key(0)))
    workers = [Worker(peer.__name__.rpartition(".")[2]) for peer in peers]
    right, seconds = reference(
        workers[peers.index(numba_rival)] if numba_rival in peers else workers[0], discs, case
    )
    runs, rows = {}, []
    for peer, worker in zip(peers, workers, strict=True):
        for curve, settings in peer.CURVES.items():
            for setting in settings:
                rows.append(first_looks(worker, len(rows), discs, case, curve, setting))
                if "failure" not in rows[-1]:
                    runs[len(rows) - 1] = worker
    stresses, clocks, depths = ({k: [] for k in runs} for _ in range(3))
    for number in range(case.rounds):
        order = list(runs) if number % 2 == 0 else list(reversed(runs))
        for k in order:
            spent = sum(processor for _, processor in clocks[k])
            if number >= FEWEST_ROUNDS and spent > plan.seconds:
                continue
            try:
                stress, clock = runs[k].advance(k)
            except RuntimeError as failure:
                rows[k]["failure"] = str(failure)
                del runs[k]
                continue
            stresses[k].append(stress)
            clocks[k].append(clock)
            depths[k].append(runs[k].overlaps(k))
    for k, run in runs.items():
        wall, cpu = np.median(clocks[k], axis=0) / case.strain
        mean, largest = np.mean(depths[k], axis=0)
        values = averages([stresses[k]])
        rows[k] |= {
            "rounds": len(clocks[k]),
            "cpu_seconds_per_strain": float(cpu),
            "wall_seconds_per_strain": float(wall),
            "mean_overlap": float(mean),
            "largest_overlap": float(largest),
            "values": values,
            "errors": {
                name: relative(values[name], right[name])
                for name in (*OBSERVABLES, "force_ratio")
                if name in values
            },
        }
        run.close(k)
    for worker in workers:
        worker.shutdown()
    plan_of_flow = {
        "strain": case.strain,
        "rounds": case.rounds,
        "reference_rounds": case.reference_rounds,
    }
    return {
        **flow._asdict(),
        "discs": plan.discs,
        **plan_of_flow,
        "reference": right,
        "reference_seconds_per_strain": seconds,
        "rows": rows,
    }


def reference(
    worker: Worker, discs: Discs, case: Case
) -> tuple[dict[str, tuple[float, float]], float]:
    """The right averages with their errors, and the seconds that a unit of strain of them took."""

    def measured(timestep: float, rounds: int) -> tuple[dict[str, tuple[float, float]], float]:
        worker.begin(-1, discs, case.flow, "reference", timestep, case.strain)
        worker.advance(-1)
        stresses, clocks = zip(*(worker.advance(-1) for _ in range(rounds)), strict=True)
        worker.close(-1)
        return averages([stresses]), float(np.median(clocks, axis=0)[1]) / case.strain

    right, seconds = measured(REFERENCE_TIMESTEP, case.reference_rounds)
    finer, _ = measured(FORCE_TIMESTEP, case.reference_rounds // FORCE_ROUNDS)
    return right | {"force_ratio": finer["force_ratio"]}, seconds


def first_looks(
    worker: Worker,
    key: int,
    discs: Discs,
    case: Case,
    curve: str,
    setting: float,
) -> dict:
    """The row of a setting so far, and its run begun, past a round that is left out.

    The first call is that of a short run apart, so that it shows compilation. Where a program
    fails the row says so.
    """
    row = {"peer": worker.peer, "curve": curve, "setting": setting}
    try:
        worker.begin(key, discs, case.flow, curve, setting, 0.1)
        (first, _), (_, again) = worker.advance(key)[1], worker.advance(key)[1]
        worker.close(key)
        row["first_call_seconds"] = first - again
        worker.begin(key, discs, case.flow, curve, setting, case.strain)
        worker.advance(key)
    except Exception as failure:  # of a program that is not ours to mend
        return row | {"failure": str(failure)}
    return row


def report(flow: dict) -> None:
    """Print the rows of a flow."""
    words = ", ".join(
        f"{name} {value:.4g} ± {error:.2g}" for name, (value, error) in flow["reference"].items()
    )
    print(f"α {flow['restitution']:g}, ν {flow['packing_fraction']:g}: {words}")
    print(
        "curve                       setting   cpu s   wall s   pressure          shear stress     "
        " overlap: mean, max"
    )
    for row in flow["rows"]:
        head = f"{row['curve']:26s}{row['setting']:9.0e}"
        if "failure" in row:
            print(f"{head}  {row['failure']}")
            continue
        cells = "".join(
            "{:8.2f} ± {:4.2f} % ".format(*(100 * x for x in row["errors"][name]))
            for name in OBSERVABLES
        )
        times = f"{row['cpu_seconds_per_strain']:8.4f}{row['wall_seconds_per_strain']:9.4f}"
        print(
            f"{head}{times}  {cells}   {row['mean_overlap']:.1e} {row['largest_overlap']:.1e}",
            flush=True,
        )
