"""Trajectories in GSD files, for OVITO, freud and HOOMD-blue, and for reading back.

The GSD box is centred at the origin and spanned by (L, 0) and (tilt·L, L), the lattice of the
sheared cell. Chunks of the GSD schema have single precision; further chunks store exact values, so
a state is read back bit for bit.

=============================  ==============  ======  =============================================
chunk                          shape           unit    meaning
=============================  ==============  ======  =============================================
configuration/step             (1,)            –       time steps since the first frame
configuration/box              (6,)            σ, –    L, L, 0, tilt, 0, 0; two dimensions
particles/position             (grains, 3)     σ       centres, in the box around the origin; z = 0
particles/velocity             (grains, 3)     σγ̇      peculiar velocities c, before the contacts
                                                       act; in the laboratory c + γ̇ y x̂, up to the
                                                       velocity of the origin
particles/diameter, /mass      (grains,)       σ, m    diameters and masses
bonds/group                    (bonds, 2)      –       pairs i < j of grains in loaded contact in
                                                       the steps that follow,
                                                       one step or those of a strain
log/bonds/force                (bonds,)        mσγ̇²    their contact forces, impulse p over dt,
                                                       mean over these steps
log/particles/contact_force    (grains,)       mσγ̇²    sum of the forces of its bonds, by magnitude
log/particles/cluster          (grains,)       –       number of its cluster; grains of one cluster
                                                       are joined by bonds
log/particles/cluster_size     (grains,)       –       grains of its cluster; 1 without bonds
log/particles/exact_position   (grains, 2)     σ       positions of the state, in [0, L)
log/particles/exact_velocity   (grains, 2)     σγ̇      velocities of the state
log/particles/exact_radius     (grains,)       σ       radii; in the first frame only
log/particles/exact_mass       (grains,)       m       masses; in the first frame only
log/jaxgran/side, /tilt        (1,)            σ, –    side and tilt of the state
log/jaxgran/strain             (1,)            –       strain since the first frame
log/jaxgran/force_strain       (1,)            –       strain over which forces are averaged; dt for
                                                       one step
log/jaxgran/timestep           (1,)            1/γ̇     dt
log/jaxgran/shear_rate         (1,)            1/t     γ̇
log/jaxgran/restitution        (1,)            –       α
log/jaxgran/format_version     (1,)            –       of these chunks; files of another one are
                                                       refused
=============================  ==============  ======  =============================================
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxgran.contact.clusters import cluster_labels
from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.engine import checked_numerics
from jaxgran.dynamics.snapshots import Snapshot, snapshots_from
from jaxgran.files import atomic_write, other_version
from jaxgran.io.paths import require_place
from jaxgran.model.batches import equal_values
from jaxgran.model.cell import centred, remap_tilt, wrap
from jaxgran.model.checks import InputError, require_number, short_repr
from jaxgran.model.flow import ShearFlow, steps_of_strain
from jaxgran.model.grains import Grains
from jaxgran.model.state import State, require_state

FORMAT_VERSION = 1
"""Version of the chunks of jaxgran."""

_SCHEMA_VERSION = [1, 4]  # gsd 5 writes 2.0 by default, which older versions of gsd reject
_NUMBERS = ("strain", "timestep", "shear_rate", "restitution")
_NEEDED = {"position": "positions", "velocity": "velocities"}
_EXACT = "log/particles/exact_"
_READ = (
    *(f"configuration/{name}" for name in ("step", "dimensions", "box")),
    *(f"particles/{name}" for name in ("N", "position", "velocity", "diameter", "mass")),
    *(f"{_EXACT}{name}" for name in ("position", "velocity", "radius", "mass")),
    *(f"log/jaxgran/{name}" for name in ("side", "tilt", "format_version", *_NUMBERS)),
)
Chunks = dict[str, Any]  # arrays of a frame by name


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Trajectory:
    """States and parameters of a flow, read from the frames of a file in its precision.

    ================  =========  =====  ============================================================
    field             shape      unit   meaning
    ================  =========  =====  ============================================================
    state             State      –      states with a leading (frames,) axis, before the contacts
                                        act
    step              (frames,)  –      time steps since the first frame
    strain            (frames,)  –      strain since the first frame
    timestep          ()         1/γ̇    dt
    shear_rate        ()         1/t    γ̇
    restitution       ()         –      α
    packing_fraction  ()         –      ν
    ================  =========  =====  ============================================================

    All are NumPy arrays, in double precision even if JAX uses single precision. Strain, time step,
    shear rate and restitution are NaN if the file, written by another program, does not contain
    them.
    """

    state: State
    step: Int[np.ndarray, " frames"]
    strain: Float[np.ndarray, " frames"]
    timestep: Float[np.ndarray, ""]
    shear_rate: Float[np.ndarray, ""]
    restitution: Float[np.ndarray, ""]
    packing_fraction: Float[np.ndarray, ""]

    __eq__ = equal_values


def check_trajectory(path: Path) -> None:
    """Raise an InputError unless a trajectory can be written to ``path``."""
    require_place(path, "trajectory", ".gsd")
    if os.fsencode(path).decode(errors="ignore") != str(path):  # the GSD library needs UTF-8 names
        raise InputError(f"trajectory must be a file name in UTF-8, not {short_repr(str(path))}.")


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
    if step:
        size = path.stat().st_size
        try:
            _write(path, "r+", frame, step)
        except OSError as error:
            os.truncate(path, size)
            if error.errno:
                error.filename = str(path)
            raise
    else:
        with atomic_write(path) as temporary:
            _write(temporary, "x", frame, 0)


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
      InputError: (a ValueError) the file exists or cannot be written, the states have no leading
        axis or do not fit the flow, the strain does not increase by at least one time step from
        frame to frame, or a frame averages forces beyond the next one.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"path must be a file name, not {short_repr(path)}.")
    path = Path(path)
    check_trajectory(path)
    if path.exists() and not overwrite:
        raise InputError(
            f"path must be a new file, or overwrite must be True: {short_repr(str(path))} exists."
        )
    if not isinstance(states, State) or np.ndim(states.side) != 1 or np.size(states.side) == 0:
        raise InputError(
            "states must have one leading axis of frames: stack them, or take those of "
            "snapshot_series."
        )
    strains = np.asarray(strain, np.float64)
    if strains.shape != np.shape(states.side):
        raise InputError(
            f"strain must have one number for each of the {np.size(states.side)} states."
        )
    steps = steps_of_strain(flow, strains - strains[0])
    if not np.all(np.diff(steps) >= 1):
        raise InputError("strain must increase by at least one time step from frame to frame.")
    frames = [jax.tree.map(lambda x, k=k: x[k], states) for k in range(len(steps))]
    for state in frames:
        require_state(flow, state)
    numerics = checked_numerics(solver, None)
    least = float(np.min(np.diff(strains), initial=np.inf))
    if force_strain is not None:
        accepted = f"above 0 and at most the strain between frames, {least:g}"
        require_number("force_strain", force_strain, lambda x: (x > 0) & (x <= least), accepted)
    with atomic_write(path) as temporary:
        for k, (state, step) in enumerate(zip(frames, steps.astype(int).tolist(), strict=True)):
            frame = snapshots_from(flow, numerics, state, force_strain or 0.0)
            _write(temporary, "r+" if k else "x", frame, step)


def _library() -> tuple[Any, Any]:
    """The file layer and the HOOMD schema of the GSD library, imported on first use."""
    return import_module("gsd.fl"), import_module("gsd.hoomd")


def _write(path: Path, mode: str, frame: Snapshot, step: int) -> None:
    fl, hoomd = _library()
    with fl.open(
        str(path), mode, application="jaxgran", schema="hoomd", schema_version=_SCHEMA_VERSION
    ) as file:  # closing it after every frame flushes it
        hoomd.HOOMDTrajectory(file).append(_gsd_frame(frame, step))


def _gsd_frame(seen: Snapshot, step: int):
    """A snapshot, or the first of a series with the mean forces of all, as a frame of the GSD
    library.
    """
    _, hoomd = _library()
    arrays = jax.tree.map(np.asarray, seen)
    steps = arrays if arrays.state.side.ndim else jax.tree.map(lambda x: x[None], arrays)
    first = steps[0]
    state, side, tilt = first.state, first.state.side.item(), first.state.tilt.item()
    timestep, shear_rate = first.timestep.item(), first.shear_rate.item()
    pairs, forces = _mean_forces(steps)
    frame = hoomd.Frame()
    frame.configuration.step = step
    frame.configuration.dimensions = 2
    frame.configuration.box = [side, side, 0, tilt, 0, 0]
    frame.particles.N = len(state.positions)
    frame.particles.position = _in_space(centred(state.positions, side, tilt))
    frame.particles.velocity = _in_space(state.velocities)
    frame.particles.diameter = 2 * state.grains.radii
    frame.particles.mass = state.grains.masses
    frame.bonds.N = len(pairs)
    frame.bonds.types = ["contact"]
    frame.bonds.typeid = np.zeros(len(pairs), np.uint32)
    frame.bonds.group = pairs
    constants = (
        {"exact_radius": state.grains.radii, "exact_mass": state.grains.masses} if step == 0 else {}
    )
    grain_log = {
        **_by_grain(pairs, forces, len(state.positions)),
        "exact_position": state.positions,
        "exact_velocity": state.velocities,
        **constants,
    }
    flow_log = {
        "side": state.side,
        "tilt": state.tilt,
        "strain": step * timestep * shear_rate,
        "timestep": timestep,
        "shear_rate": shear_rate,
        "force_strain": len(steps) * timestep * shear_rate,
        "restitution": np.asarray(first.restitution, np.float64),
        "format_version": FORMAT_VERSION,
    }
    frame.log = {
        "bonds/force": forces,
        **{f"particles/{name}": np.array(x) for name, x in grain_log.items()},  # writable copies
        **{f"jaxgran/{name}": np.array([x]) for name, x in flow_log.items()},
    }
    return frame


def _mean_forces(steps: Snapshot) -> tuple[Int[np.ndarray, "bonds 2"], Float[np.ndarray, " bonds"]]:
    """Pairs i < j in loaded contact at any of the time steps, and the means of their forces over
    all of them.
    """
    time, slot = np.nonzero(steps.impulses > 0)
    pairs = np.sort(
        np.stack([steps.contacts.i[time, slot], steps.contacts.j[time, slot]], axis=-1), axis=-1
    )
    bonds, bond = np.unique(pairs, axis=0, return_inverse=True)
    forces = np.asarray(steps.impulses[time, slot] / steps.timestep[time], np.float64)
    return bonds, np.bincount(bond.ravel(), forces, minlength=len(bonds)) / len(steps.timestep)


def _by_grain(
    pairs: Int[np.ndarray, "bonds 2"], forces: Float[np.ndarray, " bonds"], grains: int
) -> Chunks:
    """Contact force and cluster of each grain."""
    labels, sizes = cluster_labels(pairs[:, 0], pairs[:, 1], grains)
    return {
        "contact_force": np.bincount(pairs.ravel(), np.repeat(forces, 2), minlength=grains),
        "cluster": labels.astype(np.uint32),
        "cluster_size": sizes.astype(np.uint32),
    }


def _in_space(vectors: Float[np.ndarray, "grains 2"]) -> Float[np.ndarray, "grains 3"]:
    return np.pad(vectors, ((0, 0), (0, 1)))


def read_trajectory(path: str | os.PathLike) -> Trajectory:
    """Read a trajectory from a GSD file; one written by jaxgran is read back bit for bit.

    A file of another program must have a square two-dimensional cell, sheared or not, with
    positions and velocities, which are taken as peculiar. Missing diameters and masses are set to
    one.

    Args:
      path: GSD file.

    Returns:
      The states of all frames and the parameters of the flow.

    Raises:
      InputError: (a ValueError) the file does not exist, is not such a trajectory, or has another
        version of the format; the message says why.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"path must be a file name, not {short_repr(path)}.")
    name = short_repr(os.fspath(path))
    if not os.path.isfile(path):
        raise InputError(f"there is no file {name}.")
    try:
        frames = list(_frames(os.fspath(path)))
    except InputError as reason:
        if reason.field == "format_version":
            raise
        raise InputError(
            f"{name} is not a trajectory of discs in a sheared cell: {reason}."
        ) from None
    except Exception as error:  # a damaged file may raise any exception
        reason = short_repr(str(error)).strip("'\"").rstrip(".")
        raise InputError(f"{name} is not a readable GSD file: {reason}.") from None
    steps, numbers, states = zip(*frames, strict=True)
    state = jax.tree.map(lambda *x: np.stack(x), *states)
    areas = np.sum(np.pi * state.grains.radii[0] ** 2, dtype=np.float64)
    return Trajectory(
        state,
        np.array(steps),
        np.array([frame["strain"] for frame in numbers]),
        *(np.array(numbers[0][name]) for name in _NUMBERS[1:]),
        packing_fraction=areas / np.asarray(state.side[0], np.float64) ** 2,
    )


def _frames(path: str) -> Iterator[tuple[int, dict[str, float], State]]:
    """Step, parameters and state of every frame; an InputError with a reason if something is
    missing.
    """
    fl, _ = _library()
    with fl.open(path, "r") as file:
        if file.schema != "hoomd":
            raise InputError(f"its schema must be hoomd, not {short_repr(file.schema)}")
        if file.nframes == 0:
            raise InputError("it has no frames")
        first = _chunks(file, 0, {})
        if f"{_EXACT}velocity" in first:  # jaxgran wrote it
            found = first.get("log/jaxgran/format_version", [None])[0]
            if difference := other_version(short_repr(path), found, FORMAT_VERSION):
                raise InputError(difference, field="format_version")
        if "particles/position" in first and file.find_matching_chunk_names("particles/velocity"):
            at_rest = np.zeros_like(first["particles/position"])  # GSD does not store zeros
            first.setdefault("particles/velocity", at_rest)
        for k in range(file.nframes):
            frame = _chunks(file, k, first)
            if reason := _why_invalid(frame, first):
                raise InputError(f"in frame {k} {reason}")
            numbers = {
                name: float(frame.get(f"log/jaxgran/{name}", [np.nan])[0]) for name in _NUMBERS
            }
            yield int(frame.get("configuration/step", [0])[0]), numbers, _state(frame)


def _chunks(file: Any, frame: int, first: Chunks) -> Chunks:
    """The chunks of a frame; missing ones default to those of the first frame."""
    chunks = {
        name: file.read_chunk(frame=frame, name=name)
        for name in _READ
        if file.chunk_exists(frame, name)
    }
    return {**first, **chunks}


def _why_invalid(frame: Chunks, first: Chunks) -> str:
    """The reason why a frame cannot become a State; "" if it can."""
    grains, box = _grains(frame), frame.get("configuration/box", np.ones(6))
    arrays = {
        name: x
        for name, x in frame.items()
        if name.startswith("particles/") and name != "particles/N"
    }
    conditions = (
        (grains > 0, "there are no grains"),
        (grains == _grains(first), "the number of grains differs from that of the first frame"),
        (frame.get("configuration/dimensions", [3])[0] == 2, "the cell has three dimensions"),
        (box[0] == box[1] and box[0] > 0, "the cell is not a square"),
        *(
            (f"particles/{name}" in frame, f"there are no {meaning}")
            for name, meaning in _NEEDED.items()
        ),
        (
            all(len(x) == grains for x in arrays.values()),
            "some array does not have one entry for each grain",
        ),
        (all(np.isfinite(x).all() for x in (box, *arrays.values())), "some number is not finite"),
        *(
            (np.all(frame.get(f"particles/{x}", 1) > 0), f"some {x} is not positive")
            for x in ("diameter", "mass")
        ),
    )
    return next((reason for holds, reason in conditions if not holds), "")


def _grains(frame: Chunks) -> int:
    """Number of grains."""
    return int(frame.get("particles/N", [0])[0])


def _state(frame: Chunks) -> State:
    """The state of a frame, from the exact chunks if present, else from those of the GSD schema."""
    grains = _grains(frame)
    if f"{_EXACT}position" in frame:
        radii, masses, positions, velocities = (
            frame[f"{_EXACT}{name}"] for name in ("radius", "mass", "position", "velocity")
        )
        side, tilt = (frame[f"log/jaxgran/{name}"][0] for name in ("side", "tilt"))
        if not len(radii) == len(masses) == len(positions) == len(velocities) == grains:
            raise ValueError("its exact arrays do not have one entry for each grain")
    else:
        ones = np.ones(grains, np.float32)
        radii, masses = frame.get("particles/diameter", ones) / 2, frame.get("particles/mass", ones)
        side, tilt = (
            frame["configuration/box"][0],
            np.asarray(remap_tilt(jnp.asarray(frame["configuration/box"][3]))),
        )
        from_corner = jnp.asarray(frame["particles/position"][:, :2] + side / 2)
        positions = np.asarray(wrap(from_corner, jnp.asarray(side), jnp.asarray(tilt)))
        velocities = frame["particles/velocity"][:, :2]
    parts: dict[str, Any] = {
        "positions": positions,
        "velocities": velocities,
        "side": side,
        "tilt": tilt,
    }
    return State(Grains(radii, masses), **parts)
