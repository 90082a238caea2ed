"""Trajectories in GSD files, for OVITO, freud and HOOMD-blue, and for reading back.

The GSD box is centred at the origin and spanned by (ℓ, 0) and (tilt·ℓ, ℓ), the lattice of the
sheared cell. Chunks of the GSD schema have single precision; further chunks store exact values, so
a state is read back bit for bit.

=============================  ==============  ======  =============================================
chunk                          shape           unit    meaning
=============================  ==============  ======  =============================================
configuration/step             (1,)            –       time steps since the first frame
configuration/box              (6,)            σ, –    ℓ, ℓ, 0, tilt, 0, 0; two dimensions
particles/position             (grains, 3)     σ       centres, in the box around the origin; z = 0
particles/velocity             (grains, 3)     σ/t     peculiar velocities c, before the contacts
                                                       act; in the laboratory c + γ̇ y x̂ with y of
                                                       the exact position, from the lower edge
particles/diameter, /mass      (grains,)       σ, m    diameters and masses
bonds/group                    (bonds, 2)      –       pairs i < j of grains in loaded contact in
                                                       the steps of ``force_strain``
log/bonds/force                (bonds,)        mσ/t²   their forces J/dt, mean over these steps
log/particles/contact_force    (grains,)       mσ/t²   sum of the forces of its bonds, by magnitude
log/particles/cluster          (grains,)       –       number of its cluster, joined by bonds
log/particles/cluster_size     (grains,)       –       grains of its cluster; 1 without bonds
log/particles/exact_position   (grains, 2)     σ       positions of the state, in [0, ℓ)
log/particles/exact_velocity   (grains, 2)     σ/t     velocities of the state
log/particles/exact_radius     (grains,)       σ       radii; in the first frame only
log/particles/exact_mass       (grains,)       m       masses; in the first frame only
log/jaxgran/side, /tilt        (1,)            σ, –    side and tilt of the state
log/jaxgran/strain             (1,)            –       strain since the first frame
log/jaxgran/force_strain       (1,)            –       strain over which forces are averaged
log/jaxgran/status             (1,)            –       worst ``Status`` of these steps; above 0,
                                                       forces may be missing or not converged
log/jaxgran/timestep           (1,)            t       dt
log/jaxgran/shear_rate         (1,)            1/t     γ̇
log/jaxgran/restitution        (1,)            –       α
log/jaxgran/format_version     (1,)            –       other versions are refused
=============================  ==============  ======  =============================================
"""

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsd.fl
import gsd.hoomd
import numpy as np
from jaxtyping import Float, Int

from jaxgran.analysis.contacts import pair_forces
from jaxgran.analysis.series import series
from jaxgran.contact.clusters import cluster_labels
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.engine import checked_numerics
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.dynamics.snapshots import snapshots_from
from jaxgran.files import atomic_write, other_version
from jaxgran.io.paths import as_path, require_absent, require_place
from jaxgran.model.cell import centred, remap_tilt
from jaxgran.model.checks import (
    InputError,
    as_array,
    at_most,
    refused,
    require,
    require_number,
    short_repr,
)
from jaxgran.model.flow import ShearFlow, require_sheared, steps_of_strain
from jaxgran.model.grains import Grains
from jaxgran.model.state import State, require_state
from jaxgran.model.status import MEANINGS, Status
from jaxgran.model.values import Value

FORMAT_VERSION = 2
"""Version of the chunks of jaxgran."""

_SCHEMA_VERSION = [1, 4]  # gsd 5 writes 2.0 by default, which older versions of gsd reject


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Value):
    """States and parameters of a flow, read from the frames of a file.

    ================  =========  =====  ============================================================
    field             shape      unit   meaning
    ================  =========  =====  ============================================================
    state             State      –      states with a leading (frames,) axis, before the contacts
                                        act
    step              (frames,)  –      time steps since the first frame
    strain            (frames,)  –      strain since the first frame
    status            (frames,)  –      ``Status`` of the contact forces; above 0, some may be
                                        missing or not converged
    timestep          ()         t      dt
    shear_rate        ()         1/t    γ̇
    restitution       ()         –      α
    packing_fraction  ()         –      ν
    ================  =========  =====  ============================================================

    All are NumPy arrays, in double precision even if JAX uses single precision.
    """

    state: State
    step: Int[np.ndarray, " frames"]
    strain: Float[np.ndarray, " frames"]
    status: Int[np.ndarray, " frames"]
    timestep: Float[np.ndarray, ""]
    shear_rate: Float[np.ndarray, ""]
    restitution: Float[np.ndarray, ""]
    packing_fraction: Float[np.ndarray, ""]


def check_trajectory(path: Path) -> None:
    """Raise an InputError unless a trajectory can be written to ``path``."""
    require_place(path, "trajectory", ".gsd")
    if os.fsencode(path).decode(errors="ignore") != str(path):  # the GSD library needs UTF-8 names
        raise refused("trajectory", str(path), "must be a file name in UTF-8")


def write_frame(path: Path, frame: Snapshot, step: int) -> None:
    """Append a frame to a trajectory; step 0 starts a new file, replacing an old one.

    Args:
      path: GSD file, complete after every frame. Where the file system fails to take a frame, it
        ends with the one before.
      frame: one snapshot of the flow; or a series of every time step from the frame on, whose
        forces are averaged.
      step: time steps since the first frame.

    Raises:
      OSError: with the name of the file.
    """
    if step == 0:
        with atomic_write(path) as temporary:
            _append(temporary, frame, 0)
        return
    size = path.stat().st_size
    try:
        _append(path, frame, step)
    except OSError as error:
        os.truncate(path, size)
        if error.errno:
            error.filename = str(path)
        raise


def write_trajectory(
    path: str | os.PathLike,
    flow: ShearFlow,
    states: State,
    strain: Sequence[float] | np.ndarray,
    *,
    overwrite: bool = False,
    force_strain: float | None = None,
    solver: ProjectedMethod = DEFAULT_SOLVER,
) -> None:
    """Write states of a flow and their contact forces as a GSD file.

    Args:
      path: GSD file, with the ending ``.gsd``.
      flow: parameters of the flow.
      states: states with a leading (frames,) axis, such as ``state`` of the series of
        ``snapshot_series``.
      strain: strain at each frame, shape (frames,), increasing; stored as a number of time steps
        since the first.
      overwrite: whether to replace an existing file.
      force_strain: strain from each state on over which the contact forces are averaged; None for
        one time step.
      solver: solves the contacts of the time steps after each state.

    Raises:
      InputError: (a ValueError) the file exists or cannot be written; the states have no leading
        axis, are not finite, have different grains or do not fit the flow; their tilts contradict
        the strain, or it does not increase by at least one time step from frame to frame; or a
        frame averages forces beyond the next one.

    Warns:
      UserWarning: contact forces of a frame are missing or not converged, see ``status`` of
        ``Trajectory``.
    """
    path = as_path("path", path)
    check_trajectory(path)
    if not overwrite:
        require_absent(path, "path")
    numbers = as_array(strain)
    require("strain", numbers, np.isfinite, "one number for each of the states")
    strains = np.asarray(numbers, np.float64)
    steps = _steps_of_frames(flow, states, strains)
    numerics = checked_numerics(solver, None)
    if force_strain is not None:
        least = float(np.min(np.diff(strains), initial=np.inf))
        accepted = f"above 0 and at most the strain between frames, {least:g}"
        require_number(
            "force_strain", force_strain, lambda x: (x > 0) & at_most(x, least), accepted
        )
    worst = Status.ok
    with atomic_write(path) as temporary:
        for number, step in enumerate(steps):
            frame = snapshots_from(flow, numerics, states[number], force_strain or 0.0)
            worst = max(worst, np.max(frame.status))
            _append(temporary, frame, step)
    if worst > Status.ok:
        warnings.warn(lost_forces(worst), stacklevel=2)


def lost_forces(worst: int) -> str:
    """What the worst status of all frames says about their contact forces, in a sentence."""
    name = Status(worst).name
    return f"forces of some frames are missing or not converged, status {name}: {MEANINGS[name]}."


def _steps_of_frames(flow: ShearFlow, states: State, strains: np.ndarray) -> list[int]:
    """Time steps from the first state to each; an InputError unless all are finite states of the
    flow with the same grains, and fit the strains.
    """
    if not isinstance(states, State) or np.ndim(states.side) != 1 or np.size(states.side) == 0:
        raise InputError(
            "states must have one leading axis of frames: stack them, or take those of "
            "snapshot_series."
        )
    for number in range(len(states)):
        try:
            require_state(flow, states[number])
        except InputError as mistake:
            raise InputError(f"state {number} cannot be written: {mistake}") from None
        if states[number].grains != states[0].grains:
            raise InputError(
                f"states must have the same grains, and state {number} has others than the first."
            )
    if strains.shape != (len(states),):
        raise InputError(f"strain must have one number for each of the {len(states)} states.")
    require_sheared(flow)
    steps = steps_of_strain(flow, strains - strains[0])
    apart, count = np.diff(strains), np.diff(steps)
    if not np.all(count >= 1):
        raise InputError("strain must increase by at least one time step from frame to frame.")
    # tilt and strain agree up to a time step, as both are rounded to whole ones, and to the
    # rounding of each step
    wrong = remap_tilt(np.diff(np.asarray(states.tilt, np.float64)) - apart)
    allowed = 1.01 * apart / count + np.finfo(states.tilt.dtype).eps * count
    if np.any(bad := np.abs(wrong) > allowed):
        raise InputError(
            "strain must be that by which the cell is tilted between the states: states "
            f"{(k := int(np.argmax(bad)))} and {k + 1} differ by {wrong[k]:.3g} from it."
        )
    return steps.astype(int).tolist()


def _append(path: Path, snapshots: Snapshot, step: int) -> None:
    """Append the first of one or more snapshots, with the mean forces of all; step 0 is a new
    file.
    """
    about: Any = {"application": "jaxgran", "schema": "hoomd", "schema_version": _SCHEMA_VERSION}
    with gsd.fl.open(str(path), "r+" if step else "x", **about) as file:  # closing it flushes it
        gsd.hoomd.HOOMDTrajectory(file).append(_gsd_frame(series(snapshots), step))


def _gsd_frame(snapshots: Any, step: int) -> Any:
    first, (bonds, forces, _) = snapshots[0], pair_forces(snapshots)
    state, grains = first.state, first.state.grains
    count, side, tilt = len(grains.radii), state.side.item(), state.tilt.item()
    strain_of_step = first.timestep.item() * first.shear_rate.item()
    labels, sizes = cluster_labels(bonds[:, 0], bonds[:, 1], count)
    frame: Any = gsd.hoomd.Frame()
    frame.configuration.step = step
    frame.configuration.dimensions = 2
    frame.configuration.box = [side, side, 0, tilt, 0, 0]
    frame.particles.N = count
    frame.particles.position = np.pad(centred(state.positions, side, tilt), ((0, 0), (0, 1)))
    frame.particles.velocity = np.pad(state.velocities, ((0, 0), (0, 1)))
    frame.particles.diameter = 2 * grains.radii
    frame.particles.mass = grains.masses
    frame.bonds.N = len(bonds)
    frame.bonds.types = ["contact"]
    frame.bonds.typeid = np.zeros(len(bonds), np.uint32)
    frame.bonds.group = bonds
    log = {
        "bonds/force": forces,
        "particles/contact_force": np.bincount(bonds.ravel(), np.repeat(forces, 2), count),
        "particles/cluster": labels.astype(np.uint32),
        "particles/cluster_size": sizes.astype(np.uint32),
        "particles/exact_position": state.positions,
        "particles/exact_velocity": state.velocities,
        "jaxgran/side": [state.side],
        "jaxgran/tilt": [state.tilt],
        "jaxgran/strain": [step * strain_of_step],
        "jaxgran/force_strain": [len(snapshots) * strain_of_step],
        "jaxgran/status": [np.max(snapshots.status)],
        "jaxgran/timestep": [first.timestep.astype(float)],
        "jaxgran/shear_rate": [first.shear_rate.astype(float)],
        "jaxgran/restitution": [first.restitution.astype(float)],
        "jaxgran/format_version": [FORMAT_VERSION],
    }
    if step == 0:
        log |= {"particles/exact_radius": grains.radii, "particles/exact_mass": grains.masses}
    frame.log = {name: np.array(values) for name, values in log.items()}  # writable copies
    return frame


def read_trajectory(path: str | os.PathLike) -> Trajectory:
    """Read a trajectory that jaxgran has written, bit for bit.

    Args:
      path: GSD file.

    Returns:
      The states of all frames and the parameters of the flow.

    Raises:
      InputError: (a ValueError) the file does not exist, is not such a trajectory, or has another
        version of the format; the message says why.
    """
    path = as_path("path", path)
    name = short_repr(str(path))
    if not path.is_file():
        raise InputError(f"there is no file {name}.")
    try:
        with gsd.hoomd.open(path) as file:
            frames = list(file)
        version = frames[0].log.get("jaxgran/format_version", [None])[0] if frames else None
        trajectory = _trajectory(frames) if version == FORMAT_VERSION else None
    except Exception as error:  # a damaged file may raise any exception
        reason = short_repr(str(error)).strip("'\"").rstrip(".")
        raise InputError(f"{name} is not a readable GSD file: {reason}.") from None
    if trajectory is None:
        raise InputError(other_version(name, version, FORMAT_VERSION))
    return trajectory


def _trajectory(frames: Sequence[gsd.hoomd.Frame]) -> Trajectory:
    def column(name: str) -> Any:
        return np.stack([frame.log[name] for frame in frames])

    def number(name: str) -> Any:
        return column(f"jaxgran/{name}")[:, 0]

    radii, masses, positions, velocities = (
        column(f"particles/exact_{x}") for x in ("radius", "mass", "position", "velocity")
    )
    side = number("side")
    area = np.sum(np.pi * radii[0] ** 2, dtype=np.float64)
    return Trajectory(
        state=State(Grains(radii, masses), positions, velocities, side, number("tilt")),
        step=np.array([frame.configuration.step for frame in frames]),
        strain=number("strain"),
        status=number("status"),
        timestep=np.array(number("timestep")[0]),
        shear_rate=np.array(number("shear_rate")[0]),
        restitution=np.array(number("restitution")[0]),
        packing_fraction=area / np.asarray(side[0], np.float64) ** 2,
    )
