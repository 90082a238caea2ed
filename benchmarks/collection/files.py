"""The file of the collection: its layout, and how it is written and read.

The file is HDF5. Each problem is a group of the root, by its name; the order is that of the names.

====================  =============  ===========  ==================================================
dataset               type           shape        meaning
====================  =============  ===========  ==================================================
NAME/ends             int32          contacts, 2  numbers i and j of the two grains
NAME/normals          float64        contacts, 2  unit vectors n from grain j to grain i
NAME/masses           float64        grains       masses of the grains
NAME/approach         float64        contacts     u⁻ = n·(v_i − v_j) before, negative if approaching
NAME/impulses         float64        contacts     solution J at restitution zero; if feasible
NAME/impulses_low     float64        contacts     what to add to it in extended precision; if
                                                  feasible
NAME/velocities       float64        contacts     w = u⁻ + W J after, at restitution zero; if
                                                  feasible
NAME/weights          float64        contacts     weights q that prove that there is none; if
                                                  infeasible
NAME/weights_low      float64        contacts     what to add to them in extended precision; if
                                                  infeasible
====================  =============  ===========  ==================================================

Attributes of a group are ``family``, ``origin`` (how it was made, in words), ``feasible`` (1 or 0),
and the numbers of
its certificate: ``natural_map``, ``complementarity``, ``energy``, ``approach`` and ``tension``, or
  ``obstacle``. Attributes of the file are ``format``, ``version``, ``law`` and ``units``.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import netCDF4  # noqa: F401 must precede h5py: if both bundle one HDF5, the second fails

# isort: split
import h5py
import numpy as np

from benchmarks.collection.certificates import Problem, Solved, delassus
from benchmarks.process import ROOT
from jaxgran.files import other_version

PATH = ROOT / "benchmarks" / "results" / "collection.h5"
_HEAD = {
    "format": "jaxgran contact problems",
    "version": 1,
    "law": "0 <= p, w >= 0, p.w = 0 with w = u + W p and W = H M^-1 H^T; with restitution a, "
    "impulses are (1 + a) p",
    "units": "masses in that of a mean grain, velocities in mean diameters times the shear rate",
}


class Entry(NamedTuple):
    """A problem of the collection with its solution and what is known of it.

    ==========  =======  ===========================================================================
    field       type     meaning
    ==========  =======  ===========================================================================
    name        string   the name of its group
    family      string   what kind of network it is
    origin      string   how it was made
    problem     Problem  ends, normals, masses and approach; see ``certificates``
    solution    Solved   impulses and velocities at restitution zero, or weights that prove that
                         there are none
    ==========  =======  ===========================================================================
    """

    name: str
    family: str
    origin: str
    problem: Problem
    solution: Solved

    @property
    def matrix(self):
        """W as a sparse matrix of SciPy, in double precision."""
        return delassus(self.problem)


def write(path: Path, entries: Iterable[Entry]) -> None:
    """Write the file; the same entries give the same bytes."""
    with h5py.File(path, "w", libver=("v108", "v108")) as file:
        for key, value in _HEAD.items():
            file.attrs[key] = _plain(value)
        for entry in entries:
            group, solution = file.create_group(entry.name), entry.solution
            group.attrs["family"], group.attrs["origin"] = (
                _plain(entry.family),
                _plain(entry.origin),
            )
            group.attrs["feasible"] = np.int32(solution.feasible)
            for key, value in solution.certificate.items():
                group.attrs[key] = value
            for key, values in {**entry.problem._asdict(), **_unknowns(solution)}.items():
                group.create_dataset(key, data=values, track_times=False)


def load(path: Path = PATH, most_contacts: int | None = None) -> list[Entry]:
    """The problems of a file in their order, or those of at most so many contacts."""
    with h5py.File(path, "r") as file:
        if _text(file.attrs.get("format", b"")) != _HEAD["format"]:
            raise ValueError(
                f"{path} is not a collection of contact problems: make one by python -m benchmarks "
                "collection."
            )
        if difference := other_version(str(path), file.attrs.get("version"), _HEAD["version"]):
            raise ValueError(difference)
        return [
            _entry(name, group)
            for name, group in file.items()
            if most_contacts is None or len(group["approach"]) <= most_contacts
        ]


def _entry(name: str, group: h5py.Group) -> Entry:
    problem = Problem(*(group[key][()] for key in Problem._fields))
    feasible, told = bool(group.attrs["feasible"]), {"family", "origin", "feasible"}
    key = "impulses" if feasible else "weights"
    solution = Solved(
        feasible,
        group[key][()],
        group[f"{key}_low"][()],
        group["velocities"][()] if feasible else np.zeros(0),
        {key: float(value) for key, value in group.attrs.items() if key not in told},
    )
    return Entry(
        name, _text(group.attrs["family"]), _text(group.attrs["origin"]), problem, solution
    )


def _unknowns(solution: Solved) -> dict[str, np.ndarray]:
    if not solution.feasible:
        return {"weights": solution.impulses, "weights_low": solution.impulses_low}
    return {
        "impulses": solution.impulses,
        "impulses_low": solution.impulses_low,
        "velocities": solution.velocities,
    }


def _plain(value: str | int) -> np.bytes_ | np.int32:
    """A string of fixed length, which any reader of HDF5 knows and which lies in the header of its
    group.
    """
    return np.bytes_(value.encode()) if isinstance(value, str) else np.int32(value)


def _text(value: bytes | str) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
