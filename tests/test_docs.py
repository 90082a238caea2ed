"""Pages, names and links of the documentation exist, and its examples run."""

import doctest
import os
import re
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import jax
import pytest
import typer

import jaxgran
from benchmarks import pages
from jaxgran.cli import app

ROOT = Path(jaxgran.__file__).parents[1]
PAPER = ROOT / "docs" / "paper"
DOCS = ROOT / "docs"
HIDDEN = {PAPER / "paper.md", DOCS / "_build"}  # from the site
PAGES = sorted(
    path.relative_to(DOCS).as_posix()
    for path in DOCS.rglob("*.md")
    if not HIDDEN & {path, *path.parents}
)
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "jaxgran").rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def python_of(page: str) -> list[str]:
    """The blocks of Python of a page."""
    return _BLOCK.findall((DOCS / page).read_text(encoding="utf-8"))


EXECUTED = runpy.run_path(str(DOCS / "_build" / "executed.py"))
RUN = (
    "../README.md",
    *(page for page in PAGES if python_of(page) and page not in EXECUTED["PAGES"]),
)


def test_navigation_names_every_page_once() -> None:
    named = re.findall(
        r": ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE
    )
    notebooks = [f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")]
    assert sorted(named) == sorted(
        [*PAGES, *notebooks, "contributing.md", "changelog.md", "security.md"]
    )


def test_tests_that_pages_name_are_there() -> None:
    text = "".join((DOCS / page).read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"`(test_\w+)`", text))
    there = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").glob("test_*.py"))
    assert named <= set(re.findall(r"^def (test_\w+)", there, re.MULTILINE))


def test_names_and_commands_on_the_pages_exist() -> None:
    text = "".join((DOCS / page).read_text(encoding="utf-8") for page in ("../README.md", *PAGES))
    assert set(re.findall(r"\bjg\.([A-Za-z]\w*)", text)) <= set(jaxgran.__all__)
    commands = typer.main.get_command(app.app).commands
    code = "".join(re.findall(r"^ *```.*?^ *```", text, re.MULTILINE | re.DOTALL))
    lines = re.findall(r"^ *jaxgran (\w+)(.*)", code.replace("\\\n", " "), re.MULTILINE)
    assert len(lines) > 20
    for name, words in lines:
        options = {option for x in commands[name].params for option in (*x.opts, *x.secondary_opts)}
        given = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", words.partition("#")[0]))
        assert given <= options | {"--help"}, f"jaxgran {name}{words}"


@pytest.mark.parametrize("page", pages.TEMPLATES)
def test_measured_numbers_of_a_page_come_from_files(page: str) -> None:
    """``python -m benchmarks.pages`` makes the pages anew."""
    written, text = (
        (ROOT / name).read_text(encoding="utf-8") for name in (page, pages.TEMPLATES[page])
    )
    assert written == pages.filled(text) and "{%" not in written
    typed = re.sub(r"{{.*?}}|{%.*?%}", "", text)
    if page.startswith("docs/") and not page.startswith("docs/paper"):
        assert not re.search(r"\d ± \d|[−+]\d[\d.]* %", typed)
    if page in ("docs/evidence/speed.md", "docs/evidence/validation.md"):
        assert not re.findall(r"\S*\d (?:%|ns|µs|ms|s|KiB|MiB|MB|GiB|times)(?!\w)", typed)


def test_every_public_name_is_in_the_reference() -> None:
    pages = [page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md")]
    shown = re.findall(r"^::: jaxgran\.(\w+)$", "\n".join(pages), re.MULTILINE)
    assert set(jaxgran.__all__) <= set(shown)
    assert len(shown) == len(set(shown))


@pytest.mark.parametrize("module", [*MODULES, "benchmarks.pages"])
def test_examples_of_docstrings_hold(module: str) -> None:
    outcome = doctest.testmod(import_module(module))
    assert outcome.attempted > 0
    assert outcome.failed == 0


def test_readme_is_short_and_its_links_lead_somewhere() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.split()) <= 600
    links = re.findall(r"\]\(([^)#]+)", readme)
    assert len(links) > 20 and all((ROOT / link).is_file() for link in links)


@pytest.mark.environment
@pytest.mark.parametrize("page", RUN)
def test_python_of_a_page_runs(page: str, tmp_path: Path) -> None:
    environment = os.environ | {
        "MPLBACKEND": "agg",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
    }
    command = [sys.executable, "-c", "\n".join(python_of(page))]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.environment
@pytest.mark.parametrize("page", EXECUTED["PAGES"])
def test_an_executed_page_shows_what_its_blocks_print_and_draw(page: str) -> None:
    written = (DOCS / page).read_text(encoding="utf-8")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        shown, pictures = EXECUTED["executed"](written, "page")
    assert all(line in shown for line in written.splitlines())
    texts = re.findall(r"^```text\n(.+?)^```$", shown, re.MULTILINE | re.DOTALL)
    blocks = re.findall(r"^```(?:python|shell)$", written, re.MULTILINE)
    assert pictures and all(f"]({file})" in shown for file in pictures)
    assert len(texts) + len(pictures) == len(blocks) and all(text.strip() for text in texts)


def test_the_paper_cites_what_its_bibliography_has_and_shows_figures_that_are_there() -> None:
    text, bibliography = ((PAPER / name).read_text() for name in ("paper.md", "paper.bib"))
    cited = set(re.findall(r"@([a-z]+\d{4})", text))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE))
    figures = re.findall(r"\]\((\S+\.png)\)", text)
    assert len(figures) == 2 and all((PAPER / figure).is_file() for figure in figures)
