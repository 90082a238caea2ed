"""Is the time step of contact dynamics a duration of contact? jaxgran beside event-driven discs of
the TC model.

The same flows are run twice, N = 256: by jaxgran at several time steps dt, and by ``event_driven``
at several durations of contact t_c. Both end the inelastic collapse. Collisions within one dt are
solved together, and collisions within t_c of an earlier one are elastic. For each dt the study asks
at which t_c the event-driven discs collide as often, and at which the elastic collisions have the
share of the contact pressure that jaxgran's clusters have. If dt were a duration of contact, both
answers would be c dt with one c for all dt and flows. Between 1e-6 and 1e-3 each curve is also
fitted by a power of its time.

    python -m benchmarks contact_duration           # 2 minutes on two cores
    python -m benchmarks contact_duration --quick   # one flow of 64 grains, under a minute
"""

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, product
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.independent.event_driven import Law, averages, discs_of, sheared
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.maps.schema import path_of
from jaxgran.plotting.style import TWO_COLUMNS, styled
from jaxgran.statistics import standard_errors

BLOCKS = 32  # of a sample, for its errors
# of the solver: at the default, 1e-4, the collision rate of dense flows is a tenth too high
TOLERANCE = 1e-6
OBSERVABLES = ("granular_temperature", "pressure", "shear_stress")
STEPPED = (*OBSERVABLES, "collision_rate", "force_ratio", "cluster_pressure_share")
MATCHED = {"collision_rate": "collision_rate", "cluster_pressure_share": "elastic_pressure_share"}
OF_DISCS = ("collision_rate", "elastic_pressure_share")  # what is fitted by powers
OF_GRAINS = ("collision_rate", "cluster_pressure_share", "force_ratio")
FITTED = (1e-6, 1e-3)  # of t_c and dt
Flow = tuple[float, float]  # packing fraction and restitution


class Runs(NamedTuple):
    """Grains of a flow, its seeds, and the sampled strain of each."""

    grains: int
    seeds: int
    strain: float


class Plan(NamedTuple):
    """Flows, their runs, time steps and durations of contact (the longest first)."""

    restitution: tuple[float, ...]
    packing_fraction: tuple[float, ...]
    runs: Runs
    timesteps: tuple[float, ...]
    durations: tuple[float, ...]


TIMESTEPS = (1e-6, 1e-5, 1e-4, 1e-3)
DURATIONS = (5e-3, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # at 1e-2 dense flows heat up without end
FULL = Plan((0.2, 0.5), (0.6, 0.75), Runs(256, 3, 16.0), TIMESTEPS, DURATIONS)
QUICK = Plan((0.2,), (0.6,), Runs(64, 2, 4.0), TIMESTEPS[2:], DURATIONS[:4])


def run(output: Output) -> None:
    """Run the plan on all cores, print the tables, and write ``contact_duration`` as JSON and
    PNG.
    """
    plan, start = QUICK if output.quick else FULL, time.perf_counter()
    flows = list(product(plan.packing_fraction, plan.restitution))
    grains = stepped(plan)
    tasks = [(flow, plan.runs, plan.durations) for flow in flows]
    with ProcessPoolExecutor(usable_cores(), multiprocessing.get_context("spawn")) as pool:
        done = pool.map(event_driven, *zip(*tasks, strict=True))
        discs = [row for rows in done for row in rows]
    matches = [
        match
        for row in grains
        for match in matched(row, [disc for disc in discs if disc["flow"] == row["flow"]])
    ]
    powers = [
        fitted(rows, flow, name)
        for flow in flows
        for rows, names in ((discs, OF_DISCS), (grains, OF_GRAINS))
        for name in names
    ]
    report(matches, powers)
    head = {"plan": plan._asdict(), "wall_seconds": time.perf_counter() - start}
    head |= {"matches": matches, "powers": powers, "event_driven": discs}
    output.write_rows("contact_duration", head, "jaxgran", grains)
    output.write_picture(draw(discs, grains), "contact_duration")


def event_driven(flow: Flow, runs: Runs, durations: tuple[float, ...]) -> list[dict]:
    """Averages of a flow with their errors, a row for each duration of contact, from the longest
    on.

    Each seed starts from a gas, and has the strain of a sample to reach its steady state, and a
    fifth of it after each change of the duration.
    """
    samples = [[] for _ in durations]
    for seed in range(runs.seeds):
        start = jg.heated(jg.ShearFlow(runs.grains, flow[1], flow[0], 1e-3), jax.random.key(seed))
        discs, _ = sheared(discs_of(start), Law(flow[1], durations[0]), 0.8 * runs.strain)
        for sample, duration in zip(samples, durations, strict=True):
            discs, _ = sheared(discs, Law(flow[1], duration), 0.2 * runs.strain)
            discs, sums = sheared(discs, Law(flow[1], duration), runs.strain, BLOCKS)
            sample.append(sums)
    rows = []
    for sample, duration in zip(samples, durations, strict=True):
        sums = {name: np.stack([part[name] for part in sample]) for name in sample[0]}
        value, error = standard_errors(lambda x: averages(x, discs), sums)
        rows.append(
            {"flow": list(flow), "time": duration}
            | {x: [float(value[x]), float(error[x])] for x in value}
        )
    return rows


def stepped(plan: Plan) -> list[dict]:
    """Averages of jaxgran with their errors, a row for each flow and time step."""
    data = jg.ratio_map(
        sorted(plan.restitution),
        sorted(plan.packing_fraction),
        grains=plan.runs.grains,
        seeds=plan.runs.seeds,
        strain=plan.runs.strain,
        timestep=plan.timesteps,
        tolerance=TOLERANCE,
        workers=usable_cores(),
    )
    rows = []
    for nu, alpha, dt in product(plan.packing_fraction, plan.restitution, plan.timesteps):
        flow = data.sel(packing_fraction=nu, restitution=alpha, timestep=dt)
        row = {x: [float(flow[f"{path_of(x)}{end}"]) for end in ("", "_stderr")] for x in STEPPED}
        rows.append(
            {"flow": [nu, alpha], "time": dt, "status": jg.Status(int(flow.status)).name} | row
        )
    return rows


def matched(row: dict, discs: list[dict]) -> list[dict]:
    """t_c/dt at which the event-driven discs have what jaxgran has at one dt, with its relative
    error, for both kinds.

    Logarithms are interpolated between durations. The quotient is None where no two durations
    enclose the value.
    """
    matches = []
    for name, other in MATCHED.items():
        value, error = row[name]
        match = {
            "flow": row["flow"],
            "timestep": row["time"],
            "observable": name,
            "quotient": None,
            "relative_error": None,
        }
        ordered = sorted(discs, key=lambda disc: disc["time"])
        for shorter, longer in pairwise(ordered):
            (low, low_error), (high, high_error) = shorter[other], longer[other]
            if min(low, value, high) > 0 and min(low, high) <= value < max(low, high):
                slope = np.log(high / low) / np.log(longer["time"] / shorter["time"])
                share = np.log(value / low) / np.log(high / low)
                spread = np.hypot(
                    error / value, (1 - share) * low_error / low + share * high_error / high
                )
                match["quotient"] = float(
                    shorter["time"] * np.exp(np.log(value / low) / slope) / row["time"]
                )
                match["relative_error"] = float(spread / abs(slope))
                break
        matches.append(match)
    return matches


def fitted(rows: list[dict], flow: Flow, name: str) -> dict:
    """Exponent of a power of the time, with its error, for one curve; of a force ratio, its excess.

    The error grows with √(χ² per degree of freedom) where the curve is no power. None where there
    is nothing to fit.
    """
    some = [
        row for row in rows if tuple(row["flow"]) == flow and FITTED[0] <= row["time"] <= FITTED[1]
    ]
    times, value, error = np.array([(row["time"], *row[name]) for row in some]).T
    value = value - (name == "force_ratio")
    result = {"flow": flow, "observable": name, "exponent": None, "error": None}
    if np.all(value > 0) and np.all(error > 0):
        place, weight = np.log(times), value / error
        powers, covariance = np.polyfit(place, np.log(value), 1, w=weight, cov="unscaled")
        chi2 = np.sum((weight * (np.log(value) - np.polyval(powers, place))) ** 2) / max(
            1, len(some) - 2
        )
        result |= {
            "exponent": float(powers[0]),
            "error": float(np.sqrt(covariance[0, 0] * max(1.0, chi2))),
        }
    return result


def report(matches: list[dict], powers: list[dict]) -> None:
    """Print the quotients t_c/dt and the exponents of all flows."""
    print("t_c/dt of equal    collision rate         share of the pressure")
    for rates, shares in zip(matches[::2], matches[1::2], strict=True):
        texts = (
            f"{m['quotient']:9.3g} ± {100 * m['relative_error']:3.0f} %"
            if m["quotient"]
            else f"{'–':>17}"
            for m in (rates, shares)
        )
        print("ν {:4g}  α {:3g}".format(*rates["flow"]), f"dt {rates['timestep']:6g}", *texts)
    print(
        "exponents of",
        *(f"{name:>24}" for name in (*OF_DISCS, *OF_GRAINS)),
        " (two of t_c, three of dt)",
    )
    count = len(OF_DISCS) + len(OF_GRAINS)
    for first in range(0, len(powers), count):
        some = powers[first : first + count]
        texts = (
            f"{p['exponent']:16.3f} ± {p['error']:5.3f}" if p["exponent"] else f"{'–':>24}"
            for p in some
        )
        print("ν {:4g}  α {:3g}".format(*some[0]["flow"]), *texts)


@styled
def draw(discs: list[dict], grains: list[dict]) -> Figure:
    """Pressure and collision rate of the flow that collapses most, against t_c of event-driven
    discs and dt here.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 2.4), layout="constrained")
    flow = max((row["flow"] for row in grains), key=lambda flow: (flow[0], -flow[1]))
    panels = {
        "pressure": ("stresses agree", r"pressure $p$ ($m\dot\gamma^2$)"),
        "collision_rate": ("collisions do not", "collisions per grain\nand unit of strain"),
    }
    sources = (
        (discs, r"event-driven, $t_\mathrm{c}$", "o:", "white"),
        (grains, r"jaxgran, $\mathrm{d}t$", "s-", "black"),
    )
    for axes, (name, (title, label)) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        for rows, source, look, face in sources:
            rows_of_flow = [row for row in rows if row["flow"] == flow]
            value, error = np.array([row[name] for row in rows_of_flow]).T
            axes.errorbar(
                [row["time"] for row in rows_of_flow],
                value,
                error,
                fmt=look,
                color="black",
                mfc=face,
                label=source,
            )
        axes.set(
            xscale="log",
            yscale="log" if name == "collision_rate" else "linear",
            title=title,
            ylabel=label,
        )
        axes.set_xlabel(r"$t_\mathrm{c}$ or $\mathrm{d}t$ ($1/\dot\gamma$)")
    figure.axes[0].set_ylim(bottom=0)
    figure.axes[0].legend(loc="lower left")
    return figure
