"""Free cooling against Haff's law: granular temperature of grains without shear, in collisions and in time.

Discs of one size at ν = 0.3 start as a gas in equilibrium (after a dozen collisions each at α = 1) and cool at α = 0.8,
0.9 and 0.95. In collisions per grain C the law is T = T₀ exp(−(1 − α²) C/2) whatever the density; in time it is
T = T₀/(1 + t/τ)². It holds while the gas is homogeneous. In a cell that is large enough neighbours come to move alike,
then clusters form: collisions become gentler than the temperature tells, and T lies above the law. The figure marks
where that exceeds a tenth, and shows the last state of the most dissipative gas.

    python -m benchmarks free_cooling           # 1600 grains, two minutes on one core
    python -m benchmarks free_cooling --quick   # 256 grains, about a minute
"""

from dataclasses import replace

import jax
import numpy as np
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.theory.steady_shear import contact_value

ALPHAS, NU, TIMESTEP = (0.8, 0.9, 0.95), 0.3, 2e-3
EQUILIBRATION = np.linspace(0.1, 5.0, 40)  # at T = 1, a dozen collisions a grain; as many times as are recorded
DEPARTURE = 0.1  # of T from the law, that the figure marks


def run(output: Output) -> None:
    """Cool from several gases, print where the law ends, and write JSON and PNG."""
    grains, seeds, latest = (256, 2, 300.0) if output.quick else (1600, 3, 3000.0)
    times = np.geomspace(0.2, latest, 40)
    flow = jg.ShearFlow(grains, 1.0, NU, TIMESTEP, shear_rate=0.0, polydispersity=0.0)
    gases = [jg.cooling(flow, jg.heated(flow, jax.random.key(seed)), EQUILIBRATION)[0] for seed in range(seeds)]
    rows, last = [], None
    for alpha in ALPHAS:
        runs = [jg.cooling(replace(flow, restitution=alpha), gas, times) for gas in gases]
        last = last or runs[0][0]
        rows += table(alpha, [record for _, record in runs])
    print("    α   departs by a tenth: after collisions, at a time of       worst status")
    for alpha in ALPHAS:
        some = [row for row in rows if row["alpha"] == alpha]
        found = departure(some)
        where = f"{found['collisions']:10.1f}{found['time']:12.1f}" if found else f"not within {latest:g}"
        print(f"{alpha:5.2f}{where:>45}{max(row['status'] for row in some):15d}")
    choices = {"grains": grains, "seeds": seeds, "packing_fraction": NU, "timestep": TIMESTEP}
    output.write_rows("free_cooling", {"run": choices}, "rows", rows)
    output.write_picture(draw(rows, grains, last), "free_cooling")


def table(alpha: float, records: list[jg.Cooling]) -> list[dict]:
    """One row a time: the means over the seeds, their standard error, and Haff's law at the mean of the collisions."""
    temperature, collisions = (
        np.stack([getattr(one, name) for one in records]) for name in ("temperature", "collisions")
    )
    logs = np.log(temperature)
    error = logs.std(axis=0, ddof=1) / np.sqrt(len(records))
    rate = (1 - alpha**2) * np.sqrt(np.pi) * NU / (np.pi / 4) * float(contact_value(NU)) / 2  # 1/τ, Enskog's, T₀ = 1
    times, status = np.asarray(records[0].times), max(int(one.status) for one in records)
    return [
        {
            "alpha": alpha,
            "time": float(t),
            "collisions": float(c),
            "temperature": float(np.exp(log)),
            "relative_error": float(e),
            "haff_in_collisions": float(np.exp(-(1 - alpha**2) * c / 2)),
            "haff_in_time": float((1 + rate * t) ** -2),
            "status": status,
        }
        for t, c, log, e in zip(times, collisions.mean(axis=0), logs.mean(axis=0), error, strict=True)
    ]


def departure(rows: list[dict]) -> dict | None:
    """The first row from which on the temperature is a tenth and two errors above the law in collisions."""
    above = [
        np.log(row["temperature"] / row["haff_in_collisions"]) > max(DEPARTURE, 2 * row["relative_error"])
        for row in rows
    ]
    late = [k for k in range(len(rows)) if all(above[k:])]
    return rows[late[0]] if late else None


def draw(rows: list[dict], grains: int, last: jg.State) -> Figure:
    """T against collisions, T over Haff's law in time, and the last state of the most dissipative gas."""
    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    falling, ratio, picture = figure.subplots(1, 3)
    for k, (alpha, grey) in enumerate(zip(ALPHAS, ("0", "0.35", "0.6"), strict=True)):
        some = [row for row in rows if row["alpha"] == alpha]
        collisions, times, measured = (
            np.array([row[key] for row in some]) for key in ("collisions", "time", "temperature")
        )
        loss = (1 - alpha**2) / 2 * collisions
        style = {"color": grey, "marker": "os^"[k], "markersize": 3.5, "linestyle": "none", "label": f"α = {alpha:g}"}
        falling.semilogy(loss, measured, **style)
        error = np.array([row["relative_error"] for row in some])
        law = np.array([row["haff_in_time"] for row in some])
        ratio.errorbar(times, measured / law, measured / law * error, capsize=2, **style)
        found = departure(some)
        if found:
            falling.axvline((1 - alpha**2) / 2 * found["collisions"], color=grey, linestyle=":")
            ratio.axvline(found["time"], color=grey, linestyle=":")
    reach = np.linspace(0, max(-np.log(row["haff_in_collisions"]) for row in rows), 50)
    falling.semilogy(reach, np.exp(-reach), color="0.8", zorder=0, label="Haff")
    falling.set(xlabel="(1 − α²) C/2, C collisions per grain", ylabel="temperature T/T₀")
    falling.set_ylim(bottom=min(row["temperature"] for row in rows) / 3)
    falling.legend(fontsize="small")
    ratio.axhline(1, color="0.8", zorder=0)
    ratio.set(
        xscale="log", yscale="log", xlabel="time in σ √(m/T₀)", ylabel="T over Haff's law, τ from Enskog's theory"
    )
    positions, radii, side = (np.asarray(x) for x in (last.positions, last.grains.radii, last.side))
    discs = [Circle(place, radius) for place, radius in zip(positions, radii, strict=True)]
    speed = np.sqrt(np.sum(np.asarray(last.velocities) ** 2, axis=1))
    drawn = PatchCollection(discs, array=speed, cmap="viridis")
    picture.add_collection(drawn)
    picture.set(xlim=(0, side), ylim=(0, side), aspect="equal", xticks=[], yticks=[])
    picture.set_title(f"α = {ALPHAS[0]:g} at the end, N = {grains}: speed")
    figure.colorbar(drawn, ax=picture, shrink=0.8, label="speed, in √(T₀/m)")
    figure.suptitle(f"Free cooling at ν = {NU:g} (dotted: a tenth above the law from here on)")
    return figure
