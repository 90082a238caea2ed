"""The numba engine: a file for each version of its sources, and blocks of steps that are those of
one call each.
"""

import os
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest
from flows import GRAINS

import jaxgran
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.engine import Numba
from jaxgran.dynamics.numba_engine import ffi, handler
from jaxgran.dynamics.tally import TABLE
from jaxgran.files import read_cached, write_cached
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow

PACKAGE = Path(jaxgran.__file__).parent


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with a copy of the package."""
    shutil.copytree(
        PACKAGE, tmp_path / "copy" / "jaxgran", ignore=shutil.ignore_patterns("__pycache__")
    )
    return tmp_path / "copy"


@pytest.fixture
def of_copy(copy: Path, monkeypatch) -> Path:
    """The same folder, where the numba engine now finds its sources."""
    monkeypatch.setattr(ffi, "__file__", str(copy / Path(ffi.__file__).relative_to(PACKAGE.parent)))
    return copy


def test_any_change_of_any_source_gives_the_machine_code_another_file(of_copy: Path) -> None:
    kept, sources = ffi.object_file(), ffi.sources()
    for path in sources:
        content = path.read_bytes()
        path.write_bytes(content + b"\n")
        assert ffi.object_file() != kept
        path.write_bytes(content)
    assert ffi.object_file() == kept
    compiled_here = {*(of_copy / "jaxgran" / "dynamics" / "numba_engine").glob("*.py")}
    imported = {
        of_copy / "jaxgran" / name
        for name in ("contact/law.py", "model/cell.py", "model/status.py", "dynamics/tally.py")
    }
    assert compiled_here and compiled_here | imported <= set(sources)


def test_another_compiler_or_processor_has_another_file(monkeypatch) -> None:
    kept = {ffi.object_file()}
    for module, name, value in (
        (ffi, "version", lambda _: "0.0.1"),
        (ffi.llvm, "get_host_cpu_name", lambda: "another"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            kept.add(ffi.object_file())
    monkeypatch.setenv("NUMBA_OPT", "2")
    kept.add(ffi.object_file())
    assert len(kept) == 4


def test_a_kept_file_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    path, content = tmp_path / "cache" / "code.o", b"numba engine" * 100
    assert read_cached(path) is None
    write_cached(path, content, 1)
    assert read_cached(path) == content
    assert [file.name for file in path.parent.iterdir()] == ["code.o"]
    whole = path.read_bytes()
    for torn in (b"", whole[:20], whole[:-1], whole[:500] + b"!" + whole[501:]):
        path.write_bytes(torn)
        assert read_cached(path) is None


def test_only_some_files_are_kept_and_the_oldest_go(tmp_path: Path) -> None:
    for k in range(5):
        write_cached(tmp_path / f"{k}.o", b"code", 3)
        os.utime(tmp_path / f"{k}.o", (k, k))
    write_cached(tmp_path / "last.o", b"code", 3)
    assert {path.name for path in tmp_path.iterdir()} == {"last.o", "3.o", "4.o"}


def words(structure: str) -> dict[str, int]:
    """Offset of each field of a structure of XLA's C interface in words, as the header of this
    jaxlib has it.
    """
    header = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text(
        encoding="utf-8"
    )
    header = re.sub(r"//.*", "", header)
    body = re.search(rf"struct {structure} {{(.*?)}}", header, re.DOTALL)
    offset, found = 0, {}
    for kind, name in re.findall(r"(\w+ ?\**) ?(\w+);", body[1]):
        found[name] = offset
        nested = f"struct {kind.strip()} {{" in header  # not a pointer
        offset += len(words(kind.strip())) if nested else 1
    return found


def test_the_handler_reads_the_call_frame_where_this_jaxlib_has_it() -> None:
    frame, buffer = words("XLA_FFI_CallFrame"), words("XLA_FFI_Buffer")
    assert frame["extension_start"] == handler.EXTENSION_START
    assert frame["args"] + words("XLA_FFI_Args")["args"] == handler.ARGS
    assert frame["rets"] + words("XLA_FFI_Rets")["rets"] == handler.RETS
    assert (buffer["data"], buffer["rank"], buffer["dims"]) == (
        handler.DATA,
        handler.RANK,
        handler.DIMS,
    )
    assert words("XLA_FFI_Metadata_Extension")["metadata"] == handler.METADATA
    assert words("XLA_FFI_Metadata")["api_version"] + words("XLA_FFI_Api_Version")[
        "major_version"
    ] == (handler.API_VERSION)


def test_a_jaxlib_that_refuses_the_version_of_the_handler_is_an_input_error(monkeypatch) -> None:
    def refuse(name: str, *_: object, **__: object) -> None:
        raise jax.errors.JaxRuntimeError(f"handler registration for {name} failed")

    monkeypatch.setattr(jax.ffi, "register_ffi_target", refuse)
    with pytest.raises(
        InputError, match=f"engine must be jax with jaxlib {jaxlib.__version__}, not numba: handler"
    ):
        ffi._register.__wrapped__()


@pytest.mark.parametrize("packing_fraction", [0.6, 0.8])
def test_blocks_of_one_call_are_those_of_one_call_each(flowing, packing_fraction: float) -> None:
    """Up to rounding, as the list of near pairs lasts longer than a block; one block has no
    step.
    """
    flow, state = ShearFlow(GRAINS, 0.6, packing_fraction, 1e-3), flowing(packing_fraction)
    steps = jnp.asarray([20, 0, 1, 7, 30, 12])
    end, tallies = advance(flow, state, steps, engine=Numba())
    for k, count in enumerate(steps):
        state, tally = advance(flow, state, count, engine=Numba())
        for name in TABLE:
            values = getattr(tallies, name)[k], getattr(tally, name)
            np.testing.assert_allclose(
                *values, rtol=1e-8, atol=1e-9, err_msg=f"{name} of block {k}"
            )
    np.testing.assert_allclose(end.velocities, state.velocities, rtol=1e-8, atol=1e-9)
    assert float(tallies.collisions.sum()) > 10 and np.all(tallies.wave_kinetic[steps > 0] > 0)
