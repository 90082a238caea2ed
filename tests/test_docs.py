"""The documentation is complete: pages, names and links exist; examples of docstrings, pages and
README run.
"""

import ast
import copy
import doctest
import os
import re
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import jax
import jinja2
import netCDF4
import pytest

import jaxgran
from benchmarks import pages

ROOT = Path(jaxgran.__file__).parents[1]
PAPER = ROOT / "docs" / "paper"
DOCS = ROOT / "docs"
HIDDEN = {PAPER, DOCS / "_build"}  # from the site
PAGES = sorted(
    path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md") if not HIDDEN & {*path.parents}
)
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


# Names of other programs and of examples, and endings of files
FOREIGN = """ConstantMomentum NO_MKDOCS_2_WARNING as cell_size_too_small css csv data_columns
    dev dirty h5 hdf5 import install-completion jaxgran_map js lammpstrj lees_edwards
    lint-imports lowest mp4 nc ncdump no-caption no-snapshots or False null pandas pure_callback
    pyplot pyright pytest_cache read_csv select show-completion simulate src tcp tsv txt vjp"""
PLACEHOLDERS = (
    "ADDRESS COMMAND DT FACTOR FILE FOLDER LIST NAME NUMBER PRESET RULE STRAIN STRESS TAU TOL"
)
COMMANDS = """pip uv ruff pytest mkdocs jupytext chromium-driver sp-repo-review
    cut fix pair_style damping flip"""
FOLDERS = ("", "jaxgran", "tests", "benchmarks", "docs", "notebooks", "benchmarks/results")
_FIELDS = (
    "id",
    "attr",
    "name",
    "arg",
    "value",
)  # of syntax trees: names, attributes, definitions, arguments, strings


def names_of_the_project() -> set[str]:
    """Identifiers and strings of the source code, files and folders, names in the file of a map."""
    names = {"jaxgran", *FOREIGN.split()}
    files = [
        path
        for folder in ("benchmarks", "tests", "docs/_build")
        for path in (ROOT / folder).rglob("*.py")
    ]
    for path in [*SOURCES, *files]:
        names.update(path.relative_to(ROOT).parts, [path.stem])
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            texts = [x for field in _FIELDS if isinstance(x := getattr(node, field, None), str)]
            names.update(part for text in texts for part in (text, *text.split("/")))
    with netCDF4.Dataset(ROOT / "benchmarks" / "results" / "paper.nc") as data:
        for group in (data, *data.groups.values()):
            names.update(group.variables, group.dimensions, group.ncattrs(), [group.name])
    return names


def unknown_names(code: str, names: set[str]) -> list[str]:
    """Names in a piece of code that do not exist."""
    first = code.split()[0]
    if (
        first in COMMANDS.split()
        or "=" in first
        or any((ROOT / folder / code).exists() for folder in FOLDERS)
    ):
        return []
    words = re.findall(r"(?<![\w-])-*([A-Za-z_][\w-]*)", code)
    words = [
        word for word in words if len(word) > 1 and not {*word.split("_")} & {*PLACEHOLDERS.split()}
    ]
    return [word for word in words if not {word, word.replace("-", "_")} & names]


def test_every_name_in_backticks_exists() -> None:
    names = names_of_the_project()
    unknown = {}
    for path in [ROOT / "CONTRIBUTING.md", *(DOCS / page for page in PAGES)]:
        text = re.sub(
            r"^ *```.*?^ *```$",
            "",
            path.read_text(encoding="utf-8"),
            flags=re.MULTILINE | re.DOTALL,
        )
        codes = sorted(set(re.findall(r"`([^`\n]+)`", text)))
        unknown |= {
            f"{path.name}: {code}": found for code in codes if (found := unknown_names(code, names))
        }
    assert not unknown, "\n".join(
        f"{place} has {', '.join(found)}" for place, found in unknown.items()
    )


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


def test_a_changed_result_changes_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / pages.TEMPLATES["docs/evidence/speed.md"]).read_text(encoding="utf-8")
    before = pages.filled(text)
    changed = copy.deepcopy(pages.read("step_cost"))
    changed["points"][0]["jaxgran_us"] *= 1.5
    monkeypatch.setattr(
        pages, "read", lambda name, read=pages.read: changed if name == "step_cost" else read(name)
    )
    lines = zip(before.splitlines(), pages.filled(text).splitlines(), strict=True)
    changed_lines = [one for one, other in lines if one != other]
    assert len(changed_lines) == 1 and changed_lines[0].startswith("| 0.9 | 0.56 |")
    with pytest.raises(jinja2.UndefinedError):
        pages.filled("{{ results.step_cost.no_such_name }}")


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
    code = "\n".join(python_of(page))
    script = tmp_path / "page.py"
    script.write_text(code, encoding="utf-8")
    environment = os.environ | {
        "MPLBACKEND": "agg",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
    }
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.environment
@pytest.mark.parametrize("page", EXECUTED["PAGES"])
def test_an_executed_page_shows_what_its_blocks_print_and_draw(page: str) -> None:
    written = (DOCS / page).read_text(encoding="utf-8")
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        shown, pictures = EXECUTED["executed"](written, "page")
    assert all(line in shown for line in written.splitlines())
    texts = re.findall(r"^```text\n(.+?)^```$", shown, re.MULTILINE | re.DOTALL)
    assert pictures and all(f"]({file})" in shown for file in pictures)
    assert len(texts) + len(pictures) == len(
        re.findall(r"^```(?:python|shell)$", written, re.MULTILINE)
    )
    assert all(text.strip() for text in texts)


def test_the_paper_cites_what_its_bibliography_has_and_shows_figures_that_are_there() -> None:
    text, bibliography = ((PAPER / name).read_text() for name in ("paper.md", "paper.bib"))
    cited = set(re.findall(r"@([a-z]+\d{4})", text))
    assert cited == set(re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE))
    figures = re.findall(r"\]\((\S+\.png)\)", text)
    assert len(figures) == 2 and all((PAPER / figure).is_file() for figure in figures)
