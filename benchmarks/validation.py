"""Stresses, temperature and force ratio against independent programs.

Two maps are run. The first is compared with event-driven simulations of the same hard discs (N =
1000), which have no time step at all; the second, with the touching rule at dt = 1e-4, with values
of contact dynamics (N = 400). Of both programs only averages are known. The figure shows the
event-driven program of this repository instead of the first, from the result of
``contact_duration``, and is drawn by ``python -m benchmarks draw validation``.

    python -m benchmarks validation           # about 2 minutes on two cores
    python -m benchmarks validation --quick   # fewer grains and less strain, about a minute
"""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.environment import usable_cores
from jaxgran.plotting.style import TWO_COLUMNS, styled

# (packing fraction, restitution): temperature, pressure, shear stress; m = σ = γ̇ = 1
EVENT_DRIVEN = {
    (0.2, 0.9): (10.92, 4.185, 1.104),
    (0.2, 0.7): (3.105, 1.150, 0.465),
    (0.2, 0.5): (1.633, 0.584, 0.264),
    (0.6, 0.9): (2.057, 9.814, 2.715),
    (0.6, 0.7): (0.548, 2.530, 1.083),
    (0.6, 0.5): (0.344, 1.473, 0.731),
    (0.7, 0.9): (1.97, 20.7, 5.79),
    (0.7, 0.7): (0.537, 5.46, 2.26),
}
OBSERVABLES = ("granular_temperature", "pressure", "shear_stress")
REFERENCE_ERROR = 0.05  # of the force ratios
# (packing fraction, restitution): force ratio of single runs of strain 3 to 4, about 5 % uncertain
FORCE_RATIO = {
    (0.3, 0.9): 1.000,
    (0.3, 0.1): 1.10,
    (0.6, 0.5): 1.001,
    (0.6, 0.1): 1.44,
    (0.75, 0.5): 1.09,
    (0.75, 0.1): 2.36,
    (0.8, 0.9): 1.006,
    (0.8, 0.5): 2.03,
    (0.8, 0.1): 6.0,
}


def run(output: Output) -> None:
    """Run both maps, print the differences, and write JSON."""
    workers = usable_cores()
    stresses = jg.ratio_map(
        [0.9, 0.7, 0.5],
        [0.2, 0.6, 0.7],
        grains=256 if output.quick else 1000,
        seeds=1 if output.quick else 4,
        timestep=5e-4,
        strain=5.0 if output.quick else 60.0,
        workers=workers,
    )
    ratios = jg.ratio_map(
        [0.9, 0.5, 0.1],
        [0.3, 0.6, 0.75, 0.8],
        grains=128 if output.quick else 400,
        seeds=2,
        timestep=1e-4,
        strain=1.0 if output.quick else 4.0,
        activation="touching",
        workers=workers,
    )
    rows = [
        row
        for point, values in EVENT_DRIVEN.items()
        for row in compared(stresses, point, OBSERVABLES, values)
    ]
    rows += [
        row
        for point, value in FORCE_RATIO.items()
        for row in compared(ratios, point, ("force_ratio",), (value,))
    ]
    print("    ν    α  observable              jaxgran              reference   difference")
    for row in rows:
        print(
            "{nu:5.2f}{alpha:5.1f}  {observable:22s}{value:9.4f} ± {error:8.4f}{reference:12.4f}"
            "{percent:9.1f} % {sigmas:6.1f} σ  {status}".format(**row)
        )
    attributes = {
        name: {k: str(v) for k, v in data.attrs.items()}
        for name, data in (("event_driven", stresses), ("force_ratio", ratios))
    }
    output.write_json("validation", {"runs": attributes, "rows": rows})


def compared(
    data: xr.Dataset, point: tuple[float, float], names: tuple[str, ...], references: tuple
) -> list[dict]:
    here = data.sel(packing_fraction=point[0], restitution=point[1])
    meanings = data.status.attrs["flag_meanings"].split()
    values = list(np.asarray(data.status.attrs["flag_values"]))
    rows = []
    for name, reference in zip(names, references, strict=True):
        value, error = float(here[name]), float(here[f"{name}_stderr"])
        rows.append(
            {
                "nu": point[0],
                "alpha": point[1],
                "observable": name,
                "value": value,
                "error": error,
                "reference": reference,
                "percent": 100 * (value / reference - 1),
                "sigmas": (value - reference) / error if error else float("nan"),
                "status": meanings[values.index(int(here.status))],
            }
        )
    return rows


@styled
def draw(rows: list[dict], reference: list[dict]) -> Figure:
    """Differences from other programs, with standard errors: stresses and temperature, and force
    ratios.

    Args:
      rows: of this benchmark.
      reference: flows of the event-driven program of this repository, of ``contact_duration``.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    place = np.arange(len(reference))[::-1]
    for k, (name, label) in enumerate(zip(OBSERVABLES, ("$T$", "$p$", r"$\tau$"), strict=True)):
        quotients = []
        for flow in reference:
            one = next(
                row
                for row in rows
                if [row["nu"], row["alpha"], row["observable"]] == [*flow["flow"], name]
            )
            quotient = one["value"] / flow[name][0]
            noise = quotient * np.hypot(one["error"] / one["value"], flow[name][1] / flow[name][0])
            quotients.append((100 * (quotient - 1), 100 * noise))
        value, error = np.transpose(quotients)
        style = {
            "color": ("black", "0.4", "tab:blue")[k],
            "marker": "os^"[k],
            "ls": "none",
            "label": label,
        }
        left.errorbar(value, place + 0.22 * (1 - k), xerr=error, **style)
    left.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    left.set_yticks(
        place, [rf"$\alpha={flow['flow'][1]:g}$, $\nu={flow['flow'][0]:g}$" for flow in reference]
    )
    left.set(xlabel="jaxgran / event-driven discs − 1 (%)", ylim=(-0.6, len(reference) - 0.4))
    ratios = [row for row in rows if row["observable"] == "force_ratio"]
    place = np.arange(len(ratios))[::-1]
    uncertain = 100 * REFERENCE_ERROR
    right.axvspan(-uncertain, uncertain, color="0.9", label="error of the reference")
    noise = [100 * row["error"] / row["reference"] for row in ratios]
    right.errorbar(
        [row["percent"] for row in ratios], place, xerr=noise, fmt="ko", label="force ratio"
    )
    right.set_yticks(place, [rf"$\alpha={row['alpha']:g}$, $\nu={row['nu']:g}$" for row in ratios])
    right.set(xlabel="jaxgran / contact dynamics − 1 (%)", ylim=(-0.6, len(ratios) - 0.4))
    right.legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for axes in (left, right):
        axes.axvline(0, color="0.6", lw=0.8, zorder=0)
        axes.tick_params(axis="y", length=0)
    return figure
