"""What the site shows from outside ``docs``: charts, notebooks, a drawing of the folders, and pages
of its root.

Charts come from ``benchmarks/results`` into ``charts`` of the site. The drawing of the folders,
``charts/architecture.svg``, is made from the imports of the code at every build, and
``charts/paper.html`` from the dataset of the paper's map. Pages are templates
(``benchmarks/pages.py``), and those of ``executed.PAGES`` show what their examples print. A line
between two ``$$`` is a formula of TeX.

==================  ================================================================================
mark in a page      replaced by
==================  ================================================================================
{OBSERVABLES}       names, units and meanings of ``jaxgran/sampling/observables.py``
{VARIABLES GROUP}   the rows of a group of ``jaxgran/maps/variables.py``
{COORDINATES}       the coordinates of a map
{OPTIONS COMMAND}   the options of a command
{EXAMPLES COMMAND}  the examples of its ``--help``
{BENCHMARKS}        the table of ``benchmarks/registry.py``
{NOTEBOOKS}         links to the notebooks, by their titles
==================  ================================================================================
"""

import ast
import importlib
import inspect
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import architecture
import executed
import notebooks
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from jaxgran.cli.options import option_name, with_options
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.results import open_map
from jaxgran.maps.schema import path_of
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.settings import options as parameters
from jaxgran.maps.variables import COORDINATES, VARIABLES
from jaxgran.page.explore import explore
from jaxgran.sampling.observables import OBSERVABLES, Observables

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from benchmarks import pages  # noqa: E402 - not installed, but beside the package
CHARTS = ROOT / "benchmarks" / "results"
CHART = re.compile(r'(<img [^>]*src="([^"]*charts/[^"]+\.(?:png|gif))"[^>]*>)')
MATHEMATICS = re.compile(r"^\$\$(.+)\$\$$", re.MULTILINE)
PAGES = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md", "security.md": "SECURITY.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the charts and the drawing, and the pages that stand at the root of the project."""
    for chart in sorted([*CHARTS.glob("*.png"), *CHARTS.glob("*.gif")]):
        files.append(File.generated(config, f"charts/{chart.name}", abs_src_path=str(chart)))
    files.append(File.generated(config, "charts/architecture.svg", content=architecture.picture()))
    files.append(File.generated(config, "charts/paper.html", content=explore(open_map(CHARTS / "paper.nc")).text))
    for name in notebooks.NAMES:
        markdown, beside = notebooks.shown(name)
        files.append(File.generated(config, f"notebooks/{name}.md", content=markdown))
        for file, content in beside.items():
            files.append(File.generated(config, f"notebooks/{file}", content=content))
    for page, source in PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Run the examples, and put in numbers, tables and formulas."""
    name = page.file.src_uri
    if name in executed.PAGES:
        markdown, pictures = executed.executed(markdown, name.removesuffix(".md"))
        for file, content in pictures.items():
            files.append(File.generated(config, file, content=content))
    markdown = pages.filled(markdown)
    charts = "../" * name.count("/") + "charts/"
    markdown = re.sub(r"\{OPTIONS (\w+)\}", lambda mark: options(mark[1]), markdown)
    markdown = re.sub(r"\{EXAMPLES (\w+)\}", lambda mark: examples(mark[1]), markdown)
    markdown = re.sub(r"\{VARIABLES (\S+)\}", lambda mark: variables(mark[1]), markdown)
    tables = {"{COORDINATES}": coordinates, "{OBSERVABLES}": observables, "{BENCHMARKS}": lambda: benchmarks(charts), "{NOTEBOOKS}": list_of_notebooks}
    for mark, table in tables.items():
        if mark in markdown:
            markdown = markdown.replace(mark, table())
    return MATHEMATICS.sub(lambda formula: typeset(formula[1]), markdown)


def typeset(formula: str) -> str:
    """A formula of TeX as MathML, which browsers draw without a script."""
    from latex2mathml.converter import convert

    return f'<div class="formula">{convert(formula, display="block")}</div>'


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Link charts to their full size; stop where a table of a docstring was not understood."""
    if "====" in html:
        raise PluginError(f"{page.file.src_uri} shows the borders of a table as they are.")
    return CHART.sub(r'<a href="\2" title="in full size">\1</a>', html)


def observables() -> str:
    """A table of what is measured."""
    rows = ["| name | unit | group in the file of a map | meaning |", "| --- | --- | --- | --- |"]
    for name, row in OBSERVABLES.items():
        group = "root" if row.group == "/" else row.group
        rows.append(f"| `{name}` | {unit_of(row.unit)} | {group} | {row.meaning} |")
    return "\n".join(rows)


def unit_of(unit: str | None) -> str:
    return "–" if unit in ("1", None) else unit


def variables(group: str) -> str:
    """A table of the variables of a group of a map, with the formulas of averages and the names of their errors."""
    rows = {row.path.rpartition("/")[2]: row for row in VARIABLES if row.group == group}
    data = map_dataset(MapSettings((0.5,), (0.6,), timestep=1e-3), {}, {})
    names = map(str, data[group].data_vars) if group == "/" or group in data.children else ()
    endings: dict[str, list[str]] = {name: [] for name in rows}
    for name in names:
        if name not in rows:
            owner = max((row for row in rows if name.startswith(row)), key=len)
            endings[owner].append(f"`{name.removeprefix(owner)}`")
    lines = ["| name | dimensions | unit | meaning | formula | errors |", "| --- | --- | --- | --- | --- | --- |"]
    for name, row in rows.items():
        formula = f"`{formulas()[name]}`" if path_of(name) == row.path and name in OBSERVABLES else ""
        dims = ", ".join(f"`{dim}`" for dim in row.dims)
        lines.append(f"| `{name}` | {dims} | {unit_of(row.unit)} | {row.meaning} | {formula} | {', '.join(endings[name])} |")
    return "\n".join(lines)


def formulas() -> dict[str, str]:
    """The formulas of the observables as they are written in their table."""
    (table,) = ast.parse(inspect.getsource(Observables)).body
    rows = {row.targets[0].id: row.value.args[1].body for row in table.body if isinstance(row, ast.Assign)}
    return {name: re.sub(r"\b(s|xp)\.", "", ast.unparse(formula)) for name, formula in rows.items()}


def coordinates() -> str:
    """A table of the coordinates of a map."""
    lines = ["| coordinate | unit | meaning |", "| --- | --- | --- |"]
    for name, about in COORDINATES.items():
        lines.append(f"| `{name}` | {unit_of(about.get('units'))} | {about['long_name']} |")
    return "\n".join(lines)


def table_of(command: str, kind: str) -> Any:
    """A constant of the command line, such as ``MAP_OPTIONS``."""
    module = "map" if command == "plot" else command
    return getattr(importlib.import_module(f"jaxgran.cli.{module}"), f"{command.upper()}_{kind}")


def options(command: str) -> str:
    """A table of the options of a command."""
    rows = ["| option | meaning | default |", "| --- | --- | --- |"]
    for name, one in table_of(command, "OPTIONS").items():
        flag = f"-{one.short}, {option_name(name)}" if one.short else option_name(name)
        meaning = with_options(one.help, parameters(command)) + (f" In {one.unit}." if one.unit else "")
        if isinstance(one.kind, tuple):
            flag, meaning = f"{flag} NAME", (f"{meaning} One of "
                                            f"{', '.join(f'`{choice}`' for choice in one.kind)}.")
        elif one.kind is not bool:
            flag = f"{flag} {one.placeholder}".replace("|auto", " or auto")
        elif one.off:
            flag = f"{flag}, --no-{name}"
        rows.append(f"| `{flag}` | {meaning} | {one.default or '–'} |")
    return "\n".join(rows)


def examples(command: str) -> str:
    """The examples of a command."""
    lines = [f"# {meaning}\n{example}" for meaning, example in table_of(command, "EXAMPLES").items()]
    return "\n".join(["```shell", *lines, "```"])


def list_of_notebooks() -> str:
    """The notebooks by their titles, as a list of links from a page beside their folder."""
    titles = (notebooks.shown(name).markdown.split("\n", 1)[0].lstrip("# ") for name in notebooks.NAMES)
    return "\n".join(f"- [{title}](notebooks/{name}.md)" for name, title in zip(notebooks.NAMES, titles, strict=True))


def benchmarks(charts: str) -> str:
    """A table of all benchmarks, read from the registry, which imports nothing heavy."""
    registry = runpy.run_path(str(ROOT / "benchmarks" / "registry.py"))["BENCHMARKS"]
    rows = ["| question | command: `python -m benchmarks` | minutes, in full and quick | figures |"]
    rows.append("| --- | --- | --- | --- |")
    for one in registry:
        drawn = [name.removesuffix(".png") for name in one.files if name.endswith(".png")]
        figures = ", ".join(f"[{name}]({charts}{name}.png)" for name in drawn) or "–"
        full, quick = one.minutes
        rows.append(f"| {one.question} | `{one.name}` | {full:g}, {quick:g} | {figures} |")
    return "\n".join(rows)
