"""The numba engine: a cache for each version of its sources, and blocks as one call each."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numba
import numpy as np
import pytest
from flows import GRAINS

import jaxgran
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.engine import Numba
from jaxgran.dynamics.numba_engine import ffi, handler
from jaxgran.dynamics.tally import TABLE
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status

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


def test_any_change_of_any_source_gives_the_machine_code_another_folder(of_copy: Path) -> None:
    kept, sources = ffi.engine_folder(), ffi.sources()
    for path in sources:
        content = path.read_bytes()
        path.write_bytes(content + b"\n")
        assert ffi.engine_folder() != kept
        path.write_bytes(content)
    assert ffi.engine_folder() == kept
    compiled_here = {*(of_copy / "jaxgran" / "dynamics" / "numba_engine").glob("*.py")}
    imported = {
        of_copy / "jaxgran" / name
        for name in ("contact/law.py", "model/cell.py", "model/status.py", "dynamics/tally.py")
    }
    assert compiled_here and compiled_here | imported <= set(sources)


class Compiled:
    """A handler that was compiled, and not loaded."""

    cache_hits = 0


def test_only_some_versions_are_kept_and_the_oldest_go(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(numba, "cfunc", lambda *_, **__: lambda _: Compiled)
    for k in range(ffi.MOST_KEPT + 2):
        (tmp_path / f"jaxgran-{k:016}").mkdir()
        os.utime(tmp_path / f"jaxgran-{k:016}", (k, k))
    (tmp_path / "of-another-program").mkdir()
    before = numba.config.CACHE_DIR
    assert ffi.compiled_handler(tmp_path / "jaxgran-0000000000000009") is Compiled
    assert before == numba.config.CACHE_DIR
    kept = {path.name for path in tmp_path.iterdir()} - {"of-another-program"}
    assert kept == {f"jaxgran-{k + 2:016}" for k in range(ffi.MOST_KEPT)}
    assert (tmp_path / "of-another-program").exists()


def test_a_folder_that_cannot_be_written_compiles_without_a_cache(
    tmp_path: Path, monkeypatch
) -> None:
    given = []
    monkeypatch.setattr(
        numba, "cfunc", lambda *_, cache, **__: lambda _: given.append(cache) or Compiled
    )
    (tmp_path / "file").touch()
    with pytest.warns(UserWarning, match="compiled anew in every process"):
        ffi.compiled_handler(tmp_path / "file" / "jaxgran-0")
    assert given == [False]


FIRST_STEPS = """
import hashlib
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jaxgran as jg
from jaxgran.dynamics import interruption

flow = jg.ShearFlow(16, 0.5, 0.6, 1e-3)
blocks = jax.tree.leaves(jg.sample(flow, jg.heated(flow, jax.random.key(0)), 0.4)[1].tally)
with interruption.engines_stopped():
    stopped = jg.advance(flow, jg.heated(flow, jax.random.key(0)), jnp.int32(100))[1]
print(int(stopped.status), hashlib.sha256(b"".join(x.tobytes() for x in blocks)).hexdigest())
"""


@pytest.mark.environment
def test_processes_that_compile_and_one_that_loads_have_the_same_bits(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    def start() -> subprocess.Popen:
        command = [sys.executable, "-c", FIRST_STEPS]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    at_once = [start(), start()]
    printed = [process.communicate()[0] for process in at_once]
    printed.append(start().communicate()[0])
    assert len(set(printed)) == 1 and printed[0].startswith(f"{Status.failed:d} ")
    assert len(list(tmp_path.rglob("*.nbc"))) == 1


def words(structure: str) -> dict[str, int]:
    """Offsets in words of the fields of a structure of XLA's C interface, by its header."""
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
    """Up to rounding, as a list of near pairs outlasts a block; one block has no step."""
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
