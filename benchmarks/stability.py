"""Where methods fail: pressure, shear stress and force ratio of many flows by many methods, with
what the program itself says of them.

The flows go from loose and nearly elastic to dense, dissipative and jammed ones, and one dense flow
is repeated with few grains, many grains and a mass ratio of 100. Every method shears the same three
steady states on until the standard errors of pressure and shear stress are at most ``PRECISION``,
that of the reference included, or until one of them is wrong beyond doubt, or until its time is up
(``SECONDS``). One criterion holds: an average is right if it is within ``RIGHT`` of the reference.
Where its standard error is larger than ``PRECISION`` it is right or wrong only if the interval of
two standard errors is, and otherwise undecided.
The reference is the Gauss–Seidel loop of ``independent.contact_dynamics``, which shares no code
with jaxgran, at a time step and a tolerance far below those of the methods. For the force ratio,
which depends on the time step in dense flows, its time step is shorter still.

Beside each error stands the status that ``jg.sample`` gives such a sample, by its mean overlap.
What is wrong without a status is a silent error; soft discs have no status, and so all their errors
are silent.

    python -m benchmarks stability            # about two hours on two cores
    python -m benchmarks stability --quick    # two flows of 64 grains, about two minutes
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

import jaxgran as jg
from benchmarks.cores import on_all_cores
from benchmarks.output import Output
from benchmarks.peers import event_driven, lammps, numba_rival
from benchmarks.peers.jaxgran_itself import discs_of
from benchmarks.peers.problem import Flow, Run, Stress, averages, relative
from jaxgran.plotting.style import SMALL_SIZE, TWO_COLUMNS, empty_figure, scientific, styled
from jaxgran.sampling.averages import averages as averages_of_sums
from jaxgran.sampling.timestep import deepest_overlap

ONE_CORE = True

RIGHT = 0.05  # relative error of an average
PRECISION = 0.01  # relative standard error, that of the reference included
REFERENCE_PRECISION = 0.006  # that of the reference alone
DOUBT = 4.0  # standard errors beyond ``RIGHT`` after which a sample may end
SECONDS = 120.0  # of processor time, for all seeds of a method
REFERENCE_SECONDS = 400.0
STRESSES = ("pressure", "shear_stress")
JAMMED = 0.84


@dataclass(frozen=True)
class Case:
    """A flow, its grains, and the ratio of the largest to the smallest mass where masses do not
    follow from the diameters.
    """

    restitution: float
    packing_fraction: float
    grains: int = 256
    mass_ratio: float | None = None

    @property
    def block(self) -> float:
        """Strain of a block, in which a flow of any size scatters about as much."""
        return min(20.0, max(1.0, 5 * 256 / self.grains))


class Plan(NamedTuple):
    """Flows, seeds, and the fewest blocks of each."""

    cases: tuple[Case, ...]
    seeds: int
    fewest: int


FLOWS = (
    *((0.95, 0.3), (0.9, 0.7), (0.9, 0.8), (0.5, 0.5), (0.5, 0.7), (0.5, 0.8)),
    *((0.5, 0.82), (0.5, 0.83), (0.5, JAMMED), (0.1, 0.5), (0.1, 0.7), (0.1, 0.8)),
)
VARIANTS = (Case(0.5, 0.8, 64), Case(0.5, 0.8, 4096), Case(0.5, 0.8, mass_ratio=100.0))
FULL = Plan((*(Case(*flow) for flow in FLOWS), *VARIANTS), 3, 8)
QUICK = Plan((Case(0.8, 0.6, 64), Case(0.5, JAMMED, 64)), 2, 4)
TRANSIENT = 5.0  # strain that is left out, in which a flow takes on the errors of a method
PARTS = 12  # of the first block, each as long as all before it, so that what fails ends early
TIMESTEPS = (1e-2, 3e-3, 1e-3, 3e-4)
TIMESTEP = 1e-3  # of the other solvers and engines
REFERENCE_TIMESTEP, FORCE_TIMESTEP = 3e-5, 1e-5
STIFFNESSES = (1e5, 1e6, 1e7)

advance = jax.jit(jg.advance, static_argnames="engine")
pack = jax.jit(jg.pack)


@dataclass(frozen=True)
class JacobiDiagonal(jg.Jacobi):
    """``Jacobi`` with D = diag(W), the classical choice, which does not bound W and diverges in
    dense flows.
    """

    def bound(self, operator):
        return operator.diagonal()


DEFAULT, EVENT_DRIVEN, SOFT = "default", "event-driven", "soft discs, LAMMPS"
METHODS: dict[str, tuple[tuple[float, ...], dict[str, Any]]] = {  # of contact dynamics
    DEFAULT: (TIMESTEPS, {}),
    "JAX engine": ((TIMESTEP,), {"engine": jg.Jax()}),
    "single precision": ((TIMESTEP,), {"dtype": "float32"}),
    "Nesterov": ((TIMESTEP,), {"solver": jg.Nesterov()}),
    "Jacobi, bound of W": ((TIMESTEP,), {"solver": jg.Jacobi()}),
    "Jacobi, diag W": ((TIMESTEP,), {"solver": JacobiDiagonal(relaxation=1.0)}),
}
PEERS = {EVENT_DRIVEN: ((0.0,), event_driven), SOFT: (STIFFNESSES, lammps)}


class Failure(Exception):
    """The word for what ended a run."""


def run(output: Output) -> None:
    """Measure all flows on all cores, print what is found, and write JSON and PNG.

    Flows that are done are kept for a second run of the same commit.
    """
    plan = QUICK if output.quick else FULL
    kept = output.unfinished("stability")
    measure = partial(rows_of, plan)
    results = on_all_cores(measure, plan.cases, lambda case: case.packing_fraction, kept)
    rows = [row for _, some in results for row in some]
    head = {"seeds": plan.seeds, "right": RIGHT, "precision": PRECISION, "seconds": SECONDS}
    head |= {"references": [reference for reference, _ in results]}
    output.write_json("stability", head | {"rows": rows})
    output.write_picture(draw(rows), "stability")


def case_of(row: dict) -> Case:
    return Case(*(row[name] for name in Case.__dataclass_fields__))


def rows_of(plan: Plan, case: Case) -> tuple[dict, list[dict]]:
    """The reference of a flow, and what becomes of it by every method and setting.

    =================  ====  ====================================================================
    key                unit  meaning
    =================  ====  ====================================================================
    fields of ``Case``       where
    method, setting    –     a key of ``METHODS`` or ``PEERS``; its dt in 1/γ̇ or k in mγ̇²
    failure            –     what ended the run: a status, "too_slow", or the words of a peer
    strain             –     that was sampled, over all seeds
    largest_overlap    σ     of a contact, by contact dynamics, and the mean in ``mean_overlap``
    pressure, …        –     relative error with its standard error, None where nothing was sampled
    =================  ====  ====================================================================
    """
    states = [start(case, seed) for seed in range(plan.seeds)]
    right = None if case.packing_fraction == JAMMED else reference(plan, case, states)
    ways = {
        (method, setting): partial(ContactDynamics, case, timestep=setting, **chosen)
        for method, (settings, chosen) in METHODS.items()
        for setting in settings
    } | {
        (method, setting): partial(peer_run, peer, case, setting)
        for method, (settings, peer) in PEERS.items()
        for setting in (() if peer.missing() else settings)
    }
    rows = []
    for (method, setting), begin in ways.items():
        found = measured(plan, case, [partial(begin, state) for state in states], right)
        rows.append({**asdict(case), "method": method, "setting": setting, **found})
        print(rows[-1], flush=True)
    return {**asdict(case), **(right or {})}, rows


def reference(plan: Plan, case: Case, states: Sequence[jg.State]) -> dict[str, tuple[float, float]]:
    """Pressure, shear stress and force ratio by the loop, with standard errors."""
    found = {}
    for timestep, names in ((REFERENCE_TIMESTEP, STRESSES), (FORCE_TIMESTEP, ("force_ratio",))):
        flow = Flow(case.restitution, case.packing_fraction)
        begun = flow, "reference", timestep, case.block
        runs = [numba_rival.begin(discs_of(state), *begun) for state in states]
        _warm_up(runs, case, math.inf)

        def precise(values: dict, names: tuple[str, ...] = names) -> bool:
            return all(values[x][1] <= REFERENCE_PRECISION * abs(values[x][0]) for x in names)

        values = averages(_sampled(plan, runs, precise, REFERENCE_SECONDS))
        found |= {name: values[name] for name in names}
    print(case, "reference", found, flush=True)
    return found


def measured(plan: Plan, case: Case, begins: Sequence[Callable[[], Any]], right: Any) -> dict:
    """What a method makes of a flow: the keys of a row from ``failure`` on."""
    runs, blocks, failure = [], [], None

    def decided(values: dict) -> bool:
        if right is None:
            return True
        errors = [relative(values[name], right[name]) for name in STRESSES]
        return max(noise for _, noise in errors) <= PRECISION or any(
            abs(error) - RIGHT > DOUBT * noise for error, noise in errors
        )

    try:
        runs.extend(begin() for begin in begins)
        _warm_up(runs, case, SECONDS)
        blocks = _sampled(plan, runs, decided, SECONDS)
        if not decided(averages(blocks)):
            failure = "too_slow"
    except Failure as stopped:
        failure = str(stopped)
    except Exception as stopped:  # of a program that is not ours to mend
        failure = str(stopped) or type(stopped).__name__
    for one in runs:
        one.close()
    row = {"failure": failure, "mean_overlap": None, "largest_overlap": None}
    row["strain"] = case.block * sum(map(len, blocks))
    if tallies := [x.tally for x in runs if getattr(x, "tally", None) is not None]:
        total = sum(tallies[1:], start=tallies[0])
        row["mean_overlap"] = float(total.overlap / max(total.contacts, 1))
        row["largest_overlap"] = float(total.largest_overlap)
    if blocks and right is not None:
        values = averages(blocks)
        row |= {name: relative(values[name], right[name]) for name in right if name in values}
    return row


def _warm_up(runs: Sequence[Any], case: Case, limit: float) -> None:
    """Leave out the transient of every seed, and what is compiled in it.

    Raises:
      Failure: it takes longer than a sample may.
    """
    begin = time.process_time()
    for one in runs:
        for _ in range(math.ceil(TRANSIENT / case.block)):
            one.advance()
            if time.process_time() - begin > limit:
                raise Failure("too_slow")


def _sampled(plan: Plan, runs: Sequence[Any], enough: Callable, limit: float) -> list[list[Stress]]:
    """Blocks of every seed until their averages are enough, or the processor time is up."""
    blocks: list[list[Stress]] = [[] for _ in runs]
    begin, target = time.process_time(), plan.fewest
    while True:
        for known, one in zip(blocks, runs, strict=True):
            known.append(one.advance())
        if time.process_time() - begin > limit:
            return blocks
        if len(blocks[0]) >= target:
            if enough(averages(blocks)):
                return blocks
            target = math.ceil(1.15 * target)


# ----------------------------------------------------------------------------------------------
# methods


def flow_of(case: Case, timestep: float, dtype: str = "float64") -> jg.ShearFlow:
    """A flow in a precision, also at a packing fraction that is jammed and therefore refused."""
    flow = jg.ShearFlow(case.grains, case.restitution, 0.5, timestep)
    flow = jax.tree_util.tree_map_with_path(
        lambda path, x: case.packing_fraction if path[-1].name == "packing_fraction" else x, flow
    )
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), flow)


def start(case: Case, seed: int) -> jg.State:
    """A steady state, or a packing at the jammed density whose grains have a thermal speed of
    10 σγ̇.
    """
    grains = None
    if case.mass_ratio is not None:
        quantiles = np.random.default_rng(seed).permutation(case.grains) / (case.grains - 1)
        equal = jax.tree.map(np.asarray, pack(flow_of(case, 1e-3), jax.random.key(seed))[0].grains)
        grains = jg.own_grains(2 * equal.radii, case.mass_ratio ** (quantiles - 0.5))
    if case.packing_fraction != JAMMED:
        flow = jg.ShearFlow(case.grains, case.restitution, case.packing_fraction, 3e-4)
        return jg.prepare(flow, jax.random.key(seed), grains=grains)
    keys = map(jax.random.key, range(10 * seed, 10 * seed + 10))
    packings = (pack(flow_of(case, 1e-3), key) for key in keys)
    state = next(state for state, packed in packings if packed)
    masses = np.asarray(state.grains.masses)[:, None]
    velocities = np.random.default_rng(seed).normal(size=state.velocities.shape) / np.sqrt(masses)
    velocities -= np.sum(masses * velocities, axis=0) / np.sum(masses)
    return replace(state, velocities=jnp.asarray(10 * velocities))


class ContactDynamics:
    """A run of jaxgran in some way, like ``problem.Run``, with the sums of all that it sampled."""

    def __init__(
        self,
        case: Case,
        state: jg.State,
        timestep: float,
        dtype: str = "float64",
        solver: jg.ProjectedMethod | None = None,
        engine: Any = None,
    ) -> None:
        self.case, self.flow = case, flow_of(case, timestep, dtype)
        self.state = jax.tree.map(lambda x: x.astype(dtype), state)
        self.solver = jax.tree.map(
            lambda x: jnp.asarray(x, "int32" if isinstance(x, int) else dtype),
            solver or jg.BarzilaiBorwein(),
        )
        self.engine = engine
        self.steps = round(case.block / timestep)
        self.tally: jg.Tally | None = None

    def advance(self) -> Stress:
        """The averages of a block.

        Raises:
          Failure: it has a status that ends a run, or the time is up.
        """
        begin, tallies = time.process_time(), []
        for steps in self.pieces():
            self.state, tally = advance(
                self.flow, self.state, jnp.int32(steps), solver=self.solver, engine=self.engine
            )
            tallies.append(jax.tree.map(np.asarray, tally))
            status = jg.Status(int(tally.status))
            if status != jg.Status.ok:
                raise Failure(status.name)
            if time.process_time() - begin > SECONDS:
                raise Failure("too_slow")
        block = sum(tallies[1:], start=tallies[0])
        self.tally = block if self.tally is None else self.tally + block
        area, rate = np.asarray(self.state.side) ** 2, np.asarray(self.flow.shear_rate)
        mean = averages_of_sums(block, area, self.case.grains, rate)
        return Stress(*(float(mean[name]) for name in Stress._fields))

    def pieces(self) -> list[int]:
        """The steps of a block; the first is in parts, each as long as all before it, so that what
        fails ends early.
        """
        if self.tally is not None:
            return [self.steps]
        edges = np.ceil(self.steps / 2.0 ** np.arange(PARTS)).astype(int)
        return np.diff(np.unique([0, *edges])).tolist()

    def close(self) -> None:
        """Nothing is open."""


def peer_run(peer: Any, case: Case, setting: float, state: jg.State) -> Run:
    """A run of another program; inelastic hard discs may collapse in it."""
    curve = next(iter(peer.CURVES))
    flow = Flow(case.restitution, case.packing_fraction)
    return peer.begin(discs_of(state), flow, curve, setting, case.block)


# ----------------------------------------------------------------------------------------------
# figure

OF_TWO, OF_THREE = 0.27, 0.38  # inches: height of a row with two or three lines of text
# Colours of a cell, and what they say
RIGHT_OK, RIGHT_WARNED, WRONG_WARNED, WRONG_SILENT, FAILED, UNDECIDED = (
    *("#d9e6d2", "#fff2b3", "#f7c77f", "#d7301f", "#d9d9d9", "white"),
)
MEANINGS = {
    RIGHT_OK: f"within {100 * RIGHT:.0f} %",
    RIGHT_WARNED: "within, status deep_overlap",
    WRONG_WARNED: "wrong, status deep_overlap",
    WRONG_SILENT: "wrong, no status",
    FAILED: "failed with a message",
    UNDECIDED: "undecided",
}
LETTERS = {
    EVENT_DRIVEN: ("c", "inelastic collapse"),
    SOFT: ("g", "gives up"),
    "too_slow": ("s", "slow"),
    "iteration_limit": ("u", "unsolved"),
    "infeasible": ("j", "jammed"),
    "nonfinite": ("n", "not finite"),
    "runs": ("r", "runs, no reference"),
}
"""What stands in a cell without an error, and what it means."""


def status_of(row: dict) -> str | None:
    """The status of a sample, as ``jg.sample`` gives it; None by other programs, and without a
    sample.
    """
    if row.get("mean_overlap") is None:
        return None
    deep = row["mean_overlap"] > deepest_overlap(row["packing_fraction"], row["grains"])
    return "deep_overlap" if deep else "ok"


def cell_of(row: dict, names: Sequence[str]) -> tuple[str, str]:
    """Text and colour: the largest of the errors in per cent, above a standard error of more than
    ``PRECISION``, or the letter of a failure.
    """
    if row["failure"] is not None and row["failure"] != "too_slow":
        word = row["method"] if row["method"] in LETTERS else row["failure"]
        return LETTERS.get(word, (word,))[0], FAILED
    errors = [row[name] for name in names if row.get(name)]
    warned = status_of(row) == "deep_overlap"
    if not errors:
        if row["failure"]:
            return LETTERS["too_slow"][0], FAILED
        return LETTERS["runs"][0], WRONG_WARNED if warned else UNDECIDED
    error, noise = max(errors, key=lambda pair: abs(pair[0]))
    text = f"{100 * error:+.0f}" if abs(error) >= 0.0995 else f"{100 * error:+.1f}"
    text = text.replace("-", "−")
    if not noise <= PRECISION:
        text += f"\n±{100 * noise:.2g}"
        if not abs(abs(error) - RIGHT) >= 2 * noise:
            return text, UNDECIDED
    colours = (WRONG_SILENT, WRONG_WARNED), (RIGHT_OK, RIGHT_WARNED)
    return text, colours[abs(error) <= RIGHT][warned]


@styled
def draw(rows: list[dict]) -> Figure:
    """A table: methods and settings by flows."""
    cases = sorted({case_of(row) for row in rows}, key=[*FULL.cases, *QUICK.cases].index)
    lines = [
        (method, setting, STRESSES, title(method, setting))
        for method, (settings, _) in (PEERS | METHODS).items()
        for setting in settings
        if any(row["method"] == method for row in rows)
    ]
    lines += [
        (DEFAULT, setting, ("force_ratio",), f"force ratio, {title('', setting)}")
        for setting in TIMESTEPS
    ]
    heights = [OF_THREE if line[::2] == (DEFAULT, STRESSES) else OF_TWO for line in lines]
    edges = np.cumsum([0.0, *heights])
    figure, letters = empty_figure(TWO_COLUMNS, 1.35 + edges[-1]), set()
    axes = figure.add_subplot()
    at = {(case_of(row), row["method"], row["setting"]): row for row in rows}
    for (method, setting, names, _), top, height in zip(lines, edges, heights, strict=False):
        for x, case in enumerate(cases):
            row = at[case, method, setting]
            text, colour = cell_of(row, names)
            letters.add(text)
            if height == OF_THREE and row["largest_overlap"] is not None:
                text += f"\n{row['largest_overlap']:.1g}".replace("0.", ".")
            axes.add_patch(Rectangle((x - 0.5, top), 1, height, fc=colour, ec="white"))
            look = {"color": "white" if colour == WRONG_SILENT else "black", "linespacing": 0.9}
            place = {"ha": "center", "va": "center", "fontsize": SMALL_SIZE}
            axes.text(x, top + height / 2, text, **place, **look)
    axes.set(xlim=(-0.5, len(cases) - 0.5), ylim=(edges[-1], 0))
    axes.set_xticks(range(len(cases)), [name_of(case) for case in cases], fontsize=SMALL_SIZE)
    words = [line[-1] for line in lines]
    axes.set_yticks((edges[1:] + edges[:-1]) / 2, words, fontsize=SMALL_SIZE)
    axes.tick_params(length=0, labeltop=True, labelbottom=False)
    corner = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "bottom"}
    corner |= {"ha": "right", "fontsize": SMALL_SIZE}
    axes.annotate("$\\alpha$\n$\\nu$\n$N$", (0, 1), (-3, 4), **corner)
    axes.spines[:].set_visible(False)
    known = "; ".join(f"{x}: {meaning}" for x, meaning in LETTERS.values() if x in letters)
    meaning = "error in %, standard error above 1 %, largest overlap in σ (jaxgran)"
    figure.legend(
        handles=[Patch(fc=colour, ec="0.6", lw=0.5, label=x) for colour, x in MEANINGS.items()],
        loc="outside lower center",
        ncols=3,
        title=f"{meaning}; {known}",
        fontsize=SMALL_SIZE,
        title_fontsize=SMALL_SIZE,
    )
    return figure


def name_of(case: Case) -> str:
    """α, ν and N, or a mass ratio in its place, one above the other."""
    last = f"{case.grains}" if case.mass_ratio is None else f"1:{case.mass_ratio:g}"
    return f"{case.restitution:g}\n{case.packing_fraction:g}\n{last}"


def title(method: str, setting: float) -> str:
    """A method with its setting, or the setting alone."""
    method = "jaxgran" if method == DEFAULT else method
    if setting == 0:
        return method
    number = scientific(setting).replace("{}", "")
    name = "k" if method == SOFT else r"\mathrm{d}t"
    return f"{method}{', ' if method else ''}${name}={number}$"
