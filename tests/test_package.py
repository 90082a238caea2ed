"""Importing is light, public names resolve, and the modules stand in layers."""

import ast
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import jaxgran

SOURCES = sorted(path for path in Path(jaxgran.__file__).parent.glob("*.py") if path.stem != "__init__")

# A module imports only modules before it.
LAYERS = """
    replica status display flow maps grains cell neighbours pairs contacts delassus methods solver tally observer
    dynamics event_loop block block_solver thread_block native snapshots free_cooling coarse_graining fields sensitivity
    calibrate packing observables statistics series force_chains structure measure kinetic_theory kinetics batch
    protocol accuracy settings store recorder trajectory dataset journal checkpoint pool cluster sweep rheology closure
    closure_fit stress_inversion cross_validation drawing contours theory_figures rheology_figures figures flow_figures
    movie progress terminal cli_options cli_measure cli_map cli_run cli_fit cli_info cli_mistakes cli __main__
"""


def test_the_guide_for_contributors_names_every_module_in_its_order() -> None:
    guide = (Path(jaxgran.__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = guide.split("| layer | modules |")[1].split("\n\n")[0]
    named = [name for row in table.splitlines() for name in re.findall(r"`(\w+)`", row.rpartition("|")[0])]
    assert named == LAYERS.split()[:-1]


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def imports(tree: ast.AST) -> set[str]:
    """Modules of this package that a module imports, anywhere in it."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the package"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {name.split(".")[1] for name in found if name.startswith("jaxgran.")}


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
import jaxgran.cli
changed = {name for name in before if before[name] != jax.config.values[name]}
print(xla_bridge.backends_are_initialized(), jax.config.jax_enable_x64, changed)
"""
    assert run_python(code) == "False False set()\n"


@pytest.mark.parametrize("name", jaxgran.__all__)
def test_public_names_resolve_and_are_documented(name: str) -> None:
    assert name in dir(jaxgran)
    assert getattr(jaxgran, name).__doc__
    assert getattr(jaxgran, name).__module__.startswith("jaxgran.")


def test_unknown_names_are_attribute_errors() -> None:
    with pytest.raises(AttributeError, match="no attribute 'sampel'"):
        _ = jaxgran.sampel


def test_public_names_are_those_that_load_and_that_type_checkers_see() -> None:
    tree = ast.parse(Path(jaxgran.__file__).read_text())
    seen = [alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert set(jaxgran.__all__) == set(jaxgran._HOME) == set(seen) - {"import_module", "version", "TYPE_CHECKING"}


def test_version_is_that_of_the_installed_package() -> None:
    assert jaxgran.__version__ == version("jaxgran")


def test_modules_import_only_the_layers_beneath_them() -> None:
    level = {name: k for k, name in enumerate(LAYERS.split())}
    assert {path.stem for path in SOURCES} == set(level)
    for path in SOURCES:
        above = {name for name in imports(ast.parse(path.read_text())) if level[name] >= level[path.stem]}
        assert not above, f"{path.stem} imports {above}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_modules_say_what_they_are(path: Path) -> None:
    assert ast.get_docstring(ast.parse(path.read_text()))
