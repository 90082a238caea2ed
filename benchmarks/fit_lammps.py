"""Is the restitution of soft discs that LAMMPS has moved found from its dump?

    python -m benchmarks fit_lammps           # three stiffnesses, 20 flows each
    python -m benchmarks fit_lammps --quick   # two flows each

LAMMPS moves 64 sheared discs as damped springs (``pair_style granular``, ``hooke`` with ``damping coeff_restitution``,
no friction) and writes a text dump of 100 frames over a strain of 0.5, with its own format of numbers. The damping
goes with the reduced mass, so that two discs alone have one restitution, whatever their masses and speed:
α = exp(−πζ/√(1 − ζ²)) of a damped spring in half a period (manual of LAMMPS, pair_style granular; T. Schwager and
T. Pöschel, Granular Matter 9, 465, 2007, on what ends a contact). The time step of 1/200 of a contact adds an error to
it, so it is measured too, on pairs that meet head-on. The stiffness is chosen by the duration of a contact over the
mean free time of hard discs, which the event-driven reference gives, as it gives the discs at the start.

Each dump is fitted as ``jaxgran fit dump.lammpstrj`` does it, as it is, and with each third frame only, without and
with a noise that stands for the duration of the contacts. The command itself is run on the first dump of each
stiffness, and what it prints is kept.
"""

import subprocess
import sys
import tempfile
from dataclasses import replace
from math import log, pi
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxgran as jg
from benchmarks.fit_coverage import fit_statistics
from benchmarks.independent.event_driven import Law, averages, sheared
from benchmarks.output import Output
from benchmarks.peers import lammps, problem
from benchmarks.tracked_discs import FRACTION, ROWS, discs_at_rest
from jaxgran.model.checks import InputError

RESTITUTION = 0.7
DURATIONS = (1 / 10, 1 / 30, 1 / 100)  # of a contact, over the mean free time
STEPS_PER_CONTACT = 200
SKIN = 0.3  # σ
FRAMES, STRAIN = 100, 0.5
SETTLING = 2.5  # strain of the hard discs; ends at a tilt of a half
RUNS, FEW_RUNS = 20, 2
PAIRS = 50  # that meet head-on
REDUCED = 0.5  # mass of two mean discs
DUMP = "id x y vx vy radius"


class Way(NamedTuple):
    """How a dump is fitted."""

    stride: int
    noise: dict[str, float]
    positions_alone: bool = False


NOISE = {"position_noise": 1e-3, "velocity_noise": 5e-3}  # σ and σ/t: what a contact of some duration is off by
WAYS = {  # by the options of the command
    "": Way(1, {}),
    "--stride 3": Way(3, {}),
    "--stride 3 --position-noise 0.001 --velocity-noise 0.005": Way(3, NOISE),
    "--stride 3 --position-noise 0.001, positions alone": Way(3, {"position_noise": 1e-3}, True),
}


def start(seed: int) -> tuple[problem.Discs, float]:
    """Hard discs in steady shear at a tilt of −½, and the mean free time of a disc."""
    discs, law = discs_at_rest(np.random.default_rng(seed)), Law(RESTITUTION, 1e-6)
    discs, sums = sheared(discs, law, SETTLING)
    free = 1 / float(averages(sums, discs)["collision_rate"][0])
    return problem.Discs(discs.positions, discs.velocities, discs.radii, discs.masses, discs.side, -0.5), free


def stiffness_of(duration: float) -> float:
    """The stiffness of a spring with a contact of this duration between two mean discs."""
    return REDUCED * (pi**2 + log(RESTITUTION) ** 2) / duration**2


def dumped(discs: problem.Discs, stiffness: float, path: Path) -> None:
    """Shear soft discs to a tilt of zero, and then write their dump up to a tilt of a half."""
    flow = problem.Flow(RESTITUTION, FRACTION)
    longest = problem.soft_timestep(discs, RESTITUTION, stiffness, STEPS_PER_CONTACT)
    between = int(np.ceil(STRAIN / (FRAMES - 1) / longest))
    program = lammps.set_up(discs, flow, stiffness, SKIN, STRAIN / (FRAMES - 1) / between)
    program.command("fix shear all deform 1 xy erate 1.0 remap v flip no")
    program.command(f"run {between * (FRAMES - 1)}")
    program.command(f"dump tracks all custom {between} {path} {DUMP}")
    program.command(f"run {between * (FRAMES - 1)}")
    program.close()


def head_on(stiffness: float) -> tuple[float, float]:
    """Mean and standard deviation of the restitution of pairs that meet head-on, with unequal masses and speeds."""
    rng = np.random.default_rng(0)
    radii, side = rng.uniform(0.45, 0.55, 2 * PAIRS), 4.0 * PAIRS
    reach = radii[::2] + radii[1::2]
    contact = pi * np.sqrt(REDUCED / stiffness)
    speeds = rng.uniform(1, 5, PAIRS)
    left = np.stack([4.0 * np.arange(PAIRS) + 1, np.full(PAIRS, side / 2)], axis=-1)
    # Any instant within a step: each pair has its own distance
    right = left + np.stack([reach + speeds * contact * rng.uniform(0.2, 0.5, PAIRS), np.zeros(PAIRS)], axis=-1)
    positions = np.stack([left, right], axis=1).reshape(-1, 2)
    velocities = np.zeros((2 * PAIRS, 2))
    velocities[::2, 0] = speeds
    discs = problem.Discs(positions, velocities, radii, (2 * radii) ** 2, side, 0.0)
    timestep = problem.soft_timestep(discs, RESTITUTION, stiffness, STEPS_PER_CONTACT)
    program = lammps.set_up(discs, problem.Flow(RESTITUTION, FRACTION, 0.0), stiffness, SKIN, timestep)
    program.command(f"run {int(3 * contact / timestep)}")
    own = program.extract_setting("nlocal")
    order = np.argsort(program.numpy.extract_atom("id")[:own])
    after = program.numpy.extract_atom("v")[order, 0].reshape(-1, 2)
    program.close()
    found = (after[:, 1] - after[:, 0]) / speeds
    return float(found.mean()), float(found.std(ddof=1))


def deepest_overlap(tracks: jg.Tracks) -> float:
    """The largest overlap of all frames, σ."""
    radii, deepest = tracks.diameters / 2, 0.0
    for x, (side, _, offset) in zip(tracks.positions, tracks.cell, strict=True):
        deepest = max(deepest, problem.overlaps(problem.Discs(x, x, radii, radii, side, offset / side))[1])
    return deepest


def summary(fits: list[jg.RestitutionFit], refused: list[str], restitution: float) -> dict:
    """Coverage and bias of the fits in one way."""
    few = {"fits": len(fits), "refused": refused}
    if len(fits) < 2:
        return few
    diameter_noise = float(np.median([fit.diameter_noise for fit in fits]))
    return few | fit_statistics(fits, restitution) | {"diameter_noise": diameter_noise}


def row(duration: float, runs: int, folder: Path) -> dict:
    """All flows with one duration of contact."""
    found: dict[str, list] = {name: [] for name in WAYS}
    refused: dict[str, list] = {name: [] for name in WAYS}
    deepest, printed, stiffness, truth = [], {}, 0.0, (0.0, 0.0)
    path = folder / "dump.lammpstrj"
    for seed in range(runs):
        discs, free = start(seed)
        if seed == 0:
            stiffness = stiffness_of(duration * free)
            truth = head_on(stiffness)
        dumped(discs, stiffness, path)
        deepest.append(deepest_overlap(jg.read_tracks(path)))
        for name, way in WAYS.items():
            if seed == 0 and not way.positions_alone:
                words = [sys.executable, "-m", "jaxgran", "fit", path.name, *name.split()]
                done = subprocess.run(words, cwd=folder, capture_output=True, text=True)
                printed[name] = done.stdout + done.stderr
            tracks = jg.read_tracks(path, stride=way.stride)
            if way.positions_alone:
                tracks = replace(tracks, velocities=np.full_like(tracks.velocities, np.nan))
            try:
                found[name].append(jg.fit_restitution(tracks, **way.noise))
            except (InputError, RuntimeError) as why:
                refused[name].append(str(why))
    return {
        "contact_over_free_time": duration,
        "contact_over_frame": duration * free / (STRAIN / (FRAMES - 1)),
        "stiffness": stiffness,
        "restitution_by_formula": RESTITUTION,
        "restitution_of_pairs": truth[0],
        "spread_of_pairs": truth[1],
        "overlap": float(np.median(deepest)),
        "fits": {name: summary(found[name], refused[name], truth[0]) for name in WAYS},
        "printed": printed,
    }


def report_lines(row: dict) -> str:
    first = (
        f"contact {row['contact_over_free_time']:.3g} of the free time, {row['contact_over_frame']:.2g} frames, "
        f"k = {row['stiffness']:.2g}, overlap {row['overlap']:.2g} σ, pairs {row['restitution_of_pairs']:.4f} ± "
        f"{row['spread_of_pairs']:.4f}"
    )
    lines = [first]
    for name, of in row["fits"].items():
        words = f"{name or 'as it is'}: {of['fits']} fits, {len(of['refused'])} refused"
        if of["fits"] > 1:
            words += (
                f", bias {of['bias']:+.5f} ± {of['bias_stderr']:.5f}, error {of['stderr']:.5f}, spread "
                f"{of['spread_in_errors']:.2f} errors, {of['held']} hold, {of['collisions']:.0f} collisions, "
                f"{of['rejected']:.0f} rejected, misfit {of['misfit']:.2f}"
            )
        lines.append(words)
    return "\n  ".join(lines)


def run(output: Output) -> None:
    """Make, dump and fit all flows, print, and write JSON."""
    if lack := lammps.missing():
        print(lack)
        return
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for duration in DURATIONS:
            rows.append(row(duration, FEW_RUNS if output.quick else RUNS, Path(folder)))
            print(report_lines(rows[-1]), flush=True)
    head = {"lammps": lammps.version(), "grains": ROWS**2, "packing_fraction": FRACTION, "frames": FRAMES}
    output.write_json("fit_lammps", {**head, "strain": STRAIN, "dump": DUMP, "rows": rows})
