"""How often do the intervals of a fitted restitution cover it? 100 trajectories of tracked discs for each noise.

    python -m benchmarks fit_coverage           # all noises at one restitution, some at two more; 40 minutes
    python -m benchmarks fit_coverage --quick   # one restitution, ten trajectories; --runs 40 for another number

The trajectories are made by the event-driven reference, which shares no code with the fit: N = 64, ν = 0.6, 100 frames
over a strain of 0.5. Noise is added to positions and velocities, and discs are removed at random. The fit does not know
the noise. Its limits were chosen on trajectories of another seed.
"""

import time
from collections.abc import Iterable
from dataclasses import replace

import jax
import numpy as np

import jaxgran as jg
from benchmarks.independent.event_driven import Discs, Law, discs_of, sheared
from benchmarks.output import Output
from jaxgran.model.checks import InputError

GRAINS, FRACTION, FRAMES, STRAIN = 64, 0.6, 100, 0.5
RESTITUTIONS = (0.6, 0.3, 0.9)
RUNS, FEW_RUNS = 100, 10
CONTACT_DURATION = 1e-6  # of the reference, in 1/γ̇: no collapse can last
SETTLING = 2.0  # strain before the first trajectory
BETWEEN = 0.5  # strain from one trajectory to the next
SEED = 1  # 0 made the trajectories on which the limits of the fit were chosen

# Noise of velocities over their root mean square (None: no velocities), of positions in σ, and share of discs not seen
NOISES = [(v, x, m) for v in (0.0, 0.01, 0.05, None) for x in (1e-4, 1e-3) for m in (0.0, 0.1)]
FEW_NOISES = [(0.0, 1e-4, 0.0), (0.05, 1e-3, 0.0), (0.05, 1e-3, 0.1), (None, 1e-4, 0.0)]


def trajectories(
    restitution: float, runs: int, fraction: float = FRACTION, frames: int = FRAMES, strain: float = STRAIN
) -> list[jg.Tracks]:
    """Tracks without noise, one after the other of one flow."""
    flow = jg.ShearFlow(GRAINS, restitution, fraction, 1e-3)
    return successive(discs_of(jg.prepare(flow, jax.random.key(SEED))), restitution, runs, frames, strain)


def successive(discs: Discs, restitution: float, runs: int, frames: int, strain: float) -> list[jg.Tracks]:
    """Tracks without noise of successive parts of one event-driven flow, after it has settled."""
    law, tracks = Law(restitution, CONTACT_DURATION), []
    discs, _ = sheared(discs, law, SETTLING)
    for _ in range(runs):
        discs, one = trajectory(discs, law, frames, strain)
        tracks.append(one)
        discs, _ = sheared(discs, law, BETWEEN)
    return tracks


def trajectory(discs: Discs, law: Law, frames: int, strain: float) -> tuple[Discs, jg.Tracks]:
    """The discs after a strain, and their tracks on the way."""
    positions, velocities, cell = [], [], []
    for k in range(frames):
        if k:
            discs, _ = sheared(discs, law, strain / (frames - 1))
        positions.append(discs.positions.copy())
        velocities.append(discs.velocities.copy())
        velocities[-1][:, 0] += law.shear_rate * discs.positions[:, 1]
        cell.append((discs.side, discs.side, discs.side * (discs.tilt - np.floor(discs.tilt + 0.5))))
    times = strain * np.arange(frames) / (frames - 1)
    arrays = (np.array(x) for x in (positions, velocities, cell))
    return discs, jg.Tracks(times, 2 * discs.radii, discs.masses, *arrays, law.shear_rate)


def peculiar_velocities(tracks: jg.Tracks) -> np.ndarray:
    """Velocities less those of the shear, at γ̇ = 1."""
    return tracks.velocities - np.stack([tracks.positions[..., 1], 0 * tracks.positions[..., 1]], axis=-1)


def with_noise(tracks: jg.Tracks, velocity: float | None, position: float, missing: float, seed: int) -> jg.Tracks:
    """Tracks with noise, without a share of the discs, and where ``velocity`` is None without velocities."""
    rng = np.random.default_rng([SEED, seed])
    error = np.nan if velocity is None else velocity * np.sqrt(np.mean(peculiar_velocities(tracks) ** 2))
    positions = tracks.positions + position * rng.normal(size=tracks.positions.shape)
    velocities = tracks.velocities + error * rng.normal(size=tracks.positions.shape)
    unseen = rng.random(tracks.positions.shape[:2]) < missing
    positions[unseen], velocities[unseen] = np.nan, np.nan
    return replace(tracks, positions=positions, velocities=velocities)


def fit_all(tracks: Iterable[jg.Tracks]) -> tuple[list[jg.RestitutionFit], int]:
    """The fits that end with a result, and the number of the others."""
    fits, refused = [], 0
    for one in tracks:
        try:
            fits.append(jg.fit_restitution(one))
        except (InputError, RuntimeError):
            refused += 1
    return fits, refused


def fit_statistics(fits: list[jg.RestitutionFit], restitution: float) -> dict[str, float]:
    """How many intervals cover the restitution, and bias and scatter of the fits."""
    off, errors = np.array([(fit.restitution - restitution, fit.stderr) for fit in fits]).T
    return {
        "held": sum(fit.low <= restitution <= fit.high for fit in fits),
        "bias_in_errors": float(np.mean(off / errors)),
        "spread_in_errors": float(np.std(off / errors, ddof=1)),
        "bias": float(np.mean(off)),
        "bias_stderr": float(np.std(off, ddof=1) / np.sqrt(len(off))),
        "stderr": float(np.median(errors)),
        "collisions": float(np.mean([fit.collisions for fit in fits])),
        "rejected": float(np.mean([fit.rejected for fit in fits])),
        "misfit": float(np.median([fit.misfit for fit in fits])),
    }


def row(tracks: list[jg.Tracks], restitution: float, velocity: float | None, position: float, missing: float) -> dict:
    """Coverage and bias of the fits of all trajectories with one noise."""
    start = time.perf_counter()
    fits, refused = fit_all(with_noise(one, velocity, position, missing, seed) for seed, one in enumerate(tracks))
    head = {"restitution": restitution, "velocity_noise": velocity, "position_noise": position, "missing": missing}
    head |= {"fits": len(fits), "refused": refused, "seconds": (time.perf_counter() - start) / len(tracks)}
    return head | fit_statistics(fits, restitution)


def report_line(row: dict) -> str:
    noise = "none" if row["velocity_noise"] is None else f"{100 * row['velocity_noise']:g} %"
    return (
        f"α {row['restitution']:g}, velocities {noise}, positions {row['position_noise']:g}, "
        f"missing {100 * row['missing']:g} %: {row['held']} of {row['fits']} intervals hold, "
        f"bias {row['bias_in_errors']:+.2f} ± {row['spread_in_errors'] / np.sqrt(row['fits']):.2f} errors, spread "
        f"{row['spread_in_errors']:.2f}, error {row['stderr']:.1e}, {row['collisions']:.0f} collisions, "
        f"{row['rejected']:.0f} rejected, refused {row['refused']}, misfit {row['misfit']:.2f}, {row['seconds']:.2f} s"
    )


def run(output: Output, runs: int | None = None) -> None:
    """Fit all trajectories with all noises, print, and write JSON."""
    rows = []
    for restitution in RESTITUTIONS[:1] if output.quick else RESTITUTIONS:
        tracks = trajectories(restitution, runs or (FEW_RUNS if output.quick else RUNS))
        few = output.quick or restitution != RESTITUTIONS[0]
        for noise in FEW_NOISES if few else NOISES:
            rows.append(row(tracks, restitution, *noise))
            print(report_line(rows[-1]), flush=True)
    output.write_json("fit_coverage", {"grains": GRAINS, "packing_fraction": FRACTION, "rows": rows})
