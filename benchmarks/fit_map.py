"""In which flows do the intervals of a fitted restitution cover it? A map over restitution and packing fraction.

    python -m benchmarks fit_map           # 20 points, and dense ones again by a quicker camera
    python -m benchmarks fit_map --quick   # three points, few trajectories

At each point 16 trajectories of the event-driven reference, N = 64, 50 frames, with 1 % of noise in the velocities and
1e-4 σ in the positions, of which the fit is told nothing. One camera takes a frame each 0.005/γ̇, the other ten frames
in the mean time between two collisions of a disc. At two points the discs are those of jaxgran itself, at a time step
of 1e-4, where grains of a cluster stay in touch.

The event-driven reference has a duration of contact of 1e-6/γ̇: a disc that collides again within that time loses no
energy. The share of such collisions is written beside each point.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded when they are used

import jaxgran as jg
from benchmarks.fit_coverage import (
    BETWEEN,
    CONTACT_DURATION,
    GRAINS,
    SETTLING,
    fit_all,
    fit_statistics,
    successive,
    with_noise,
)
from benchmarks.independent.event_driven import Law, averages, discs_of, sheared
from benchmarks.output import Output

RESTITUTIONS, FRACTIONS = (0.1, 0.3, 0.5, 0.7, 0.9), (0.4, 0.6, 0.75, 0.8)
DENSE = (0.75, 0.8)  # also by the quicker camera
QUICK_POINTS = ((0.3, 0.4), (0.9, 0.6), (0.3, 0.75))
OWN = ((0.6, 0.6), (0.3, 0.75))  # discs of jaxgran
VELOCITY, POSITION = 0.01, 1e-4
RUNS, FEW_RUNS, FRAMES = 16, 3, 50
INTERVAL, PER_COLLISION = 0.005, 10  # strain between frames of one camera; frames per collision of the other
OWN_TIMESTEP = 1e-4
SEED, NOISE_SEED = 2, 1000  # those of fit_coverage are 1, and 0 to 99


def by_reference(alpha: float, nu: float, runs: int, quicker: bool) -> tuple[list[jg.Tracks], dict]:
    """Trajectories of the event-driven reference, and what describes the flow."""
    flow = jg.ShearFlow(GRAINS, alpha, nu, 1e-3)
    discs, law = discs_of(jg.prepare(flow, jax.random.key(SEED))), Law(alpha, CONTACT_DURATION)
    discs, _ = sheared(discs, law, SETTLING)
    discs, sums = sheared(discs, law, SETTLING)
    mean = {name: float(value[0]) for name, value in averages(sums, discs).items()}
    interval = 1 / (PER_COLLISION * mean["collision_rate"]) if quicker else INTERVAL
    tracks = successive(discs, alpha, runs, FRAMES, interval * (FRAMES - 1))
    description = {name: mean[name] for name in ("collision_rate", "granular_temperature", "elastic_share")}
    return tracks, {"interval": interval, **description}


def by_jaxgran(alpha: float, nu: float, runs: int) -> tuple[list[jg.Tracks], dict]:
    """Trajectories of contact dynamics with time steps."""
    flow = jg.ShearFlow(GRAINS, alpha, nu, OWN_TIMESTEP)
    state, tracks = jg.prepare(flow, jax.random.key(SEED), SETTLING), []
    strain = INTERVAL * np.arange(1, FRAMES + 1)
    for _ in range(runs):
        state, snapshots = jg.snapshot_series(flow, state, INTERVAL * FRAMES, FRAMES)
        tracks.append(jg.tracks_of_states(strain, snapshots.state))
        state, _ = jg.advance(flow, state, jnp.int32(round(BETWEEN / OWN_TIMESTEP)))
    return tracks, {"interval": INTERVAL}


def statistics_of_point(tracks: list[jg.Tracks], alpha: float) -> dict:
    """How many intervals of a point cover α, with the 95 % interval of that share by Wilson, and the bias."""
    start = time.process_time()
    fits, refused = fit_all(with_noise(one, VELOCITY, POSITION, 0.0, NOISE_SEED + k) for k, one in enumerate(tracks))
    row = {"fits": len(fits), "refused": refused, "seconds": (time.process_time() - start) / len(tracks)}
    if not fits:
        return row
    row |= fit_statistics(fits, alpha)
    wilson = scipy.stats.binomtest(row["held"], len(fits)).proportion_ci(method="wilson")
    return row | {"coverage": (wilson.low, wilson.high)}


def report_line(row: dict) -> str:
    head = (
        f"α {row['restitution']:g}, ν {row['packing_fraction']:g}, {row['camera']}, frames {row['interval']:.2g} apart"
    )
    if not row["fits"]:
        return f"{head}: all {row['refused']} refused"
    return (
        f"{head}: {row['held']} of {row['fits']} hold, {row['refused']} refused, bias {row['bias_in_errors']:+.2f} ± "
        f"{row['spread_in_errors'] / np.sqrt(row['fits']):.2f} errors of {row['stderr']:.1e}, {row['collisions']:.0f} "
        f"collisions, {row['rejected']:.0f} left out, misfit {row['misfit']:.2f}, {row['seconds']:.2f} s"
    )


def run(output: Output) -> None:
    """Fit the trajectories of all points, print, and write JSON."""
    runs = FEW_RUNS if output.quick else RUNS
    points = QUICK_POINTS if output.quick else [(alpha, nu) for nu in FRACTIONS for alpha in RESTITUTIONS]
    cases = [("steady", *point) for point in points]
    cases += [] if output.quick else [("quicker", alpha, nu) for alpha, nu in points if nu in DENSE]
    cases += [("jaxgran", *point) for point in OWN[: 1 if output.quick else None]]
    rows = []
    for camera, alpha, nu in cases:
        if camera == "jaxgran":
            tracks, description = by_jaxgran(alpha, nu, runs)
        else:
            tracks, description = by_reference(alpha, nu, runs, camera == "quicker")
        head = {"camera": camera, "restitution": alpha, "packing_fraction": nu}
        rows.append(head | description | statistics_of_point(tracks, alpha))
        print(report_line(rows[-1]), flush=True)
    head = {"grains": GRAINS, "frames": FRAMES, "velocity_noise": VELOCITY, "position_noise": POSITION}
    output.write_rows("fit_map", head | {"contact_duration": CONTACT_DURATION, "timestep": OWN_TIMESTEP}, "rows", rows)
