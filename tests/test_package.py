"""Importing is light, and public names resolve."""

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import jaxgran


def run_python(code: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout


def test_help_names_every_public_name_by_theme_on_one_screen() -> None:
    text = jaxgran.__doc__ or ""
    assert set(jaxgran.__all__) <= {*re.findall(r"\w+", text)}
    assert len(text.splitlines()) <= 50 and max(map(len, text.splitlines())) <= 100


def test_import_is_light() -> None:
    heavy = ("jax", "jax_md", "xarray", "matplotlib", "typer", "numpy")
    code = f"import sys, jaxgran; print([name for name in {heavy} if name in sys.modules])"
    assert run_python(code) == "[]\n"


def test_import_starts_no_backend_and_changes_no_flag_of_jax() -> None:
    code = """
import jax
from jax._src import xla_bridge
before = dict(jax.config.values)
import jaxgran
for name in jaxgran.__all__:
    getattr(jaxgran, name)
import jaxgran.cli.app
changed = {name for name in before if before[name] != jax.config.values[name]}
print(xla_bridge.backends_are_initialized(), jax.config.jax_enable_x64, changed)
"""
    assert run_python(code) == "False False set()\n"


def test_public_names_resolve_and_are_documented() -> None:
    assert {*jaxgran.__all__} <= {*dir(jaxgran)}
    for name in jaxgran.__all__:
        value = getattr(jaxgran, name)
        assert value.__doc__ and value.__module__.startswith("jaxgran."), name


def test_editors_know_the_names_without_running_them(tmp_path: Path) -> None:
    """Types of public names, of averages and of a snapshot in a series, by the stub alone."""
    code = """
import jaxgran as jg
def typed(flow: jg.ShearFlow, sample: jg.Sample, series: jg.Snapshot) -> None:
    reveal_type(jg.prepare)
    reveal_type(flow[0])
    reveal_type(sample.macroscopic_friction)
    reveal_type(series[3])
    sample.presure
    jg.smaple
"""
    (tmp_path / "typed.py").write_text(code)
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable, "typed.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    prepare, flow, average, snapshot = re.findall(r'Type of ".*" is "(.*)"', done.stdout)
    assert prepare.startswith("(flow: ShearFlow, key: ") and average.startswith("Array | ndarray")
    assert (flow, snapshot) == ("ShearFlow", "Snapshot")
    assert all(f'"{name}" is' in done.stdout for name in ("presure", "smaple"))


def test_version_is_that_of_the_installed_package() -> None:
    assert jaxgran.__version__ == version("jaxgran")
