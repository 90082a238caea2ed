"""The documentation is whole: its pages, names and examples; the examples of docstrings, pages and README run."""

import doctest
import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import jax
import pytest

import jaxgran

ROOT = Path(jaxgran.__file__).parents[1]
PAPER = ROOT / "docs" / "paper"
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
SOURCES = sorted((ROOT / "jaxgran").rglob("*.py"))
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in SOURCES
    if ">>> " in path.read_text(encoding="utf-8")
]
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def python_of(page: str) -> list[str]:
    """The blocks of Python of a page."""
    return _BLOCK.findall((DOCS / page).read_text(encoding="utf-8"))


RUN = ("../README.md", *(page for page in PAGES if python_of(page)))


def test_navigation_names_every_page_once() -> None:
    named = re.findall(r": ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    notebooks = [f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")]
    assert sorted(named) == sorted([*PAGES, *notebooks, "contributing.md", "changelog.md", "security.md"])


def test_tests_that_pages_name_are_there() -> None:
    text = "".join((DOCS / page).read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"`(test_\w+)`", text))
    there = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py"))
    assert named and named <= set(re.findall(r"^def (test_\w+)", there, re.MULTILINE))


def test_every_public_name_is_in_the_reference() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md")]
    shown = re.findall(r"^::: jaxgran\.(\w+)$", "\n".join(pages), re.MULTILINE)
    assert set(jaxgran.__all__) <= set(shown)
    assert len(shown) == len(set(shown))


@pytest.mark.parametrize("module", MODULES)
def test_examples_of_docstrings_hold(module: str) -> None:
    outcome = doctest.testmod(import_module(module))
    assert outcome.attempted > 0
    assert outcome.failed == 0


def test_readme_is_short_and_its_links_lead_somewhere() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme.count("\n") <= 160
    links = re.findall(r"\]\(([^)#]+)", readme)
    assert len(links) > 20 and all((ROOT / link).is_file() for link in links)


@pytest.mark.environment
@pytest.mark.parametrize("page", RUN)
def test_python_of_a_page_runs(page: str, tmp_path: Path) -> None:
    code = "\n".join(python_of(page))
    script = tmp_path / "page.py"
    script.write_text(code, encoding="utf-8")
    (tmp_path / "tracked_discs.csv").symlink_to(ROOT / "notebooks" / "tracked_discs.csv")
    environment = os.environ | {"MPLBACKEND": "agg", "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir}
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_paper_cites_what_its_bibliography_has_and_shows_figures_that_are_there() -> None:
    text, bibliography = ((PAPER / name).read_text() for name in ("paper.md", "paper.bib"))
    cited = set(re.findall(r"@([a-z]+\d{4})", text))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE))
    figures = re.findall(r"\]\((\S+\.png)\)", text)
    assert len(figures) == 2 and all((PAPER / figure).is_file() for figure in figures)
