"""Speed against accuracy: what a unit of strain costs, and how wrong pressure and shear stress are.

jaxgran, a loop of the classical Gauss–Seidel scheme, soft discs in LAMMPS and an event-driven
program (the modules in ``peers``) shear the same discs from the same steady state. Each
trades time for accuracy by one setting: contact dynamics by its time step, soft discs by their
stiffness, whose time step is a fixed share of a contact. Event-driven discs have none; where they
collapse the row says so; with a duration of contact they do not, and are an independent answer
where flows are dense. All programs share one core and take turns, round after round, each in its
own process. Times are medians of the processor time over the rounds, without the first one and so
without compilation. Errors are relative to a reference: the loop, which shares no code with
jaxgran, at a time step of 3e-5 and a tolerance of 1e-6 over a longer strain; of the force ratio,
which depends on the time step in dense flows, at 1e-5.

``peers/front.py`` compares equal work: the cheapest settings within 3 %, at overlaps no deeper than
those of the other program. ``peers/chart.py`` draws the figure.

    python -m benchmarks speed_vs_accuracy           # about an hour
    python -m benchmarks speed_vs_accuracy --quick   # one flow of 256 discs, under 3 minutes
"""

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.peers import event_driven, jaxgran_itself, lammps, numba_rival, workers
from benchmarks.peers.chart import draw
from benchmarks.peers.front import COST, OBSERVABLES, TARGET, table
from benchmarks.peers.problem import Discs, Flow, averages, relative

ONE_CORE = True

PEERS = (jaxgran_itself, numba_rival, lammps, event_driven)
REFERENCE_TIMESTEP, FORCE_TIMESTEP = 3e-5, 1e-5
FORCE_ROUNDS = 5  # times fewer rounds suffice for the force ratio
FEWEST_ROUNDS = 12


class Plan(NamedTuple):
    """Flows with the rounds of the reference of each, discs, strain of a round, the most rounds of
    a setting, and the seconds after which it has no more than ``FEWEST_ROUNDS``.
    """

    flows: dict[Flow, int]
    discs: int
    strain: float
    rounds: int
    seconds: float


FULL = Plan({Flow(0.8, 0.6): 600, Flow(0.5, 0.7): 600, Flow(0.5, 0.8): 120}, 1000, 4, 60, 25)
QUICK = Plan({Flow(0.8, 0.6): 40}, 256, 2, 4, 1)


class Worker:
    """The process of one peer, whose calls wait for their answers."""

    def __init__(self, peer: ModuleType) -> None:
        self.peer = peer.__name__
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))

    def __call__(self, work: Callable, key: int, *arguments: Any) -> Any:
        return self.pool.submit(work, key, *arguments).result()


def run(output: Output) -> None:
    """Compare in all flows, print the table, and write JSON and PNG."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    plan = QUICK if output.quick else FULL
    print(*filter(None, (peer.missing() for peer in PEERS)), sep="\n", flush=True)
    peers = [peer for peer in PEERS if not peer.missing()]
    flows = [compared(plan, flow, peers) for flow in plan.flows]
    print(table(flows))
    versions = {"lammps": lammps.version()} if lammps in peers else {}
    result = {"hardware": output.hardware | versions, "target": TARGET, "flows": flows}
    output.write_json("speed_vs_accuracy", result)
    output.write_picture(draw(result), "speed_vs_accuracy")


def compared(plan: Plan, flow: Flow, peers: list[ModuleType]) -> dict:
    """Reference, and errors and times of every setting of every peer, for one flow."""
    law = jg.ShearFlow(plan.discs, flow.restitution, flow.packing_fraction, 1e-3)
    discs = jaxgran_itself.discs_of(jg.prepare(law, jax.random.key(0)))
    processes = {peer: Worker(peer) for peer in peers}
    right = reference(processes[numba_rival], plan, flow, discs)
    runs, rows = {}, []
    for peer, worker in processes.items():
        for curve, settings in peer.CURVES.items():
            for setting in settings:
                rows.append({"curve": curve, "setting": setting})
                begun = len(rows) - 1, worker.peer, discs, flow, curve, setting, plan.strain
                try:
                    worker(workers.begin, *begun)
                    runs[len(rows) - 1] = worker
                except Exception as failure:  # of a program that is not ours to mend
                    rows[-1]["failure"] = str(failure)
    rounds: dict[int, list] = {k: [] for k in runs}
    for number in range(plan.rounds):
        for k in list(runs) if number % 2 == 0 else list(reversed(runs)):
            spent = sum(seconds for _, seconds, _ in rounds[k])
            if number >= FEWEST_ROUNDS and spent > plan.seconds:
                continue
            try:
                rounds[k].append(runs[k](workers.advance, k))
            except RuntimeError as failure:
                rows[k]["failure"] = str(failure)
                del runs[k]
    for k, worker in runs.items():
        stresses, seconds, depths = zip(*rounds[k], strict=True)
        values = averages([stresses])
        known = [name for name in (*OBSERVABLES, "force_ratio") if name in values]
        rows[k] |= {COST: float(np.median(seconds)) / plan.strain}
        rows[k] |= {"largest_overlap": float(np.mean(depths)), "values": values}
        rows[k] |= {"errors": {name: relative(values[name], right[name]) for name in known}}
        print(rows[k], flush=True)
        worker(workers.close, k)
    for worker in processes.values():
        worker.pool.shutdown()
    return {**flow._asdict(), "discs": plan.discs, "reference": right, "rows": rows}


def reference(
    worker: Worker, plan: Plan, flow: Flow, discs: Discs
) -> dict[str, tuple[float, float]]:
    """The right averages with their errors."""

    def measured(timestep: float, rounds: int) -> dict[str, tuple[float, float]]:
        worker(workers.begin, -1, worker.peer, discs, flow, "reference", timestep, plan.strain)
        stresses = [worker(workers.advance, -1)[0] for _ in range(rounds)]
        worker(workers.close, -1)
        return averages([stresses])

    finer = measured(FORCE_TIMESTEP, plan.flows[flow] // FORCE_ROUNDS)
    return measured(REFERENCE_TIMESTEP, plan.flows[flow]) | {"force_ratio": finer["force_ratio"]}
