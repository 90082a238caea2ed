"""What fails first as the time step grows and the packing becomes dense, and where nothing fails.

For every restitution α and packing fraction ν a flow of 128 grains is brought to its steady state
at a fine time step. From that state it is sheared by a half (at least 20 steps, at most 3000) at
each time step, by the default solver and by three that fail earlier. The parameters go beyond what
the package accepts. Each cell of the figure shows what failed first at α = 0.5; its vertical axis
is dt √T / σ, the distance that a grain of thermal speed moves in one step.

The steps of a cell are done in ten parts, each as long as all before it, and it ends with the first
part that fails. Only deep overlaps do not end it. In the part that fails the worst failure counts,
in the order of ``OUTCOMES``. An energy gain is a negative dissipation, or kinetic energy beyond the
shear work less the dissipation.

    python -m benchmarks stability            # about 5 minutes on one core
    python -m benchmarks stability --quick    # about half a minute
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.contact.delassus import diagonal
from jaxgran.dynamics.batch import stack
from jaxgran.maps.settings import MapSettings
from jaxgran.model.checks import InputError
from jaxgran.model.status import DEEP_OVERLAP
from jaxgran.plotting.style import LABEL_SIZE, SMALL_SIZE, TWO_COLUMNS, scientific, styled
from jaxgran.sampling.averages import averages
from jaxgran.sampling.prediction import predicted

RESTITUTIONS = (0.0, 0.5, 0.9)
PACKING_FRACTIONS = (0.3, 0.5, 0.6, 0.7, 0.75, 0.8, 0.82, 0.83, 0.835, 0.84)
CROSSINGS = (1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)  # dt √T / σ
COARSE_GRID = (
    (0.3, 0.6, 0.75, 0.8, 0.82, 0.83, 0.84),
    CROSSINGS[3:9],
)  # of all variants but the default


@dataclass(frozen=True)
class JacobiDiagonal(jg.Jacobi):
    """``Jacobi`` with D = diag(W), the classical choice, which does not bound W and diverges in
    dense flows.
    """

    def bound(self, contacts, grains):
        return diagonal(contacts, grains)


@dataclass(frozen=True)
class JacobiCount(jg.Jacobi):
    """``Jacobi`` with D the numbers of contacts of both grains over their masses (mass splitting),
    which bounds W.

    Source: R. Tonge, F. Benevolenski and A. Voroshilov, ACM Trans. Graph. 31, 105 (2012).
    """

    def bound(self, contacts, grains):
        used = contacts.used.astype(contacts.normals.dtype)
        count = jnp.zeros(grains, used.dtype).at[contacts.i].add(used).at[contacts.j].add(used)
        bound = (
            count[contacts.i] * contacts.inverse_mass_i
            + count[contacts.j] * contacts.inverse_mass_j
        )
        return jnp.where(contacts.used, bound, 1)


VARIANTS = {
    "default": {},
    "Jacobi, ω = 1.8": {"solver": jg.Jacobi(relaxation=1.8)},
    "Jacobi, ω = 2": {
        "solver": jax.tree.map(lambda x: 2.0 if x == 1.8 else x, jg.Jacobi())
    },  # is not accepted
    "Jacobi with diag W, ω = 1": {"solver": JacobiDiagonal(relaxation=1.0)},
    "float32": {"dtype": "float32"},
}
ALPHA = 0.5  # of the figure
DRAWN = {  # variants of the figure and their titles
    "default": "default",
    "Jacobi, ω = 1.8": r"Jacobi, $\omega=1.8$",
    "Jacobi, ω = 2": r"Jacobi, $\omega=2$",
    "Jacobi with diag W, ω = 1": r"Jacobi, diag $W$, $\omega=1$",
}
GRAINS = 128
STRAIN, FEWEST_STEPS, MOST_STEPS, PARTS = 0.5, 20, 3000, 10
PREPARATION = [(0.05, 1e-3)] * 20 + [(0.2, 1e-3)] * 8 + [(0.1, 3e-4)] * 4  # strain, dt √T / σ
GAIN = {
    "float64": 1e-6,
    "float32": 1e-3,
}  # of the energies exchanged; what rounding does not explain

# Mildest first: letter, colour, meaning.
OUTCOMES = {
    "ok": ("·", "1.0", "nothing fails"),
    "iteration_limit": ("i", "0.87", "solve above tolerance"),
    "deep_overlap": ("o", "0.72", r"overlap above $0.01\,\sigma$"),
    "infeasible": ("J", "0.58", "jammed: no impulses exist"),
    "energy_gain": ("E", "0.4", "energy gained"),
    "capacity": ("C", "0.2", "step outruns near pairs"),
    "nonfinite": ("N", "0.05", "not finite"),
}

advance = jax.jit(jg.advance)
pack = jax.jit(jg.pack)


def run(output: Output) -> list[dict]:
    """Measure all cells, write them with their figures, and return them (see ``cell``)."""
    restitutions, packing_fractions, crossings, names = (
        RESTITUTIONS,
        PACKING_FRACTIONS,
        CROSSINGS,
        tuple(VARIANTS),
    )
    if output.quick:
        restitutions, packing_fractions, crossings = (0.5,), (0.6, 0.75, 0.8), (3e-4, 3e-3, 3e-2)
        names = ("default", "float32")
    starts = {
        (alpha, nu): prepared(alpha, nu) for alpha in restitutions for nu in packing_fractions
    }
    cells = []
    for name in names:
        if name != "default" and not output.quick:
            packing_fractions, crossings = COARSE_GRID
        for alpha, nu in ((alpha, nu) for alpha in restitutions for nu in packing_fractions):
            column = [cell(name, alpha, nu, crossing, *starts[alpha, nu]) for crossing in crossings]
            whole = [one["pressure"] for one in column if one["strain"] > 0.99 * STRAIN] or [np.nan]
            ratios = [
                one["pressure"] / whole[0] if one["strain"] > 0.99 * STRAIN else np.nan
                for one in column
            ]
            cells += [
                {**one, "pressure_ratio": ratio} for one, ratio in zip(column, ratios, strict=True)
            ]
            print(
                f"{name:26s} α = {alpha:3g}  ν = {nu:5g}  "
                f"{' '.join(OUTCOMES[c['outcome']][0] for c in column)}"
            )
    head = {"grains": GRAINS, "strain": STRAIN, "steps": [FEWEST_STEPS, MOST_STEPS]}
    output.write_rows("stability", head, "cells", cells)
    output.write_picture(draw(cells), "stability", dpi=200)
    return cells


def unjudged(flow: jg.ShearFlow, **numbers: float) -> jg.ShearFlow:
    """The flow with other numbers that are not judged: leaves of a pytree never are."""
    return jax.tree_util.tree_map_with_path(
        lambda path, value: numbers.get(path[-1].name, value), flow
    )


def flow_of(variant: str, alpha: float, nu: float, **numbers: float) -> jg.ShearFlow:
    """A flow whose numbers are not judged, in the precision of a variant."""
    activation, dtype = (
        VARIANTS[variant].get(name, x)
        for name, x in (("activation", "midpoint"), ("dtype", "float64"))
    )
    flow = jg.ShearFlow(GRAINS, 0.5, 0.5, 1e-3, activation=activation)
    flow = unjudged(flow, restitution=alpha, packing_fraction=nu, **numbers)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), flow)


def solver_of(variant: str) -> jg.ProjectedMethod:
    """The solver of a variant, in its precision."""
    dtype = VARIANTS[variant].get("dtype", "float64")
    solver = VARIANTS[variant].get("solver", jg.BarzilaiBorwein())
    return jax.tree.map(lambda x: jnp.asarray(x, "int32" if isinstance(x, int) else dtype), solver)


def prepared(alpha: float, nu: float) -> tuple[jg.State, float]:
    """A sheared state, the same for all variants, and its temperature in mσ²γ̇², an average over
    the last strain.

    The temperature of theory is a poor start where the flow is dense, so the time step follows the
    temperature.
    """
    for seed in range(10):
        state, found = pack(flow_of("default", alpha, nu), jax.random.key(seed))
        if found:
            break
    masses = np.asarray(state.grains.masses)[:, None]
    velocities = np.random.default_rng(0).normal(size=state.velocities.shape) / np.sqrt(masses)
    velocities -= np.sum(masses * velocities, axis=0) / np.sum(masses)
    theory = jax.tree.map(lambda x: x[0], predicted(stack([flow_of("default", alpha, nu)])))
    state = replace(
        state, velocities=jnp.asarray(velocities * np.sqrt(float(theory.granular_temperature)))
    )
    temperatures = []
    for strain, crossing in PREPARATION:
        dt = crossing / np.sqrt(energy(state) / GRAINS)
        flow = flow_of("default", alpha, nu, timestep=dt)
        state, tally = advance(
            flow, state, jnp.int32(round(strain / dt)), solver=jg.BarzilaiBorwein(max_steps=500)
        )
        temperatures.append(
            float(averages(tally, state.side**2, GRAINS, flow.shear_rate)["granular_temperature"])
        )
    return state, float(np.mean(temperatures[-8:]))


def energy(state: jg.State) -> float:
    """Kinetic energy of the peculiar velocities, mσ²γ̇²; N of them are the temperature."""
    velocities = np.asarray(state.velocities, float)
    return float(np.sum(np.asarray(state.grains.masses, float)[:, None] * velocities**2) / 2)


def cell(
    variant: str, alpha: float, nu: float, crossing: float, state: jg.State, temperature: float
) -> dict:
    """What failed first at one time step, and averages over the steps until then.

    ============================  ==============  ==================================================
    key                           unit            meaning
    ============================  ==============  ==================================================
    variant, alpha, nu            –               where
    crossing, dt, temperature     σ, 1/γ̇, mσ²γ̇²   dt √T, time step, T of the state it started from
    accepted                      –               whether a map accepts this flow
    outcome, failed_after         –               a key of ``OUTCOMES``, the strain to the end of
                                                  the failing part
    strain                        –               that was sheared
    largest_overlap               σ               of a contact
    unconverged, iterations       –               share of the solves above the tolerance, mean
                                                  iterations
    pressure                      mγ̇²             contact and kinetic
    ============================  ==============  ==================================================
    """
    dt = crossing / np.sqrt(temperature)
    flow = flow_of(variant, alpha, nu, timestep=dt)
    precision = flow.timestep.dtype
    state = jax.tree.map(lambda x: x.astype(precision), state)
    total = int(np.clip(np.ceil(STRAIN / dt), FEWEST_STEPS, MOST_STEPS))
    edges = np.unique(np.ceil(total / 2.0 ** np.arange(PARTS)).astype(int))
    outcome, failed_after, whole = "ok", np.nan, None
    for steps, end in zip(np.diff(edges, prepend=0), edges, strict=True):
        before = energy(state)
        state, tally = advance(flow, state, jnp.int32(steps), solver=solver_of(variant))
        whole = tally if whole is None else whole + tally
        now = jg.Status(int(tally.status)).name
        if tally.status <= jg.Status.deep_overlap and tally.largest_overlap > DEEP_OVERLAP:
            now = "deep_overlap"
        if gains(tally, energy(state) - before, GAIN[precision.name] * (before + energy(state))):
            now = max(now, "energy_gain", key=list(OUTCOMES).index)
        if outcome == "ok" and now != "ok":
            outcome, failed_after = now, float(end * dt)
        if now not in ("ok", "deep_overlap"):
            break
    measured = averages(whole, state.side**2, GRAINS, flow.shear_rate)
    return {
        "variant": variant,
        "alpha": alpha,
        "nu": nu,
        "crossing": crossing,
        "dt": float(dt),
        "temperature": temperature,
        "accepted": accepts(alpha, nu, dt),
        "outcome": outcome,
        "failed_after": failed_after,
        "strain": float(whole.duration),
        "largest_overlap": float(whole.largest_overlap),
        "unconverged": float(measured["unconverged_share"]),
        "iterations": float(measured["iterations"]),
        "pressure": float(measured["pressure"]),
    }


def gains(tally: jg.Tally, rise: float, rounding: float) -> bool:
    """Whether a contact law gave energy: dissipation below zero, or more kinetic energy than the
    balance allows.
    """
    work = -float(tally.contact_moment[0, 1] + tally.kinetic_moment[0, 1])  # shear rate one
    dissipation = float(tally.dissipation)
    rounding += 1e-6 * abs(work)
    return dissipation < -rounding or rise > work - dissipation + rounding


def accepts(alpha: float, nu: float, dt: float) -> bool:
    """Whether a map would run this flow."""
    try:
        MapSettings((alpha,), (nu,), grains=GRAINS, timestep=dt, strain=1e4)
    except InputError:
        return False
    return True


@styled
def draw(cells: list[dict]) -> Figure:
    """What failed first at α = 0.5, a panel for each solver; the cells of a map lie below the thick
    line.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 3.1), layout="constrained")
    panels = figure.subplots(1, len(DRAWN), sharex=True, sharey=True)
    coarse = [one for one in cells if one["variant"] == list(DRAWN)[-1]]
    nus, crossings = (sorted({one[name] for one in coarse}) for name in ("nu", "crossing"))
    drawn = [one for one in cells if one["alpha"] == ALPHA and one["variant"] in DRAWN]
    drawn = [one for one in drawn if one["nu"] in nus and one["crossing"] in crossings]
    for axes, (name, title) in zip(panels, DRAWN.items(), strict=True):
        panel(axes, [one for one in drawn if one["variant"] == name], nus, crossings)
        axes.set_title(title)
    panels[0].set_ylabel(r"step of a thermal grain $\Delta t\sqrt{T/m}\,/\sigma$")
    figure.supxlabel(r"packing fraction $\nu$", fontsize=LABEL_SIZE)
    failed = [outcome for outcome in OUTCOMES if outcome in {one["outcome"] for one in drawn}]
    handles: list[Artist] = [
        Patch(
            facecolor=OUTCOMES[name][1],
            edgecolor="0.5",
            label=f"{OUTCOMES[name][0]}  {OUTCOMES[name][2]}",
        )
        for name in failed
    ]
    handles.append(Line2D([], [], color="black", lw=2, label="limit of a map"))
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def panel(axes: Axes, cells: list[dict], nus: list[float], crossings: list[float]) -> None:
    """One field of lettered cells; both axes list their values and are not to scale."""
    for one in cells:
        x, y = nus.index(one["nu"]), crossings.index(one["crossing"])
        letter, shade, _ = OUTCOMES[one["outcome"]]
        axes.add_patch(
            Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=shade, edgecolor="white", lw=0.5)
        )
        ink = "white" if float(shade) < 0.5 else "black"
        axes.text(
            x, y, letter, ha="center", va="center", color=ink, weight="bold", fontsize=SMALL_SIZE
        )
    if {one["variant"] for one in cells} == {"default"}:
        accepted = [
            max(
                [
                    crossings.index(c["crossing"]) + 1
                    for c in cells
                    if c["nu"] == nu and c["accepted"]
                ]
                or [0]
            )
            for nu in nus
        ]
        axes.stairs(
            np.array(accepted) - 0.5,
            np.arange(len(nus) + 1) - 0.5,
            baseline=-0.5,
            color="black",
            lw=2,
        )
    axes.set(xlim=(-0.5, len(nus) - 0.5), ylim=(-0.5, len(crossings) - 0.5))
    axes.set_xticks(range(len(nus)), [f"{nu:g}" for nu in nus], rotation=90)
    axes.set_yticks(range(len(crossings)), [f"${scientific(crossing)}$" for crossing in crossings])
    axes.tick_params(length=0)
