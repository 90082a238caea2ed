"""Programs on disk: found without tracing, compiled again if what they depend on changes."""

from pathlib import Path
from threading import Thread

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.cache import persistent_jit


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setattr(persistent_jit, "programs_folder", lambda: tmp_path)
    return tmp_path / "programs"


def counted(traces: list):
    """A program of its own for each process: a new ``persistent_jit`` has nothing in memory."""

    def slope(pair, factor):
        traces.append(None)
        return {"sum": pair[0] + pair[1], "product": factor * pair[0]}

    return persistent_jit.persistent_jit(slope)


ARGUMENTS = (np.arange(3.0), np.ones(3)), np.float64(2.0)


def test_second_process_neither_traces_nor_compiles(folder: Path) -> None:
    traces: list = []
    first, second = (counted(traces)(*ARGUMENTS) for _ in range(2))
    assert len(traces) == 1 and len(list(folder.iterdir())) == 1
    assert first.keys() == {"sum", "product"}
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    np.testing.assert_array_equal(second["product"], [0.0, 2.0, 4.0])


PAIR, FACTOR = ARGUMENTS
CHANGED = {
    "shape": (tuple(np.append(x, 1.0) for x in PAIR), FACTOR),
    "precision": (tuple(x.astype(np.float32) for x in PAIR), np.float32(2.0)),
    "structure": (list(PAIR), FACTOR),
    "flag of JAX": ARGUMENTS,
    "source, version or processor": ARGUMENTS,
}


@pytest.mark.parametrize("change", CHANGED)
def test_whatever_a_program_depends_on_compiles_it_again(
    folder: Path, change: str, monkeypatch
) -> None:
    traces: list = []
    counted(traces)(*ARGUMENTS)
    if change.startswith("source"):
        monkeypatch.setattr(persistent_jit, "_origin", lambda: "another")
    with jax.numpy_dtype_promotion("standard" if change == "flag of JAX" else "strict"):
        counted(traces)(*CHANGED[change])
    assert len(traces) == 2


def test_damaged_program_is_compiled_again(folder: Path) -> None:
    traces: list = []
    expected = counted(traces)(*ARGUMENTS)
    (path,) = folder.iterdir()
    text = path.read_bytes()
    for damaged in (text[:100], text[:-1] + bytes([text[-1] ^ 1]), b""):
        path.write_bytes(damaged)
        found = counted(traces)(*ARGUMENTS)
        np.testing.assert_array_equal(found["sum"], expected["sum"])
    assert len(traces) == 4


def test_transformations_take_the_function_and_keep_nothing(folder: Path) -> None:
    function = counted([])
    slope = jax.grad(lambda factor: jnp.sum(function(ARGUMENTS[0], factor)["product"]))(2.0)
    assert slope == 3.0
    assert not folder.exists()


def test_program_that_calls_a_library_of_scipy_is_not_kept(folder: Path) -> None:
    """Loaded without being lowered, it would call a function that is not there."""
    solved = persistent_jit.persistent_jit(jnp.linalg.solve)(np.eye(2), np.array([[1.0], [2.0]]))
    np.testing.assert_allclose(solved, [[1.0], [2.0]])
    assert list(folder.iterdir()) == []


def test_threads_compile_a_program_once(folder: Path) -> None:
    traces: list = []
    program = counted(traces)
    threads = [Thread(target=program, args=ARGUMENTS) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(traces) == 1


def test_folder_that_cannot_be_written_keeps_nothing(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(persistent_jit, "programs_folder", lambda: tmp_path / "file")
    np.testing.assert_array_equal(counted([])(*ARGUMENTS)["sum"], [1.0, 2.0, 3.0])
