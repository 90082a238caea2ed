"""How well does ``fisher_information`` know the error of a fit before tracks are measured?

    python -m benchmarks fit_design           # 6 minutes
    python -m benchmarks fit_design --quick   # one flow, fewer points: a minute

``fits`` has the error that is predicted beside that of fits to tracks of the event-driven reference, which shares no
code with either: N = 64, 50 frames, 12 trajectories of each flow, noise and frame rate. The fits are not told the
noise. The median of the errors that they state, and the root mean square of how far they are off.

``over_flows`` has the predicted error over α and ν, 100 frames of 64 discs; ``over_intervals`` has it over the time
between frames.

Noise of velocities is 5 % of a component of a typical velocity, of positions 1e-3 σ with velocities and 1e-4 σ without.
The time between frames is in collisions of a disc, by Enskog's theory. The last step of jaxgran before tracks begin is
dt = 1e-3, and that of the tracks 1e-6 of the time in which a disc moves by its diameter.
"""

from typing import NamedTuple

import jax
import numpy as np

import jaxgran as jg
from benchmarks.fit_coverage import fit_all, peculiar_velocities, trajectories, with_noise
from benchmarks.output import Output
from jaxgran.model.checks import InputError
from jaxgran.sampling.prediction import kinetic_theory

GRAINS, FITTED_FRAMES, FRAMES = 64, 50, 100
NOISES = {"with velocities": (0.05, 1e-3), "positions alone": (None, 1e-4)}


class Plan(NamedTuple):
    """Flows (α, ν), collisions between frames and trajectories of the fits; then α, ν and collisions of the others."""

    flows: tuple[tuple[float, float], ...]
    intervals: tuple[float, ...]
    runs: int
    restitutions: tuple[float, ...]
    fractions: tuple[float, ...]
    far: tuple[float, ...]


FULL = Plan(
    ((0.6, 0.6), (0.3, 0.4), (0.9, 0.5)),
    (0.06, 0.25),
    12,
    (0.2, 0.4, 0.6, 0.8, 0.95),
    (0.2, 0.4, 0.6, 0.7),
    (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8),
)
QUICK = Plan(((0.6, 0.5),), (0.1,), 3, (0.4, 0.8), (0.4,), (0.05, 0.2))


def run(output: Output) -> None:
    """Compare with fits, predict, print, and write ``fit_design`` as JSON."""
    jax.config.update("jax_enable_x64", True)
    plan = QUICK if output.quick else FULL
    fits = []
    for flow in plan.flows:
        for interval in plan.intervals:
            fits += fit_rows(*flow, interval, plan.runs)
    over_flows = [
        predicted(alpha, nu, 0.1, "with velocities", FRAMES) for nu in plan.fractions for alpha in plan.restitutions
    ]
    over_intervals = [predicted(0.6, 0.6, interval, noise, FRAMES) for noise in NOISES for interval in plan.far]
    head = {"grains": GRAINS, "frames": {"fits": FITTED_FRAMES, "others": FRAMES}, "noises": NOISES}
    output.write_json("fit_design", {**head, "fits": fits, "over_flows": over_flows, "over_intervals": over_intervals})


def theory(alpha: float, nu: float) -> tuple[float, float]:
    """Collisions of a disc in a unit of strain, and a typical component of its velocity."""
    found = kinetic_theory([alpha], [nu])
    return float(found.collision_rate[0]), float(np.sqrt(found.granular_temperature[0]))


def predicted(
    alpha: float, nu: float, interval: float, noise: str, frames: int, velocity_noise: float | None = None
) -> dict:
    """What ``fisher_information`` says; no error where nothing will be learnt."""
    rate, speed = theory(alpha, nu)
    velocity, position = NOISES[noise]
    if velocity is not None and velocity_noise is None:
        velocity_noise = velocity * speed
    row = {"restitution": alpha, "packing_fraction": nu, "interval": interval, "noise": noise}
    try:
        found = jg.fisher_information(
            jg.ShearFlow(GRAINS, alpha, nu, 1e-3),
            frames,
            jg.TrackNoise(position, velocity_noise),
            frame_strain=interval / rate,
        )
    except InputError as why:
        row |= {"refused": str(why)}
    else:
        row |= vars(found)
    print(report_line(row), flush=True)
    return row


def fit_rows(alpha: float, nu: float, interval: float, runs: int) -> list[dict]:
    """Predictions, and fits to trajectories, with each noise."""
    strain = interval / theory(alpha, nu)[0] * (FITTED_FRAMES - 1)
    tracks = trajectories(alpha, runs, nu, FITTED_FRAMES, strain)
    speed = np.sqrt(np.mean([peculiar_velocities(one) ** 2 for one in tracks]))
    rows = []
    for noise, (velocity, position) in NOISES.items():
        fits, _ = fit_all(with_noise(one, velocity, position, 0.0, k) for k, one in enumerate(tracks))
        row = predicted(alpha, nu, interval, noise, FITTED_FRAMES, None if velocity is None else velocity * speed)
        stated, off = (np.array(x) for x in zip(*[(fit.stderr, fit.restitution - alpha) for fit in fits], strict=True))
        row |= {
            "fits": len(fits),
            "fit_collisions": float(np.mean([fit.collisions for fit in fits])),
            "stated": float(np.median(stated)),
            "stated_error": float(1.25 * np.std(stated, ddof=1) / np.sqrt(len(fits))),
            "off": float(np.sqrt(np.mean(off**2))),
            "off_error": float(np.sqrt(np.mean(off**2) / (2 * len(fits)))),
        }
        print(
            f"    {row['fits']} fits of {runs}: stated {row['stated']:.2e} ± {row['stated_error']:.0e}, off by "
            f"{row['off']:.2e} ± {row['off_error']:.0e}, {row['fit_collisions']:.0f} collisions",
            flush=True,
        )
        rows.append(row)
    return rows


def report_line(row: dict) -> str:
    head = (
        f"α {row['restitution']:g}, ν {row['packing_fraction']:g}, {row['noise']}, {row['interval']:g} between frames"
    )
    if "refused" in row:
        return f"{head}: {row['refused']}"
    return (
        f"{head}: error {row['stderr']:.2e} ± {row['stderr_error']:.0e}, {row['collisions']:.0f} collisions, "
        f"{100 * row['usable']:.0f} % of all"
    )
