"""Where methods fail: seven ways to shear the same discs, over ten flows.

The flows go from loose and nearly elastic to dense and dissipative, and to a jammed one. Each
method has one setting that trades time for accuracy: the time step dt of contact dynamics, the
stiffness k of soft discs; event-driven discs have none. From the same steady states, three seeds of
256 discs, every setting is sheared on, and pressure and shear stress are compared with a reference:
the default at dt = 1e-4 and a tolerance of 1e-6. A cell of the figure is the coarsest setting that
is right: both stresses within 5 % and one standard error, of one to three per cent, there and at
the next finer setting, with which the search ends. Where none is, a word says what happened at the
finest setting (``OUTCOMES``).

Contact dynamics is stopped by the first block of strain that fails: a solve above the tolerance, no
impulses, too many contacts, a number that is not finite, or energy that was gained, which is a
negative dissipation, or kinetic energy beyond the shear work less the dissipation. It is stopped,
too, where it takes more than ``SLOW``. A setting is silent if it is wrong without any of these, and
without deep overlaps.

    python -m benchmarks stability            # about half an hour on two cores
    python -m benchmarks stability --quick    # two flows of 64 grains, about two minutes
"""

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.peers import event_driven, lammps
from benchmarks.peers.jaxgran_itself import discs_of
from benchmarks.peers.problem import Flow, Stress, blocks_of, relative
from benchmarks.peers.problem import averages as stress_means
from jaxgran.dynamics.batch import stack
from jaxgran.environment import usable_cores
from jaxgran.model.choices import MAX_PACKING_FRACTION
from jaxgran.model.status import DEEP_OVERLAP
from jaxgran.plotting.style import SMALL_SIZE, TWO_COLUMNS, empty_figure, styled
from jaxgran.sampling.averages import averages
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.timestep import expected_temperature, longest_timestep

JAMMED = 0.84
FLOWS = (
    *((0.95, 0.3), (0.9, 0.7), (0.9, 0.8), (0.5, 0.5), (0.5, 0.7)),
    *((0.5, 0.8), (0.1, 0.5), (0.1, 0.7), (0.1, 0.8), (0.5, JAMMED)),
)
TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4)
STIFFNESSES = (1e3, 1e4, 1e5, 1e6, 1e7)
SOFT = "soft discs, LAMMPS"
RIGHT = 0.05  # relative error of pressure and shear stress, and a standard error
STRESSES = ("pressure", "shear_stress")
SLOW = 5e-3  # s of processor time for a grain and a unit of strain; the default takes 0.15 ms
GAIN = {"float64": 1e-6, "float32": 1e-3}  # of the energies exchanged, which rounding explains
OUTCOMES = {  # mildest first, with the word in a cell
    "ok": "right",
    "no_reference": "–",  # it runs, and there is nothing to compare with
    "too_slow": "too slow",
    "too_soft": "too soft",
    "silent": "silent",  # wrong, and no status says so
    "iteration_limit": "unsolved",  # solves end above the tolerance
    "deep_overlap": "overlaps",
    "infeasible": "jammed",  # no impulses exist
    "energy_gain": "energy",  # is gained
    "capacity": "capacity",  # more contacts than the buffers hold
    "nonfinite": "not finite",
    "collapse": "collapse",
    "gives_up": "gives up",
}


@dataclass(frozen=True)
class JacobiDiagonal(jg.Jacobi):
    """``Jacobi`` with D = diag(W), the classical choice, which does not bound W and diverges in
    dense flows.
    """

    def bound(self, operator):
        return operator.diagonal()


METHODS: dict[str, dict[str, Any]] = {  # of contact dynamics
    "single precision": {"dtype": "float32"},
    "Jacobi, diag W": {"solver": JacobiDiagonal(relaxation=1.0)},
    "Jacobi, bound of W": {"solver": jg.Jacobi()},
    "Nesterov": {"solver": jg.Nesterov()},
    "default": {},
}
PEERS = {
    "event-driven": (event_driven, (0.0,)),
    SOFT: (lammps, STIFFNESSES),
}


class Plan(NamedTuple):
    """Flows as (restitution, packing fraction), grains, seeds, blocks of each sample and the strain
    of each, and the time steps.
    """

    flows: tuple[tuple[float, float], ...]
    grains: int
    seeds: int
    blocks: int
    strain: float
    timesteps: tuple[float, ...]


FULL = Plan(FLOWS, 256, 3, 6, 5.0, TIMESTEPS)
PARTS = 12  # of the first block of a seed
QUICK = Plan(((0.8, 0.6), (0.5, JAMMED)), 64, 2, 4, 1.0, (1e-2, 1e-3))
REFERENCE_TIMESTEP, REFERENCE_TOLERANCE, REFERENCE_BLOCKS = 1e-4, 1e-6, 3  # times the blocks

advance = jax.jit(jg.advance)
pack = jax.jit(jg.pack)


def run(output: Output) -> None:
    """Measure all flows on all cores, print what fails, and write JSON and PNG."""
    plan, rows = QUICK if output.quick else FULL, []
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        dense_first = sorted(plan.flows, key=lambda flow: -flow[1])
        for future in as_completed(pool.submit(rows_of_flow, plan, flow) for flow in dense_first):
            rows += future.result()
    rows.sort(key=lambda row: plan.flows.index((row["alpha"], row["nu"])))
    head = {**plan._asdict(), "right": RIGHT, "missing": lammps.missing()}
    output.write_rows("stability", head, "rows", rows)
    output.write_picture(draw(rows), "stability")


def rows_of_flow(plan: Plan, flow: tuple[float, float]) -> list[dict]:
    """What becomes of a flow by every method and setting.

    ===================  ====  ==================================================================
    key                  unit  meaning
    ===================  ====  ==================================================================
    alpha, nu            –     where
    method, setting      –     a key of ``METHODS`` or ``PEERS``; its dt in 1/γ̇ or k in mγ̇²
    outcome, detail      –     how the run ended, a key of ``OUTCOMES``, and the words of a peer
    strain               –     that was sampled, over all seeds
    errors               –     relative errors of pressure and shear stress with standard errors,
                               None where nothing was sampled or nothing is right
    largest_overlap      σ     of a contact, by contact dynamics
    ===================  ====  ==================================================================
    """
    alpha, nu = flow
    states = [start(plan.grains, alpha, nu, seed) for seed in range(plan.seeds)]
    solver = jg.BarzilaiBorwein(tolerance=REFERENCE_TOLERANCE)
    longer = plan._replace(blocks=REFERENCE_BLOCKS * plan.blocks)
    reference = None
    if nu != JAMMED:
        stresses, _ = sheared(longer, flow, states, REFERENCE_TIMESTEP, solver, limit=np.inf)
        reference = stress_means([stresses])
    ways = {
        method: (settings, partial(by_peer, peer, plan, flow, states))
        for method, (peer, settings) in PEERS.items()
        if not peer.missing()
    } | {
        method: (plan.timesteps, partial(sheared, plan, flow, states, **chosen))
        for method, chosen in METHODS.items()
    }
    rows = []
    for method, (settings, way) in ways.items():
        verdicts = []
        for setting in settings:
            stresses, how = way(setting)
            row = {"alpha": alpha, "nu": nu, "method": method, "setting": setting, **how}
            row |= {
                "strain": len(stresses) * plan.strain,
                "errors": relative_errors(stresses, reference),
            }
            rows.append(row)
            verdicts.append(verdict(row))
            print(
                f"α = {alpha:g}, ν = {nu:g}  {method:20s}{setting:8.0e}  {verdicts[-1]:16s}"
                + "".join(f"{100 * e:8.1f} ± {100 * s:.1f} %" for e, s in row["errors"] or []),
                flush=True,
            )
            if verdicts[-2:] == ["ok", "ok"]:
                break
    return rows


def relative_errors(
    stresses: list[Stress], reference: dict[str, tuple[float, float]] | None
) -> list[tuple[float, float]] | None:
    """Errors of the stresses of some blocks with standard errors, relative to a reference; None
    without either.
    """
    if len(stresses) < 2 or reference is None:
        return None
    measured = stress_means([stresses])
    return [relative(measured[name], reference[name]) for name in STRESSES]


def verdict(row: dict) -> str:
    """What became of a setting: "ok" if it ran to its end and is right, whatever its overlaps are.

    A wrong one has the outcome of its run. If that is "ok" it is silent, as nothing tells. Nothing
    is right in a jammed packing of rigid discs, and nothing is known of soft ones.
    """
    if row["outcome"] not in ("ok", "deep_overlap"):
        return row["outcome"]
    errors = row["errors"]
    if errors is not None and max(abs(error) - noise for error, noise in errors) <= RIGHT:
        return "ok"
    if row["method"] == SOFT:
        return "no_reference" if errors is None else "too_soft"
    return "silent" if row["outcome"] == "ok" else row["outcome"]


# ----------------------------------------------------------------------------------------------
# contact dynamics


def flow_of(grains: int, alpha: float, nu: float, dt: float, dtype: str = "float64"):
    """A flow whose packing fraction is not judged, in a precision."""
    flow = jg.ShearFlow(grains, alpha, 0.5, dt)
    flow = jax.tree_util.tree_map_with_path(
        lambda path, value: nu if path[-1].name == "packing_fraction" else value, flow
    )
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), flow)


def start(grains: int, alpha: float, nu: float, seed: int) -> jg.State:
    """A steady state, or a packing at the jammed density whose grains have a thermal speed of
    10 σγ̇.
    """
    if nu != JAMMED:
        return jg.prepare(jg.ShearFlow(grains, alpha, nu, 3e-4), jax.random.key(seed))
    for attempt in range(10):
        state, packed = pack(flow_of(grains, alpha, nu, 1e-3), jax.random.key(10 * seed + attempt))
        if packed:
            break
    masses = np.asarray(state.grains.masses)[:, None]
    velocities = np.random.default_rng(seed).normal(size=state.velocities.shape) / np.sqrt(masses)
    velocities -= np.sum(masses * velocities, axis=0) / np.sum(masses)
    return replace(state, velocities=jnp.asarray(10 * velocities))


def sheared(
    plan: Plan,
    flow: tuple[float, float],
    states: list[jg.State],
    dt: float,
    solver: jg.ProjectedMethod | None = None,
    dtype: str = "float64",
    limit: float = SLOW,
) -> tuple[list[Stress], dict]:
    """Pressure and shear stress of the blocks of all seeds, what went wrong, and the
    largest overlap; the first block of a seed is left out, and its first part of the time.
    """
    sheared_flow = flow_of(plan.grains, *flow, dt, dtype)
    solver = solver or jg.BarzilaiBorwein()
    solver = jax.tree.map(
        lambda x: jnp.asarray(x, "int32" if isinstance(x, int) else dtype), solver
    )
    total = round(plan.strain / dt)
    stresses: list[Stress] = []
    worst, deepest = "ok", 0.0

    def ended(outcome: str) -> tuple[list[Stress], dict]:
        return stresses, {"outcome": outcome, "largest_overlap": deepest}

    for first in states:
        state = jax.tree.map(lambda x: x.astype(dtype), first)
        steps, begin = 0, 0.0
        for block in range(plan.blocks + 1):
            before = energy(state)
            for piece in pieces(total) if block == 0 else [total]:
                state, tally = advance(sheared_flow, state, jnp.int32(piece), solver=solver)
                status = jg.Status(int(tally.status))
                deepest = max(deepest, float(tally.largest_overlap))
                if status not in (jg.Status.ok, jg.Status.deep_overlap):
                    return ended(status.name)
                if begin:
                    steps += piece
                    seconds = time.process_time() - begin
                    if seconds > 1 and seconds > limit * plan.grains * dt * steps:
                        return ended("too_slow")
                begin = begin or time.process_time()
            if block and gains(
                tally, energy(state) - before, GAIN[dtype] * (before + energy(state))
            ):
                return ended("energy_gain")
            if status == jg.Status.deep_overlap or tally.largest_overlap > DEEP_OVERLAP:
                worst = "deep_overlap"
            if block:
                mean = averages(tally, state.side**2, plan.grains, sheared_flow.shear_rate)
                stresses.append(Stress(*(float(mean[name]) for name in STRESSES)))
    return ended(worst)


def pieces(steps: int) -> list[int]:
    """Parts of some steps, each as long as all before it, so that what fails ends early."""
    edges = np.unique([0, *np.ceil(steps / 2.0 ** np.arange(PARTS)).astype(int)])
    return np.diff(edges).tolist()


def energy(state: jg.State) -> float:
    """Kinetic energy of the peculiar velocities, mσ²γ̇²."""
    velocities = np.asarray(state.velocities, float)
    return float(np.sum(np.asarray(state.grains.masses, float)[:, None] * velocities**2) / 2)


def gains(tally: jg.Tally, rise: float, rounding: float) -> bool:
    """Whether a contact law gave energy: dissipation below zero, or more kinetic energy than the
    balance allows.
    """
    work = -float(tally.contact_moment[0, 1] + tally.kinetic_moment[0, 1])  # shear rate one
    dissipation = float(tally.dissipation)
    rounding += 1e-6 * abs(work)
    return dissipation < -rounding or rise > work - dissipation + rounding


# ----------------------------------------------------------------------------------------------
# other programs


def by_peer(
    peer: Any, plan: Plan, flow: tuple[float, float], states: list[jg.State], setting: float
) -> tuple[list[Stress], dict]:
    """Stresses of the blocks of all seeds by another program, and how it failed."""
    (curve,), stresses = peer.CURVES, []
    for state in states:
        try:
            stresses += blocks_of(
                peer, discs_of(state), Flow(*flow), curve, setting, plan.strain, plan.blocks
            )
        except Exception as failure:  # of a program that is not ours to mend
            outcome = "collapse" if peer is event_driven else "gives_up"
            return stresses, {"outcome": outcome, "detail": str(failure)}
    return stresses, {"outcome": "ok"}


# ----------------------------------------------------------------------------------------------
# figure


def cells(rows: list[dict]) -> Iterator[tuple[float, float, str, float | None, str]]:
    """α, ν and method of each cell, the coarsest setting from which on all are right that are not
    too slow, and its outcome; or None and the verdict on the finest one, or on one that has nothing
    to compare with.
    """
    keys = dict.fromkeys((row["alpha"], row["nu"], row["method"]) for row in rows)
    for key in keys:
        column = [row for row in rows if (row["alpha"], row["nu"], row["method"]) == key]
        verdicts = [verdict(row) for row in column]
        coarsest, outcome = None, "no_reference" if "no_reference" in verdicts else verdicts[-1]
        for row, judged in zip(reversed(column), reversed(verdicts), strict=True):
            if judged not in ("ok", "too_slow"):
                break
            if judged == "ok":
                coarsest, outcome = row["setting"], row["outcome"]
        yield *key, coarsest, outcome


def longest_accepted(alpha: float, nu: float) -> float:
    """The longest time step that a map accepts of a flow, and none of one that is jammed."""
    if nu > MAX_PACKING_FRACTION:
        return 0.0
    flow = stack([jg.ShearFlow(FULL.grains, alpha, nu, REFERENCE_TIMESTEP)])
    theory = predicted(flow).granular_temperature
    temperature = expected_temperature(theory, flow.packing_fraction, flow.shear_rate)
    return longest_timestep(temperature, flow.packing_fraction, flow.activation).item()


@styled
def draw(rows: list[dict]) -> Figure:
    """A table: methods by flows, the coarsest setting that is right, or what fails; in brackets
    where a map refuses it.
    """
    methods = [name for name in (*PEERS, *METHODS) if name in {row["method"] for row in rows}]
    flows = list(dict.fromkeys((row["alpha"], row["nu"]) for row in rows))
    figure = empty_figure(TWO_COLUMNS, 2.5)
    axes = figure.add_subplot()
    for alpha, nu, method, setting, outcome in cells(rows):
        x, y = flows.index((alpha, nu)), methods.index(method)
        if setting is None:
            text, colour = OUTCOMES[outcome], "white" if outcome == "no_reference" else "#f4a582"
        else:
            text, colour = text_of(method, setting), shade_of(method, setting)
            if method in METHODS and setting > longest_accepted(alpha, nu):
                text = f"({text})"
            text += "*" * (outcome == "deep_overlap")
        axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=colour, edgecolor="white"))
        axes.text(x, y, text, ha="center", va="center", fontsize=SMALL_SIZE)
    axes.set(xlim=(-0.5, len(flows) - 0.5), ylim=(len(methods) - 0.5, -0.5))
    names = [f"{alpha:g}\n{nu:g}" for alpha, nu in flows]
    axes.set_xticks(range(len(flows)), names)
    axes.set_yticks(range(len(methods)), methods)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    axes.text(-0.6, -1.05, r"$\alpha$" + "\n" + r"$\nu$", ha="right", va="center")
    axes.spines[:].set_visible(False)
    axes.set_xlabel(
        r"numbers: $\mathrm{d}t$ in $1/\dot\gamma$; of soft discs $k$ in $m\dot\gamma^2$; "
        "darker: a coarser one suffices; (): maps refuse it as too long\n"
        "*: largest overlap above 0.01 σ; unsolved: solves end above the tolerance; "
        "–: nothing to compare (jammed)",
        fontsize=SMALL_SIZE,
    )
    return figure


def text_of(method: str, setting: float) -> str:
    """A setting as it stands in its cell."""
    if setting == 0:
        return "right"
    mantissa, exponent = f"{setting:.0e}".split("e")
    power = rf"10^{{{int(exponent)}}}"
    return f"${power}$" if mantissa == "1" else rf"${mantissa}\times{power}$"


def shade_of(method: str, setting: float) -> str:
    """Dark where a coarse setting suffices."""
    if setting == 0:
        return "0.75"
    settings = STIFFNESSES if method == SOFT else TIMESTEPS
    return str(0.72 + 0.05 * min(settings.index(setting), 4)) if setting in settings else "0.9"
