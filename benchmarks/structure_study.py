"""Structure and kinetics of nine flows: what the forces look like, and which assumption of kinetic theory fails where.

Each flow is brought to its steady state and seen at equal distances of strain; the force ratio, the share of clusters
and all that enters Enskog theory are measured from the same snapshots. A second series, at every time step, tells how
long contacts and clusters last. Pairs at contact are extrapolated from two shells of gaps, the usual one and a quarter
of it: where the results differ, the pair density has no value at contact.

    python -m benchmarks structure_study           # about 4 minutes on a core
    python -m benchmarks structure_study --quick   # two flows of 64 grains, about a minute
"""

import time
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.analysis import force_chains, velocity_correlations
from jaxgran.analysis import order as order_module
from jaxgran.analysis.series import Curve, Measured, ratio, series, with_errors
from jaxgran.dynamics.snapshots import Snapshot, snapshot_series
from jaxgran.model.status import Status

SHELLS = (1.0, 0.25)  # over ``contact_shell``
LAGS = (1, 2, 3, 5, 8, 12, 20, 35, 60, 100, 180, 320)  # time steps
FORCES = np.concatenate([np.linspace(0, 2, 9), 2 * 1.25 ** np.arange(1, 10)])  # edges of bins, in mean forces
SIZES = np.array([2, 3, 4, 5, 6, 8, 11, 15, 21, 30, 43, 62, 90, 130, 190, 270, 401])
DISTANCES = (0.35, 1.2, 1.9, 2.6, 3.5, 4.5, 6.0)  # σ
FEWEST_PAIRS = 2000  # of loaded contacts, for a mean of products of forces
STYLES = (("0.0", "o", "-"), ("0.35", "s", "--"), ("0.6", "^", ":"))  # of the restitutions: grey, marker, line
CURVES = {
    "force_distribution": (r"force $F/\langle F\rangle$", r"density $P(F/\langle F\rangle)$", "log"),
    "cluster_sizes": ("grains in a cluster", "share of the clusters", "log"),
    "force_correlation": ("distance of contacts $r$ (σ)", "force correlation $g_F(r)$", "linear"),
    "pair_correlation": ("scaled distance $2r/(d_i+d_j)$", "pair correlation $g$", "log"),
    "cluster_persistence": (r"delay $\tau$ (steps of $10^{-4}/\dot\gamma$)", r"still in one cluster, $C(\tau)$", "log"),
}


class Plan(NamedTuple):
    """Restitutions and packing fractions of the flows, grains, snapshots, strain between two of them, time step."""

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    grains: int
    snapshots: int
    interval: float
    timestep: float


FULL = Plan((0.9, 0.5, 0.1), (0.6, 0.7, 0.8), 400, 1000, 0.01, 1e-4)
QUICK = Plan((0.9, 0.1), (0.7,), 64, 500, 0.01, 1e-4)


def run(output: Output) -> None:
    """Run the plan, print a line for each flow, and write ``structure`` as JSON and two PNG."""
    plan = QUICK if output.quick else FULL
    start, flows = time.perf_counter(), []
    print("   ν    α  force ratio   clusters' P   rate/Enskog   χ/theory  speed²   ⟨cc⟩     a₂   lives (steps)")
    for nu, alpha in product(plan.packing_fraction, plan.restitution):
        flows.append(measured(plan, nu, alpha))
        show = {name: x[0] for name, x in flows[-1]["numbers"].items()}
        print(
            "{0:4.2g} {1:4.2g} {force_ratio:10.3f} {share_pressure:13.3f} {rate_ratio:13.2f} {contact_ratio:10.2f} "
            "{speed_ratio:7.2f} {velocity_correlation:7.2f} {sonine:7.3f} {contact_lifetime:10.2g} "
            "{cluster_lifetime:8.2g}".format(nu, alpha, **show),
            flush=True,
        )
    head = {"plan": plan._asdict(), "shells": SHELLS, "seconds": time.perf_counter() - start}
    output.write_rows("structure", head, "flows", [as_row(flow) for flow in flows])
    output.write_picture(draw_structure(plan, flows), "structure", dpi=120)
    output.write_picture(draw_chaos(plan, flows), "structure", "_chaos.png", dpi=120)


def measured(plan: Plan, nu: float, alpha: float) -> dict:
    """Everything about one flow: ``numbers`` (value and standard error) and ``curves``."""
    flow = jg.ShearFlow(plan.grains, alpha, nu, plan.timestep)
    state = jg.prepare(flow, jax.random.key(0), equilibrate=max(5.0, 2 / (nu * (1 - alpha**2))))
    state, apart = snapshot_series(flow, state, plan.snapshots * plan.interval, plan.snapshots)
    state, successive = snapshot_series(flow, state, plan.snapshots * plan.timestep, plan.snapshots)
    seen, successive = series(apart), series(successive)
    few = jax.tree.map(lambda x: x[::4], seen)  # for what changes slowly

    velocities, share, fabric = (
        measure(seen)
        for measure in (velocity_correlations.velocity_distribution, force_chains.cluster_share, force_chains.fabric)
    )
    near, closer = (
        velocity_correlations.near_contact(seen, share * velocity_correlations.contact_shell(nu)) for share in SHELLS
    )
    lasting = force_chains.persistence(successive, 1.0, [lag for lag in LAGS if lag < plan.snapshots])
    order, touching = order_module.hexatic_order(few), order_module.coordination(few)
    numbers = {
        "force_ratio": force_ratio(seen),
        "contact_lifetime": lasting.contact_lifetime,
        "cluster_lifetime": lasting.cluster_lifetime,
        "hexatic_overall": order.overall,
        "hexatic_local": order.local,
        "loaded_contacts_per_grain": touching.loaded,
        "touching_per_grain": touching.touching,
        **{f"share_{name}": x for name, x in share._asdict().items()},
        **{f"fabric_{name}": x for name, x in fabric._asdict().items() if x.value.ndim == 0},
        **{name: x for name, x in velocities._asdict().items() if isinstance(x, Measured) and x.value.ndim == 0},
        "small_over_large": small_over_large(velocities),
        **{name: x for name, x in near._asdict().items() if x.value.ndim == 0},
        **{f"{name}_closer": x for name, x in closer._asdict().items() if x.value.ndim == 0},
    }
    curves = {
        "force_distribution": force_chains.force_distribution(seen, FORCES),
        "cluster_sizes": force_chains.cluster_sizes(seen, SIZES),
        "force_correlation": force_correlation(seen),
        "pair_correlation": order_module.pair_correlation(few, 1 + np.linspace(0, 0.2, 21)),
        "contact_persistence": lasting.contact,
        "cluster_persistence": lasting.cluster,
    }
    status = Status(max(int(x.status.max()) for x in (seen, successive))).name
    return {"packing_fraction": nu, "restitution": alpha, "status": status, "numbers": numbers, "curves": curves}


def force_correlation(seen: Snapshot) -> Curve:
    """The correlation of forces, NaN where there are too few pairs of contacts to tell."""
    loaded = np.sum(np.asarray(seen.impulses) > 0, axis=1)
    edges = np.array([r for r in DISTANCES if r < seen.state.side[0] / 2])
    curve = force_chains.force_correlation(seen, edges)
    return curve if np.sum(loaded * (loaded - 1)) / 2 >= FEWEST_PAIRS else curve._replace(value=np.nan * curve.value)


def force_ratio(seen: Snapshot) -> Measured:
    """Σ p over Σ (1 + α) μ max(0, −u⁻) of the contacts of all snapshots."""
    contacts = seen.contacts
    inverse = np.where(contacts.used, contacts.inverse_mass_i + contacts.inverse_mass_j, np.inf)
    binary = (1 + np.asarray(seen.restitution)[:, None]) * np.maximum(0, -np.asarray(contacts.approach)) / inverse
    sums = {"p": np.sum(np.asarray(seen.impulses), axis=1), "binary": np.sum(binary, axis=1)}
    return with_errors(lambda s: {"ratio": ratio(s["p"], s["binary"])}, sums)["ratio"]


def small_over_large(velocities: velocity_correlations.VelocityDistribution) -> Measured:
    """Temperature of the smallest third of the grains over that of the largest."""
    value, error = velocities.size_temperatures
    over = value[0] / value[-1]
    return Measured(over, over * np.hypot(error[0] / value[0], error[-1] / value[-1]))


def as_row(flow: dict) -> dict:
    """The flow with lists of numbers of five digits, null where a number is not finite."""

    def plain(x: np.ndarray):
        if np.ndim(x):
            return [plain(one) for one in x]
        return float(f"{x:.5g}") if np.isfinite(x) else None

    numbers = {name: plain(np.stack(x)) for name, x in flow["numbers"].items()}
    curves = {name: dict(zip(Curve._fields, map(plain, x), strict=True)) for name, x in flow["curves"].items()}
    return {**{k: v for k, v in flow.items() if k not in ("numbers", "curves")}, "numbers": numbers, "curves": curves}


def draw_structure(plan: Plan, flows: list[dict]) -> Figure:
    """A row for each measured function, a column for each packing fraction, a line for each restitution."""
    columns = len(plan.packing_fraction)
    figure = Figure(figsize=(1.5 + 3.6 * columns, 2.7 * len(CURVES)), layout="constrained")
    grid = figure.subplots(len(CURVES), columns, sharey="row", squeeze=False)
    for row, (name, (xlabel, ylabel, scale)) in zip(grid, CURVES.items(), strict=True):
        for axes, nu in zip(row, plan.packing_fraction, strict=True):
            for alpha, style, flow in of_packing_fraction(plan, flows, nu):
                at, value, error = flow["curves"][name]
                seen = np.isfinite(value)
                if scale == "log":
                    seen &= (error < value) & (at > 0)  # what is not found at all has no place on the axis
                if seen.any():
                    points(axes, at[seen], value[seen], error[seen], style, f"α = {alpha:g}")
            axes.set(xlabel=xlabel, yscale=scale)
            if name == "cluster_sizes":
                axes.set(xscale="log", xlim=(1.7, 450), xticks=(2, 5, 10, 20, 50, 100, 300))
                axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
                axes.xaxis.set_minor_formatter(NullFormatter())
            elif name == "cluster_persistence":
                axes.set(xscale="log", xlim=(0.8, 500))
        row[0].set_ylabel(ylabel)
    for axes, nu in zip(grid[0], plan.packing_fraction, strict=True):
        axes.set_title(f"packing fraction ν = {nu:g}")
    x = np.linspace(0, 12)
    for axes in grid[0]:
        axes.plot(x, np.exp(-x), color="0.5", lw=0.8, label=r"$e^{-F/\langle F\rangle}$")
    for axes in grid[2]:
        axes.axhline(0, color="0.5", lw=0.8)
        axes.set_xlim(0, 6)
        if not axes.containers:
            axes.text(0.5, 0.5, "too few contacts at a time", transform=axes.transAxes, ha="center", va="bottom")
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_ylim(-1.5, 20)
    grid[0, 0].set_ylim(1e-4, 10)
    grid[1, 0].set_ylim(1e-5, 2)
    grid[4, 0].set_ylim(1e-3, 1.2)
    grid[0, -1].legend(fontsize="small")
    return figure


def draw_chaos(plan: Plan, flows: list[dict]) -> Figure:
    """What enters kinetic theory, over what it assumes, against the packing fraction; open symbols are second ones."""
    panels = {
        r"force ratio $\langle F\rangle/\langle F_{\rm bc}\rangle$": ("force_ratio", None, 1.0, "log"),
        "share of contact pressure\nin clusters of three or more": ("share_pressure", None, None, "linear"),
        "collision rate / Enskog\n(open: a quarter of the shell)": ("rate_ratio", "rate_ratio_closer", 1.0, "log"),
        "contact value χ / theory\n(open: a quarter of the shell)": (
            "contact_ratio",
            "contact_ratio_closer",
            1.0,
            "log",
        ),
        "$\\langle u_n^2\\rangle$ before contact / independent\n(open: a quarter of the shell)": (
            "speed_ratio",
            "speed_ratio_closer",
            1.0,
            "log",
        ),
        "velocity correlation $\\langle w_i\\cdot w_j\\rangle/2T$\n(open: a quarter of the shell)": (
            "velocity_correlation",
            "velocity_correlation_closer",
            0.0,
            "linear",
        ),
        "kurtosis $a_2$\n(open: less anisotropic Gaussian)": ("sonine", "sonine_excess", 0.0, "linear"),
        "$T_{xy}/T$\n(open: $(T_{xx}-T_{yy})/2T$)": ("shear", "anisotropy", 0.0, "linear"),
        "temperature, smallest third\nover largest third": ("small_over_large", None, 1.0, "linear"),
    }
    figure = Figure(figsize=(11, 9.5), layout="constrained")
    for axes, (label, (first, second, theory, scale)) in zip(figure.subplots(3, 3).flat, panels.items(), strict=True):
        for k, alpha in enumerate(plan.restitution):
            here = [flow["numbers"] for flow in flows if flow["restitution"] == alpha]
            nu = np.array(plan.packing_fraction) + 0.006 * (k - 1)
            for name, filled in ((first, True), (second, False)):
                if name:
                    value, error = np.array([here[m][name] for m in range(len(here))]).T
                    points(
                        axes,
                        nu,
                        value,
                        error,
                        STYLES[k],
                        f"α = {alpha:g}" if filled else None,
                        filled=filled,
                    )
        if scale == "log":
            plain_log(axes)
        if theory is not None:
            axes.axhline(theory, color="0.5", lw=0.8)
        axes.set(xlabel="packing fraction ν", ylabel=label, xticks=plan.packing_fraction)
    figure.axes[0].legend(fontsize="small")
    figure.suptitle(
        "Grey lines: binary collisions, equilibrium pairs at contact, independent Gaussian velocities, equipartition",
        fontsize="medium",
    )
    return figure


def of_packing_fraction(plan: Plan, flows: list[dict], nu: float) -> Iterator[tuple[float, tuple[str, str, str], dict]]:
    """Restitution, style and flow of one packing fraction."""
    for alpha, style in zip(plan.restitution, STYLES, strict=False):
        yield alpha, style, next(f for f in flows if (f["packing_fraction"], f["restitution"]) == (nu, alpha))


def plain_log(axes: Axes) -> None:
    """A logarithmic axis over little more than a decade, with its numbers written out."""
    axes.set_yscale("log")
    axes.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))


def points(axes: Axes, at, value, error, style: tuple[str, str, str], label: str | None, filled=True) -> None:
    """Points with error bars of one standard error, and a line through them."""
    colour, marker, dashes = style
    axes.errorbar(
        at,
        value,
        np.nan_to_num(error),
        color=colour,
        marker=marker,
        ls=dashes,
        lw=1,
        ms=4,
        mfc=colour if filled else "white",
        elinewidth=0.8,
        capsize=1.5,
        label=label,
    )
