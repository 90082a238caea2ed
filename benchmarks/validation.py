"""Temperature, stresses and force ratio against the two programs of ``independent``, which share no
code with jaxgran.

All start from the same steady states and run on as long as each other, over a grid of the plane.
Event-driven discs have no time step and, as inelastic hard discs, no contact duration; where they
collapse the row says so. The classical Gauss–Seidel loop has the time step, the activation rule and
the tolerance of jaxgran, and so the same force ratio.

    python -m benchmarks validation           # about 25 minutes on two cores
    python -m benchmarks validation --quick   # two flows of 128 grains, about a minute
"""

from functools import partial
from itertools import product
from types import ModuleType
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.cores import on_all_cores
from benchmarks.output import Output
from benchmarks.peers import event_driven, jaxgran_itself, numba_rival
from benchmarks.peers.problem import Flow, averages
from jaxgran.plotting.style import TWO_COLUMNS, styled

LABELS = {
    "granular_temperature": "$T$",
    "pressure": "$p$",
    "shear_stress": r"$\tau$",
    "force_ratio": r"$\langle F\rangle/\langle F_{\mathrm{bc}}\rangle$",
}
COLOURS = "black", "0.5", "tab:blue", "tab:orange"
TIMESTEP = 1e-4
PROGRAMS: dict[str, tuple[ModuleType, str, float]] = {  # module, curve and setting
    "event-driven discs": (event_driven, "event-driven", 0.0),
    "Gauss–Seidel loop": (numba_rival, "numba loop", TIMESTEP),
}
ITSELF = (jaxgran_itself, "jaxgran", TIMESTEP)


class Plan(NamedTuple):
    """Flows as (restitution, packing fraction), grains, seeds, blocks of a sample and the strain of
    each.
    """

    flows: tuple[tuple[float, float], ...]
    grains: int
    seeds: int
    blocks: int
    strain: float


FULL = Plan(tuple(product((0.9, 0.7, 0.5, 0.2), (0.2, 0.5, 0.7, 0.8))), 1000, 8, 8, 5.0)
QUICK = Plan(((0.9, 0.6), (0.2, 0.7)), 128, 2, 4, 1.0)


def run(output: Output) -> None:
    """Compare all flows, print the differences, and write JSON and PNG."""
    plan = QUICK if output.quick else FULL
    some = on_all_cores(partial(rows_of_flow, plan), plan.flows, lambda flow: flow[1])
    rows = [row for of_flow in some for row in of_flow]
    head = {**plan._asdict(), "timestep": TIMESTEP}
    head["programs"] = {name: summary(rows, name) for name in PROGRAMS}
    output.write_json("validation", head | {"rows": rows})
    output.write_picture(draw(rows), "validation")


def rows_of_flow(plan: Plan, flow: tuple[float, float]) -> list[dict]:
    """Differences of jaxgran from each program in a flow.

    ===============  ==========================================================================
    key              meaning
    ===============  ==========================================================================
    alpha, nu        where
    program          a key of ``PROGRAMS``
    observable       a key of ``LABELS``; None where the program collapses
    value            of jaxgran, and its standard error; m = σ = γ̇ = 1
    reference        of the program, and its standard error
    difference       jaxgran over the program, less one, and its standard error
    ===============  ==========================================================================
    """
    alpha, nu = flow
    law = jg.ShearFlow(plan.grains, alpha, nu, TIMESTEP)
    starts = [
        jaxgran_itself.discs_of(jg.prepare(law, jax.random.key(seed))) for seed in range(plan.seeds)
    ]

    def means(program: ModuleType, curve: str, setting: float) -> dict[str, tuple[float, float]]:
        samples = []
        for discs in starts:
            one = program.begin(discs, Flow(*flow), curve, setting, plan.strain)
            samples.append([one.advance() for _ in range(plan.blocks + 1)][1:])
        return averages(samples)

    ours = means(*ITSELF)
    rows = []
    for name, program in PROGRAMS.items():
        head = {"alpha": alpha, "nu": nu, "program": name}
        try:
            theirs = means(*program)
        except RuntimeError:  # an inelastic collapse
            rows.append({**head, "observable": None})
            continue
        for observable in theirs:
            value, reference = ours[observable], theirs[observable]
            quotient = value[0] / reference[0]
            noise = quotient * np.hypot(value[1] / value[0], reference[1] / reference[0])
            row = {**head, "observable": observable, "value": value, "reference": reference}
            rows.append(row | {"difference": (quotient - 1, float(noise))})
            print(rows[-1], flush=True)
    return rows


def summary(rows: list[dict], program: str) -> dict[str, float]:
    """Flows that a program finishes, the averages compared in them, and the largest and the root
    mean square of the differences in standard errors of both.
    """
    compared = [row for row in rows if row["program"] == program and row["observable"] is not None]
    sigmas = np.array([np.divide(*row["difference"]) for row in compared])
    return {
        "flows": len({(row["alpha"], row["nu"]) for row in compared}),
        "averages": len(compared),
        "largest_in_standard_errors": float(np.max(abs(sigmas))),
        "rms_in_standard_errors": float(np.sqrt(np.mean(sigmas**2))),
    }


@styled
def draw(rows: list[dict]) -> Figure:
    """Differences of jaxgran from each program, with standard errors of both."""
    flows = list(dict.fromkeys((row["alpha"], row["nu"]) for row in rows))
    place = {flow: -k for k, flow in enumerate(flows)}
    figure = Figure(figsize=(TWO_COLUMNS, 4.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, program in zip(panels, PROGRAMS, strict=True):
        shown = [row for row in rows if row["program"] == program]
        for k, (name, label) in enumerate(LABELS.items()):
            of_name = [row for row in shown if row["observable"] == name]
            if of_name:
                difference, noise = 100 * np.transpose([row["difference"] for row in of_name])
                y = [place[row["alpha"], row["nu"]] + 0.2 * (1.5 - k) for row in of_name]
                look = {"color": COLOURS[k], "marker": "os^D"[k], "ls": "none", "label": label}
                axes.errorbar(difference, y, xerr=noise, **look)
        for row in shown:
            if row["observable"] is None:
                axes.text(0, place[row["alpha"], row["nu"]], "collapses", ha="center", va="center")
        axes.axvline(0, color="0.6", lw=0.8, zorder=0)
        axes.set(xlabel=f"jaxgran / {program} − 1 (%)", ylim=(-len(flows) + 0.4, 0.6))
        axes.tick_params(axis="y", length=0)
        axes.legend(ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    names = [rf"$\alpha={alpha:g}$, $\nu={nu:g}$" for alpha, nu in flows]
    panels[0].set_yticks(list(place.values()), names)
    return figure
