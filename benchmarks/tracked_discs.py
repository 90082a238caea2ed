"""A file of tracked discs, as a camera sees them, of the event-driven reference: what a fit of restitution is shown on.

    python -m benchmarks tracked_discs --output notebooks    # the committed file, notebooks/tracked_discs.csv
    python -m benchmarks tracked_discs --quick               # fewer frames

64 discs of about 5 mm with restitution 0.73 are sheared at 1/s and seen at 200 frames per second. The camera sees one
cell of the periodic flow, and knows nothing of the others: a disc that leaves it through a side is a new one where it
enters, with a new id. What the camera sees has noise, and 5 % of the discs are not found in a frame.

No jaxgran and no mathematical library is asked for the motion, so the file has the same bytes on every processor.
"""

from math import fsum, pi, sqrt

import numpy as np

from benchmarks.independent.event_driven import Discs, Law, sheared
from benchmarks.output import Output

RESTITUTION = 0.73
ROWS, FRACTION = 8, 0.6  # discs along a side of the cell, packing fraction
DIAMETERS = (0.9, 1.1)  # σ; the lattice at the start has room for them
SETTLING = 3.0  # strain before the first frame
FRAMES, FEW_FRAMES, RATE = 100, 30, 200  # per second
CONTACT_DURATION = 1e-6  # 1/γ̇, of the reference: no collapse can last
MILLIMETRES = 5.0  # of σ; the shear rate is 1/s
POSITION_NOISE = 0.005  # mm
VELOCITY_NOISE = 0.5  # mm/s
DIAMETER_NOISE = 0.01  # mm, one error for each disc
MISSING = 0.05
SEED = 5
COLUMNS = {"frame": "d", "id": "d", "x": ".3f", "y": ".3f", "vx": ".2f", "vy": ".2f", "diameter": ".3f"}


def discs_at_rest(rng: np.random.Generator) -> Discs:
    """Discs on a square lattice, with slow random velocities and no tilt."""
    count = ROWS**2
    radii = rng.uniform(*DIAMETERS, count) / 2
    side = sqrt(pi * fsum(radii**2) / FRACTION)
    place = (np.arange(ROWS) + 0.5) * side / ROWS
    positions = np.stack([np.tile(place, ROWS), np.repeat(place, ROWS)], axis=-1)
    velocities = rng.uniform(-1, 1, (count, 2))
    return Discs(radii, 4 * radii**2, positions, velocities, np.full(count, -np.inf), side, 0.0)


def picture(discs: Discs, shear_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera sees each disc, in [0, side)², and how fast."""
    rows = np.floor(discs.positions[:, 1] / discs.side)
    x = discs.positions[:, 0] - rows * discs.side * discs.tilt
    columns = np.floor(x / discs.side)
    places = np.stack([x, discs.positions[:, 1]], axis=-1) - discs.side * np.stack([columns, rows], axis=-1)
    velocities = discs.velocities.copy()  # peculiar, so that of every image
    velocities[:, 0] += shear_rate * places[:, 1]
    return places, velocities


def rows(frames: int) -> list[str]:
    """The lines of the file."""
    rng, law = np.random.default_rng(SEED), Law(RESTITUTION, CONTACT_DURATION)
    discs, _ = sheared(discs_at_rest(rng), law, SETTLING)
    diameters = MILLIMETRES * 2 * discs.radii + DIAMETER_NOISE * rng.normal(size=len(discs.radii))
    ids = rng.permutation(len(discs.radii))
    lines, before = [",".join(COLUMNS)], None
    for frame in range(frames):
        if frame:
            discs, _ = sheared(discs, law, 1 / RATE)
        places, velocities = picture(discs, law.shear_rate)
        if before is not None:
            entered = np.any(np.abs(places - before) > discs.side / 2, axis=1)
            ids[entered] = ids.max() + 1 + np.arange(np.count_nonzero(entered))
        before = places
        x = MILLIMETRES * places + POSITION_NOISE * rng.normal(size=places.shape)
        v = MILLIMETRES * velocities + VELOCITY_NOISE * rng.normal(size=places.shape)
        for k in np.flatnonzero(rng.random(len(ids)) >= MISSING):
            numbers = (frame, ids[k], *x[k], *v[k], diameters[k])
            lines.append(",".join(format(n, form) for n, form in zip(numbers, COLUMNS.values(), strict=True)))
    return lines


def run(output: Output) -> None:
    """Write the file."""
    path = output.path("tracked_discs", ".csv")
    path.write_text("\n".join(rows(FEW_FRAMES if output.quick else FRAMES)) + "\n", encoding="utf-8", newline="\n")
    print(f"wrote {path.name}, {path.stat().st_size / 1000:.0f} kB")
