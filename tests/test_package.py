"""Importing is light, and public names resolve."""

import subprocess
import sys
from importlib.metadata import version

import pytest

import jaxgran


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_import_is_light() -> None:
    heavy = ("jax", "jax_md", "xarray", "matplotlib", "typer", "numpy")
    assert run_python(f"import sys, jaxgran; print([name for name in {heavy} if name in sys.modules])") == "[]\n"


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


@pytest.mark.parametrize("name", jaxgran.__all__)
def test_public_names_resolve_and_are_documented(name: str) -> None:
    assert name in dir(jaxgran)
    assert getattr(jaxgran, name).__doc__
    assert getattr(jaxgran, name).__module__.startswith("jaxgran.")


def test_version_is_that_of_the_installed_package() -> None:
    assert jaxgran.__version__ == version("jaxgran")
