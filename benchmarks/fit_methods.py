"""How do other methods find a restitution from the same tracks? Error against frames, their rate, and time.

    python -m benchmarks fit_methods           # all methods, two noises
    python -m benchmarks fit_methods --quick   # few trajectories, one noise

Trajectories of the event-driven reference, N = 64, ν = 0.6, as in ``fit_coverage``. Noise of velocities over their root
mean square, and of positions in σ. The other methods (``fit_rivals``) get the noise, and simulations are those of the
program that made the data. Their settings were chosen on trajectories of another seed: mean velocities of up to five
frames by hand; simulations that follow 16 frames, a strain of 0.08.

Seconds are CPU time of one trajectory, without compilation.
"""

import time
from collections.abc import Callable
from itertools import product

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.event_driven import Discs, discs_of
from benchmarks.fit_coverage import CONTACT_DURATION, FRACTION, GRAINS, peculiar_velocities, successive, with_noise
from benchmarks.fit_rivals import Noise, by_hand, by_simulations, pairs_of
from benchmarks.output import Output
from jaxgran.model.checks import InputError
from jaxgran.plotting.drawing import label_log_axis

RESTITUTIONS = (0.6, 0.9)  # the second with FEW_FRAMES alone
NOISES = ((0.01, 1e-4), (0.05, 1e-3))  # of velocities over their root mean square, of positions in σ
FRAMES, FEW_FRAMES, INTERVAL = (10, 20, 50, 100), 50, 0.005
INTERVALS = (0.02, 0.08)  # beside that one, with FEW_FRAMES
FOLLOWED = 0.08  # strain of a simulation
START_EVERY = 4  # frames between two starts of a simulation
RUNS = 12  # trajectories
SEED, NOISE_SEED = 3, 2000

Methods = dict[str, Callable]
STYLES = {  # marker, line, grey
    "this program": ("o", "-", "0.0"),
    "single collisions by hand": ("^", "--", "0.0"),
    "simulations": ("s", "-", "0.45"),
}


def start() -> Discs:
    """The packing of all trajectories."""
    flow = jg.ShearFlow(GRAINS, RESTITUTIONS[0], FRACTION, 1e-3)
    return discs_of(jg.prepare(flow, jax.random.key(SEED)))


def first(tracks: jg.Tracks, frames: int) -> jg.Tracks:
    """The tracks of the first frames."""
    parts = (getattr(tracks, name)[:frames] for name in ("time", "positions", "velocities", "cell"))
    kept, positions, velocities, cell = parts
    return jg.Tracks(kept, tracks.diameters, tracks.masses, positions, velocities, cell, tracks.shear_rate)


def noise_of(tracks: jg.Tracks, velocity: float, position: float) -> Noise:
    """What ``spoilt`` does to the tracks."""
    return Noise(velocity * float(np.sqrt(np.mean(peculiar_velocities(tracks) ** 2))), position)


def methods(interval: float) -> Methods:
    """All methods: functions of tracks with noise, and of that noise."""
    window = max(1, round(FOLLOWED / interval))
    every = min(window, START_EVERY)

    def ours(tracks: jg.Tracks, noise: Noise) -> float:
        try:
            return jg.fit_restitution(tracks).restitution
        except (InputError, RuntimeError):
            return np.nan

    return {
        "this program": ours,
        "single collisions by hand": lambda tracks, noise: by_hand(pairs_of(tracks), noise, 5),
        "simulations": lambda tracks, noise: by_simulations(pairs_of(tracks), noise, CONTACT_DURATION, window, every)[
            0
        ],
    }


def errors_of(
    name: str, method: Callable, trajectories: list[jg.Tracks], velocity: float, position: float, alpha: float
) -> dict:
    """Root mean square error of a method over the trajectories, with its standard error, and its seconds."""
    off, seconds = [], []
    for k, tracks in enumerate(trajectories):
        noisy, noise = with_noise(tracks, velocity, position, 0.0, NOISE_SEED + k), noise_of(tracks, velocity, position)
        if k == 0:
            method(noisy, noise)  # compilation
        begin = time.process_time()
        off.append(method(noisy, noise) - alpha)
        seconds.append(time.process_time() - begin)
    off = np.array(off)
    done = off[np.isfinite(off)]
    row = {"method": name, "fits": len(done), "runs": len(off), "seconds": float(np.median(seconds))}
    if len(done) < 2:
        return row
    squares = done**2
    error = float(np.sqrt(squares.mean()))
    return row | {
        "error": error,
        "error_stderr": float(squares.std(ddof=1) / np.sqrt(len(done)) / (2 * error)),
        "bias": float(done.mean()),
        "bias_stderr": float(done.std(ddof=1) / np.sqrt(len(done))),
        "median_error": float(np.median(np.abs(done))),
    }


def report_line(row: dict) -> str:
    error = f"{row['error']:.1e} ± {row['error_stderr']:.0e}, bias {row['bias']:+.1e}" if "error" in row else "none"
    return (
        f"α {row['restitution']:g}, noise {row['velocity_noise']:g} and {row['position_noise']:g}, "
        f"{row['frames']} frames {row['interval']:g} apart, {row['method']}: error {error}, "
        f"{row['fits']} of {row['runs']}, {row['seconds']:.3f} s"
    )


def draw(rows: list[dict]) -> Figure:
    """Errors against frames, against the interval between frames, and against seconds; a row of panels a noise."""
    noises = sorted({(row["velocity_noise"], row["position_noise"]) for row in rows})
    figure = Figure(figsize=(6.7, 2.1 * len(noises) + 0.5), layout="constrained")
    panels = figure.subplots(len(noises), 3, sharey="row", squeeze=False)
    for noise, line in zip(noises, panels, strict=True):
        here = [r for r in rows if (r["velocity_noise"], r["position_noise"]) == noise]
        here = [r for r in here if r["restitution"] == RESTITUTIONS[0] and r.get("error")]
        for name, (marker, dashes, grey) in STYLES.items():
            mine = [r for r in here if r["method"] == name]
            more = sorted((r for r in mine if r["interval"] == INTERVAL), key=lambda r: r["frames"])
            apart = sorted((r for r in mine if r["frames"] == FEW_FRAMES), key=lambda r: r["interval"])
            open_mark = "hand" in name
            style = {"marker": marker, "ls": dashes, "color": grey, "ms": 4, "mfc": "white" if open_mark else grey}
            for axis, x, some in ((line[0], "frames", more), (line[1], "interval", apart), (line[2], "seconds", more)):
                error = [min(r["error_stderr"], 0.7 * r["error"]) for r in some]
                axis.errorbar([r[x] for r in some], [r["error"] for r in some], error, label=name, **style)
        for axis in line:
            axis.set(xscale="log", yscale="log")
            axis.tick_params(labelsize=7.5)
        for axis, x in zip(line, ("frames", "interval"), strict=False):
            axis.set_xticks(sorted({r[x] for r in here}), minor=False)
            axis.set_xticks([], minor=True)
            axis.xaxis.set_major_formatter("{x:g}")
        label_log_axis(line[0].yaxis)
        line[0].set_ylabel(r"rms error of $\alpha$", fontsize=8)
        title = rf"noise of velocities {100 * noise[0]:g} %, of positions {noise[1]:g} $\sigma$"
        line[0].set_title(title, fontsize=8, loc="left")
    panels[-1, 0].set_xlabel(f"frames, a strain of {INTERVAL:g} apart", fontsize=8)
    panels[-1, 1].set_xlabel(f"strain between frames, {FEW_FRAMES} frames", fontsize=8)
    panels[-1, 2].set_xlabel("time of a fit (s)", fontsize=8)
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=7.5
    )
    return figure


def run(output: Output) -> None:
    """Fit all trajectories by all methods, print, and write JSON and PNG."""
    noises, runs = (NOISES[:1], 3) if output.quick else (NOISES, RUNS)
    frames, intervals = ((20, FEW_FRAMES), INTERVALS[1:]) if output.quick else (FRAMES, INTERVALS)
    discs, rows = start(), []
    cases = [(INTERVAL, frames, RESTITUTIONS[0])]
    cases += [] if output.quick else [(INTERVAL, (FEW_FRAMES,), alpha) for alpha in RESTITUTIONS[1:]]
    cases += [(interval, (FEW_FRAMES,), RESTITUTIONS[0]) for interval in intervals]
    for interval, numbers, alpha in cases:
        trajectories = successive(discs, alpha, runs, max(numbers), interval * (max(numbers) - 1))
        for (n, noise), (name, method) in product(product(numbers, noises), methods(interval).items()):
            head = {"restitution": alpha, "velocity_noise": noise[0], "position_noise": noise[1]}
            row = errors_of(name, method, [first(tracks, n) for tracks in trajectories], *noise, alpha)
            rows.append(head | {"frames": n, "interval": interval, **row})
            print(report_line(rows[-1]), flush=True)
    head = {"grains": GRAINS, "packing_fraction": FRACTION, "contact_duration": CONTACT_DURATION}
    output.write_rows("fit_methods", head, "rows", rows)
    output.write_picture(draw(rows), "fit_methods", dpi=200)
