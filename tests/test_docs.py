"""The documentation is whole: its pages, names and examples; the examples of docstrings, pages and README run."""

import doctest
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jaxgran

ROOT = Path(jaxgran.__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
MODULES = [path.stem for path in sorted(ROOT.glob("jaxgran/*.py")) if ">>> " in path.read_text(encoding="utf-8")]
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
HOW_TO = ("accelerator", "cluster", "free-cooling", "own-grains", "own-observable", "trajectories")
# the map of the README takes minutes
SMALLER = {"seeds=2, timestep=1e-4)": "seeds=1, grains=64, strain=2.0, timestep=5e-4)"}
RUN = ("../README.md", "tutorial.md", *(f"how-to/{name}.md" for name in HOW_TO))


def python_of(page: str) -> list[str]:
    """The blocks of Python of a page."""
    return _BLOCK.findall((DOCS / page).read_text(encoding="utf-8"))


def test_navigation_names_every_page_once() -> None:
    named = re.findall(r": ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(named) == sorted([*PAGES, "contributing.md", "changelog.md"])


def test_every_public_name_is_in_the_reference() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md")]
    shown = re.findall(r"^::: jaxgran\.(\w+)$", "\n".join(pages), re.MULTILINE)
    assert set(jaxgran.__all__) <= set(shown)
    assert len(shown) == len(set(shown))


@pytest.mark.parametrize("module", MODULES)
def test_examples_of_docstrings_hold(module: str) -> None:
    outcome = doctest.testmod(import_module(f"jaxgran.{module}"))
    assert outcome.attempted > 0
    assert outcome.failed == 0


def test_all_python_of_the_documentation_is_run() -> None:
    assert {page for page in PAGES if python_of(page)} | {"../README.md"} == set(RUN)


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_python_of_a_page_runs(page: str, tmp_path: Path) -> None:
    code = "\n".join(python_of(page))
    for large, small in SMALLER.items():
        assert page != RUN[0] or large in code
        code = code.replace(large, small)
    script = tmp_path / "page.py"
    script.write_text(code, encoding="utf-8")
    compiled = str(Path(os.environ["XDG_CACHE_HOME"]) / "compiled")  # the pages share what they compile
    environment = os.environ | {"MPLBACKEND": "agg", "JAX_COMPILATION_CACHE_DIR": compiled}
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
