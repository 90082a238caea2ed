"""Compiled programs are kept in the user's folder, in a temporary one, or nowhere."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxgran.cache import folder as cache

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders have no owner")


@pytest.fixture
def nothing_for_the_user(tmp_path: Path, monkeypatch) -> Path:
    """The user's cache folder cannot be made; the folder of temporary files is the result."""
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path / "temporary"


def test_a_temporary_folder_that_nobody_else_can_write_takes_the_place_of_the_users(
    nothing_for_the_user: Path,
) -> None:
    folder = cache.cache_folder()
    assert folder is not None and folder.parent == nothing_for_the_user
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)  # others can put programs there
    assert cache.cache_folder() is None
    folder.rmdir()
    (nothing_for_the_user / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to("elsewhere")
    assert cache.cache_folder() is None


FIRST_CALL = """
import jax
import jaxgran as jg

before = jax.config.values | {}
pair = jg.DelassusProblem([[1.0]], [-1.0])
assert float(jg.solve_contacts(pair).impulses[0]) == 1
assert jax.config.values == before, "a function of the package changes flags"
jg.use_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # on any machine
assert float(jax.jit(lambda x: 2 * x + 1)(1.0)) == 3
print(jax.config.jax_compilation_cache_dir)
"""


def folder_of_first_call(**variables: str) -> str:
    """Where a script that asks for it keeps its programs, with these environment variables."""
    set_here = ("TF_CPP_MIN_LOG_LEVEL", "XLA_FLAGS")
    environment = {x: y for x, y in os.environ.items() if x not in set_here} | variables
    command = [sys.executable, "-W", "error", "-c", FIRST_CALL]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr) == (0, "")  # XLA's log is silent, too
    return done.stdout.strip()


def test_a_script_keeps_programs_in_the_users_folder_once_it_asks_for_it(tmp_path: Path) -> None:
    first, second = (folder_of_first_call(XDG_CACHE_HOME=str(tmp_path)) for _ in range(2))
    assert first == second and Path(first).parent == tmp_path / "jaxgran"
    assert any(path.name.startswith("jit__lambda") for path in Path(first).iterdir())


def test_what_the_user_sets_in_jax_stays(tmp_path: Path) -> None:
    assert folder_of_first_call(JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == str(tmp_path)
    assert folder_of_first_call(JAX_ENABLE_COMPILATION_CACHE="false") == "None"
