"""The wheel is installed elsewhere, and runs for a user who may write results and nothing else.

If the tests run as root, the user is nobody. Otherwise it is the user of the tests, whose home is a
file.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxgran.cli.output import in_brackets
from jaxgran.maps.results import open_map
from jaxgran.model.choices import HALF_INTERVAL

pytestmark = [
    pytest.mark.environment,
    pytest.mark.skipif(os.name != "posix", reason="users are those of POSIX"),
    pytest.mark.skipif(
        not (find_spec("hatchling") and find_spec("pip")),
        reason="hatchling or pip is not installed",
    ),
]
ROOT = Path(__file__).parents[1]
PACKAGES = Path(np.__file__).parents[1]
SMALL_MAP = (
    "map --grains 64 --strain 2 --restitution 0.5,0.9 --packing-fraction 0.7 --seeds 1 --workers 1"
)


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that all can read, with the wheel in ``site``, which nobody can write."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-compile"]
    install += ["--target", str(folder / "site"), str(wheel)]
    subprocess.run(install, cwd=folder, check=True, capture_output=True)
    folders = [folder / "site", *(x for x in (folder / "site").rglob("*") if x.is_dir())]
    for one in folders:
        one.chmod(0o555)
    yield folder
    for one in folders:
        one.chmod(0o755)
    shutil.rmtree(folder)


@pytest.fixture
def anyone(place: Path) -> tuple[str, dict[str, Any], int]:
    """Interpreter, arguments of a process, user: nobody, if an interpreter lets root be so."""
    if os.getuid() == 0:
        import pwd

        nobody = pwd.getpwnam("nobody")
        user = {"user": nobody.pw_uid, "group": nobody.pw_gid, "extra_groups": []}
        name = f"python{sys.version_info.major}.{sys.version_info.minor}"
        for python in (sys.executable, shutil.which(name, path="/usr/local/bin:/usr/bin")):
            command, variables = [python or "none", "-c", "import numpy"], environment(place)
            try:
                subprocess.run(command, check=True, cwd=place, env=variables, **user)
                return command[0], user, nobody.pw_uid
            except (OSError, subprocess.CalledProcessError):
                continue  # it is in a folder of root
    return sys.executable, {}, os.getuid()


def environment(place: Path) -> dict[str, str]:
    """A terminal of 80 columns that knows ASCII alone; neither a home nor a cache."""
    return {
        "COLUMNS": "80",
        "HOME": str(place / "site" / "jaxgran" / "__init__.py"),
        "LC_ALL": "C",
        "PATH": os.defpath,
        "PYTHONCOERCECLOCALE": "0",
        "PYTHONIOENCODING": "ascii",
        "PYTHONPATH": f"{place / 'site'}{os.pathsep}{PACKAGES}",
        "PYTHONUTF8": "0",
    }


def test_a_user_without_rights_home_and_cache_gets_a_table_of_a_small_map(
    place: Path, anyone
) -> None:
    python, user, number = anyone
    folder = Path(tempfile.mkdtemp(dir=place))
    folder.chmod(0o777)
    shared = folder / f"jaxgran-{number}"  # programs that anyone could have put there are not run
    shared.mkdir()
    shared.chmod(0o777)
    variables = environment(place) | {"TMPDIR": str(folder), "XLA_FLAGS": os.environ["XLA_FLAGS"]}
    command = [python, "-m", "jaxgran", *SMALL_MAP.split()]
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, **user)
    out, err = done.stdout.decode("ascii"), done.stderr.decode("ascii")
    assert done.returncode == 0 and "Traceback" not in err, err
    assert err.count("the cache folder") == err.count("so every run compiles anew") == 1
    assert max(map(len, out.splitlines())) <= 80
    data = open_map(folder / "jaxgran_map.nc")
    halves = HALF_INTERVAL * data.force_ratio_stderr
    for numbers in zip(data.force_ratio.values.flat, halves.values.flat, strict=True):
        assert in_brackets(*numbers) in out
    assert (folder / "jaxgran_map_curves.png").exists() and not list(shared.iterdir())
    assert (folder / "jaxgran_map.nc").stat().st_uid == number
