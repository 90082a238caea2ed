"""The machine code is compiled anew when any of its sources changes, and runs without a place to keep it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import jaxgran
from jaxgran.dynamics.machine_code import compiled as machine_code

PACKAGE = Path(jaxgran.__file__).parent
PROGRAM = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import jaxgran as jg
flow = jg.ShearFlow(grains=16, restitution=0.5, packing_fraction=0.3, timestep=1e-3)
grains = jg.Grains(jnp.full(16, 0.5), jnp.ones(16))
places = jnp.stack(jnp.meshgrid(jnp.arange(4.0), jnp.arange(4.0)), axis=-1).reshape(-1, 2) * 1.7
places = places.at[1, 0].add(-0.75)  # overlaps its neighbour by 0.05
state = jg.State(grains, places, jnp.zeros((16, 2)).at[1, 0].set(-1.0), jnp.asarray(6.8), jnp.asarray(0.0))
_, tally = jg.advance(flow, state, jnp.int32(1))
print(jg.Status(int(tally.status)).name, float(tally.overlap))
"""


def outcome(package: Path, cache: Path) -> tuple[str, str]:
    """Status and overlap of one step with a copy of the package, and what it says on standard error."""
    environment = os.environ | {"PYTHONPATH": str(package), "XDG_CACHE_HOME": str(cache), "NUMBA_OPT": "0"}
    environment.pop("NUMBA_CACHE_DIR", None)
    ran = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, cwd=package)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout, ran.stderr


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A folder with a copy of the package."""
    shutil.copytree(PACKAGE, tmp_path / "copy" / "jaxgran", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "copy"


def changed(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    times = path.stat()
    path.write_text(text.replace(old, new), encoding="utf-8")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))  # the time stamp says nothing


def test_any_change_of_any_source_gives_the_machine_code_another_folder(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = machine_code.cache_folder()
    monkeypatch.setattr(machine_code, "__file__", str(copy / Path(machine_code.__file__).relative_to(PACKAGE.parent)))
    assert machine_code.cache_folder() == here  # the place of the package says nothing
    sources = machine_code.sources()
    for path in sources:
        content = path.read_bytes()
        path.write_bytes(content + b"\n")
        assert machine_code.cache_folder() != here
        path.write_bytes(content)
    assert machine_code.cache_folder() == here
    compiled_here = {*(copy / "jaxgran" / "dynamics" / "machine_code").glob("*.py")}
    imported = {copy / "jaxgran" / name for name in ("contact/law.py", "model/status.py", "dynamics/tally.py")}
    assert compiled_here | imported <= set(sources)


def test_a_changed_constant_and_a_changed_function_of_another_file_have_another_folder(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine_code, "__file__", str(copy / Path(machine_code.__file__).relative_to(PACKAGE.parent)))
    folders = {machine_code.cache_folder()}
    changed(copy / "jaxgran" / "model" / "status.py", "DEEP_OVERLAP = 1e-2", "DEEP_OVERLAP = 1e3")
    folders.add(machine_code.cache_folder())
    changed(copy / "jaxgran" / "contact" / "law.py", "        overlap,\n", "        2 * overlap,\n")
    folders.add(machine_code.cache_folder())
    assert len(folders) == 3


def test_a_cache_that_cannot_be_written_costs_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.warns(UserWarning, match=r"compiled anew in every process.*cannot be written.*XDG_CACHE_HOME"):
        usable = machine_code._usable(tmp_path / "file" / "machine_code")
    assert not usable
    monkeypatch.setattr(machine_code, "CACHED", usable)
    monkeypatch.setattr(machine_code, "CACHE", tmp_path / "file" / "machine_code")
    half = machine_code.cached(numba.njit)(lambda x: x / 2)
    assert half(3.0) == 1.5


@pytest.mark.slow
def test_a_changed_constant_and_a_changed_function_take_effect(copy: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    before, _ = outcome(copy, cache)
    assert before.startswith("deep_overlap ")
    changed(copy / "jaxgran" / "model" / "status.py", "DEEP_OVERLAP = 1e-2", "DEEP_OVERLAP = 1e3")
    after, _ = outcome(copy, cache)
    assert after == before.replace("deep_overlap", "ok")
    changed(copy / "jaxgran" / "contact" / "law.py", "        overlap,\n", "        2 * overlap,\n")
    status, overlap = outcome(copy, cache)[0].split()
    assert status == "ok" and float(overlap) == 2 * float(before.split()[1])


@pytest.mark.slow
def test_a_process_without_a_cache_compiles_for_itself(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    found, told = outcome(PACKAGE.parent, tmp_path / "file")
    assert found.startswith("deep_overlap ")
    assert "the machine code is compiled anew in every process" in told and "cannot be written" in told
