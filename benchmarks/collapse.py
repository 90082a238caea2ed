"""What a time step does to an inelastic collapse: three and four equal discs in a row.

Alternate collisions of neighbours follow a linear law. Let x_k be the speed of approach of
collision k. Then

    x_{k+2} = q (1 + α)/2 x_{k+1} − α x_k,    q = 1 for three discs, and √2 for four that move
    symmetrically,

because a collision passes the share (1 + α)/2 of its approach to the neighbours and turns the rest
around. (Four discs in symmetric motion are two discs and a wall. x of the middle pair is divided by
√2 here.) The roots λ± of λ² − q (1 + α)/2 λ + α = 0 are real below α_c = tan²(π/12) = 7 − 4√3 =
0.0718 for three discs (Zhou and Kadanoff, Phys. Rev. E 54, 623, 1996), and below α_c = tan²(π/8) =
3 − 2√2 = 0.1716 for these four (Bernu and Mazighi, J. Phys. A 23, 5745, 1990, for discs and a
wall). What follows:

- Above α_c there are at most ⌈π/θ⌉ collisions, cos θ = q (1 + α)/(4√α), whatever the start.
- Below α_c some starts collapse. The time between collisions falls by λ₋/λ₊ and the speed by λ₊ at
  each. A time step ends the collapse with one collision of all, where that time is as short. So the
  steps with contacts grow by 1/log₁₀(λ₊/λ₋) for each decade of dt, and the excess of the force
  ratio falls as dt^β, β = ln(1/λ₊)/ln(λ₊/λ₋).

Three discs collapse below α_c if, and only if, the third disc leaves the second more slowly than λ₊
times the first approach. The starts here do: the outer discs come in at equal speeds. Four discs
keep their symmetry. Counts are averaged over many first gaps, as each alone is a staircase.

    python -m benchmarks collapse           # a minute
    python -m benchmarks collapse --quick   # fewer gaps, under half a minute
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.plotting.style import RATIO_LABEL, TWO_COLUMNS, styled

THRESHOLDS = {3: 7 - 4 * np.sqrt(3), 4: 3 - 2 * np.sqrt(2)}
RESTITUTIONS = {3: (0.02, 0.04, 0.055, 0.08, 0.1, 0.2), 4: (0.05, 0.1, 0.13, 0.18, 0.2, 0.3)}
GAP, DURATION = 0.1, 0.5  # σ, and σ over the first speed: the first flight takes a tenth
EXACT = jg.BarzilaiBorwein(tolerance=1e-12, max_steps=100_000)
GRAINS, SIDE = 32, 20.0  # the discs that are not in the row rest elsewhere
TIMESTEPS = 10.0 ** -np.arange(2, 8.25, 0.5)  # σ over the first speed
COARSE, FINE = 1e-4, 3e-8  # time steps between which the laws of vanishing dt are measured
LAWS = (
    "most_steps",
    "steps_per_decade",
    "exponent",
)  # what is measured above, and below the threshold
TITLES = {
    3: r"three discs, $\alpha_\mathrm{c} = 7-4\sqrt{3} = 0.0718$",
    4: r"four discs, symmetric, $\alpha_\mathrm{c} = 3-2\sqrt{2} = 0.1716$",
}
LEAST = 1e-6  # smallest excess that is drawn
MIDDLE = 7  # time step through which the lines of the exact slopes are drawn

advance = jax.jit(jg.advance)


class Roots(NamedTuple):
    """λ₊ and λ₋ of a collapse, the steps with contacts that a decade of dt adds, and the exponent β
    of the excess.
    """

    larger: float
    smaller: float

    @property
    def steps_per_decade(self) -> float:
        return 1 / np.log10(self.larger / self.smaller)

    @property
    def exponent(self) -> float:
        return -np.log(self.larger) / np.log(self.larger / self.smaller)


def half_trace(discs: int, restitution: float) -> float:
    """Half the sum of the roots, q (1 + α)/4."""
    return {3: 1.0, 4: np.sqrt(2)}[discs] * (1 + restitution) / 4


def roots(discs: int, restitution: float) -> Roots:
    """The roots below the threshold."""
    half = half_trace(discs, restitution)
    width = np.sqrt(half**2 - restitution)
    return Roots(half + width, half - width)


def most_collisions(discs: int, restitution: float) -> int:
    """Alternate collisions that any start can have, above the threshold; for four discs both outer
    ones count once.
    """
    return int(np.ceil(np.pi / np.arccos(half_trace(discs, restitution) / np.sqrt(restitution))))


def row(discs: int, gap: float) -> jg.State:
    """Three or four discs in a row, the middle gap or the second one given; the outer discs come in
    at speed one.
    """
    gaps, velocities = {3: ((GAP, gap), (1, 0, -1)), 4: ((GAP, gap, GAP), (1, 0, 0, -1))}[discs]
    others = np.arange(GRAINS - discs)
    rest = np.stack([2.0 + 2 * (others % 8), 10 + 2 * (others // 8)], axis=-1)
    line = np.stack([5 + np.cumsum([0, *(1 + np.array(gaps))]), np.full(discs, 4.0)], axis=-1)
    laboratory = np.zeros((GRAINS, 2))
    laboratory[:discs, 0] = velocities
    grains = jg.Grains(jnp.full(GRAINS, 0.5), jnp.ones(GRAINS))
    places = jnp.asarray(np.concatenate([line, rest]))
    return jg.State(grains, places, jnp.asarray(laboratory), jnp.asarray(SIDE), jnp.asarray(0.0))


def steps_and_excess(
    restitution: float, timestep: float, states: Sequence[jg.State], advance: Callable = advance
) -> tuple[np.ndarray, np.ndarray]:
    """Steps with contacts, and excess of the force ratio, of every start; arrays (states,).

    Args:
      advance: of a flow, a state and a number of steps, compiled.
    """
    fraction = GRAINS * np.pi / 4 / SIDE**2
    flow = jg.ShearFlow(GRAINS, restitution, fraction, timestep, shear_rate=0.0)
    steps = jnp.int32(round(DURATION / timestep))
    tallies = [advance(flow, state, steps, solver=EXACT)[1] for state in states]
    if any(int(tally.status) for tally in tallies):
        raise RuntimeError("a contact solve has failed.")
    return np.array([[float(t.solves), float(t.impulse / t.binary_impulse) - 1] for t in tallies]).T


def run(output: Output) -> None:
    """Measure all rows, print slopes and exponents beside the exact ones, and write JSON and
    PNG.
    """
    gaps = GAP * np.geomspace(0.5, 2, 16 if output.quick else 128)
    rows = [study(discs, r, gaps) for discs, several in RESTITUTIONS.items() for r in several]
    print(
        "discs      α   steps with contacts, at most   steps that a decade adds   exponent of the "
        "excess"
    )
    for row in rows:
        print(
            f"{row['discs']:5d}{row['restitution']:7g}   "
            + "   ".join(table_cell(law, row.get(law)) for law in LAWS)
        )
    choices = {
        "first_gap": GAP,
        "second_gap": (gaps[0], gaps[-1]),
        "starts": len(gaps),
        "duration": DURATION,
        "slopes_between": (COARSE, FINE),
        "thresholds": THRESHOLDS,
    }
    output.write_rows("collapse", {"run": choices, "timesteps": list(TIMESTEPS)}, "rows", rows)
    output.write_picture(draw(rows), "collapse")


def table_cell(law: str, values: tuple | None) -> str:
    """A measured number with its error beside the exact one, as text of fixed width; empty where it
    does not apply.
    """
    if values is None:
        return " " * 26
    if law == "most_steps":
        return f"{values[0]:10g} (bound {values[1]:3d})     "
    return "{:8.3f} ± {:5.3f} ({:6.3f})".format(*values) + " "


def study(discs: int, restitution: float, gaps: np.ndarray) -> dict:
    """Means over the starts at each time step, and the law of vanishing dt, measured and exact."""
    states = [row(discs, gap) for gap in gaps]
    steps, excess = np.stack(
        [steps_and_excess(restitution, dt, states) for dt in TIMESTEPS], axis=1
    )
    result = {"discs": discs, "restitution": restitution}
    for name, values in (("steps", steps), ("excess", excess)):
        result[name] = list(values.mean(axis=1))
        result[f"{name}_error"] = list(values.std(axis=1, ddof=1) / np.sqrt(len(gaps)))
    if restitution > THRESHOLDS[discs]:
        return result | {"most_steps": (float(steps.max()), most_collisions(discs, restitution))}
    exact = roots(discs, restitution)
    for name, values in zip(
        ("steps_per_decade", "exponent"), slopes(exact, restitution, states), strict=True
    ):
        error = values.std(ddof=1) / np.sqrt(len(gaps))
        result[name] = (float(values.mean()), float(error), float(getattr(exact, name)))
    return result


def slopes(
    exact: Roots, restitution: float, states: Sequence[jg.State], advance: Callable = advance
) -> tuple[np.ndarray, np.ndarray]:
    """Steps that a decade of dt adds, and exponent of the excess, of each start.

    The two time steps are a whole number of collisions apart, λ₋/λ₊ each, so that the staircases
    are at equal heights.
    """
    collisions = int(np.log(COARSE / FINE) / np.log(exact.larger / exact.smaller))
    decades = collisions * np.log10(exact.larger / exact.smaller)
    coarse, fine = (
        steps_and_excess(restitution, dt, states, advance) for dt in (COARSE, COARSE / 10**decades)
    )
    return (fine[0] - coarse[0]) / decades, np.log10(coarse[1] / fine[1]) / decades


@styled
def draw(rows: list[dict]) -> Figure:
    """Steps and excess against dt, a column for each number of discs; lines of the exact slopes
    below the threshold.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 4.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey="row")
    for column, discs in enumerate(RESTITUTIONS):
        rows_of_discs = [row for row in rows if row["discs"] == discs]
        for k, row in enumerate(rows_of_discs):
            collapses = row["restitution"] < THRESHOLDS[discs]
            style = {
                "color": ("black", "tab:blue", "tab:red")[k % 3],
                "marker": "osD"[k % 3],
                "markersize": 3.5,
                "markerfacecolor": None if collapses else "white",
                "linestyle": "none" if collapses else ":",
                "label": rf"$\alpha={row['restitution']:g}$",
            }
            steps, excess = np.array(row["steps"]), np.array(row["excess"])
            drawn = excess > LEAST
            panels[0, column].errorbar(TIMESTEPS, steps, row["steps_error"], **style)
            error = np.minimum(row["excess_error"], 0.9 * excess)[drawn]
            panels[1, column].errorbar(TIMESTEPS[drawn], excess[drawn], error, **style)
            if collapses:
                exact = roots(discs, row["restitution"])
                decades = np.log10(TIMESTEPS / TIMESTEPS[MIDDLE])
                lines = (
                    steps[MIDDLE] - exact.steps_per_decade * decades,
                    excess[MIDDLE] * 10 ** (exact.exponent * decades),
                )
                for axes, line in zip(panels[:, column], lines, strict=True):
                    axes.plot(TIMESTEPS, line, color=style["color"], linewidth=0.8)
        panels[0, column].set_title(TITLES[discs])
        panels[0, column].legend(ncols=2, title=r"filled: below $\alpha_\mathrm{c}$, open: above")
        panels[1, column].set_xlabel(r"time step $\mathrm{d}t$ ($\sigma$ over the first speed)")
    panels[0, 0].set(xscale="log", ylim=(0, 30), ylabel="steps with contacts")
    panels[1, 0].set(yscale="log", ylim=(LEAST, 2), ylabel=f"excess of the {RATIO_LABEL} $- 1$")
    return figure
