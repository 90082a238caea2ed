"""The problems in the layout of FCLIB, a file each, so that solvers that read FCLIB can be run on them.

The layout is that of ``fclib_write_local`` and ``fclib_write_solution`` in ``src/fclib.h`` of the Frictional Contact
Library (github.com/FrictionalContactLibrary/fclib, Acary et al., 2014): the local problem û = W r + q with a cone of
friction at each contact.

===================================  =======  ===========  ======================================================
dataset                              type     shape        here
===================================  =======  ===========  ======================================================
fclib_local/spacedim                 int32    1            3, as FCLIB's own merit function knows no other
fclib_local/W/m, n, nzmax, nz        int32    1            rows, columns, entries; nz = -1: compressed columns
fclib_local/W/p, i, x                int32 …  m + 1; nzmax W with three rows a contact: normal, tangent, out of plane
fclib_local/vectors/q                float64  m            u⁻ of the normal, 0 of the others
fclib_local/vectors/mu               float64  contacts     0: no friction
fclib_local/info/title, description  string   –            name of the problem, how it was made
solution/u, r                        float64  m            velocities and impulses at restitution zero, if feasible
===================================  =======  ===========  ======================================================

Grains do not rotate, and without friction no tangential impulse acts; so tangential rows change no solution. The
tangential velocity before is not in the collection, so u there is its change.
"""

from pathlib import Path

import h5py
import numpy as np
from scipy.sparse import block_array, csc_array, diags_array

from benchmarks.collection.certificates import Problem, incidence
from benchmarks.collection.files import Entry

_COMPRESSED_COLUMNS = -1


def write_all(folder: Path, entries: list[Entry]) -> None:
    """Write every problem as FOLDER/NAME.hdf5."""
    folder.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        write(folder / f"{entry.name}.hdf5", entry)


def write(path: Path, entry: Entry) -> None:
    """Write one problem, with its solution if it has one."""
    matrix, size = _matrix(entry.problem), 3 * len(entry.problem.approach)
    with h5py.File(path, "w") as file:
        local = file.create_group("fclib_local")
        local["spacedim"] = np.array([3], np.int32)
        parts = {"m": size, "n": size, "nzmax": matrix.nnz, "nz": _COMPRESSED_COLUMNS}
        for name, value in parts.items():
            local[f"W/{name}"] = np.array([value], np.int32)
        local["W/p"], local["W/i"] = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
        local["W/x"] = matrix.data
        local["vectors/q"] = _with_tangents(entry.problem.approach)
        local["vectors/mu"] = np.zeros(len(entry.problem.approach))
        for name, words in {"title": entry.name, "description": entry.origin}.items():
            local[f"info/{name}"] = _terminated(words)
        if entry.solution.feasible:
            impulses = _with_tangents(entry.solution.impulses)
            file["solution/r"], file["solution/u"] = (
                impulses,
                matrix @ impulses + _with_tangents(entry.problem.approach),
            )


def _matrix(problem: Problem) -> csc_array:
    """W of the normal, the tangent in the plane and the one out of it, contact by contact."""
    count, (nx, ny) = len(problem.approach), problem.normals.T
    along, across = incidence(problem), incidence(problem._replace(normals=np.stack([-ny, nx], axis=1)))
    out = incidence(problem._replace(normals=np.stack([np.ones(count), np.zeros(count)], axis=1)))  # x stands for z
    still = csc_array(along.shape)
    h = block_array([[along, still], [across, still], [still, out]]).tocsr()
    h = h[np.arange(3 * count).reshape(3, count).T.ravel()]
    matrix = (h @ diags_array(np.tile(np.repeat(1 / problem.masses, 2), 2)) @ h.T).tocsc()
    matrix.sort_indices()
    return matrix


def _with_tangents(values: np.ndarray) -> np.ndarray:
    return np.stack([values, np.zeros_like(values), np.zeros_like(values)], axis=1).ravel()


def _terminated(words: str) -> np.ndarray:
    """A string that ends in a zero, as C reads it."""
    return np.array(words.encode(), f"S{len(words.encode()) + 1}")
