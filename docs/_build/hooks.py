"""What the site shows from outside ``docs``: charts, notebooks, a drawing of the folders, and pages of its root.

Nothing is kept twice. Charts come from ``benchmarks/results`` into ``charts`` of the site, and the file of tracked discs
from ``notebooks``. The drawing of the folders, ``charts/architecture.svg``, is made from the imports of the code at every build.
``charts/paper.html``, the paper's map as a page to look into, is made from its dataset. ``{OBSERVABLES}`` in a page stands for
the names, units and meanings in ``jaxgran/sampling/observables.py``, and ``{OPTIONS COMMAND}`` for its options, and ``{BENCHMARKS}`` for the table of
``benchmarks/registry.py``. Pages are templates, see ``benchmarks/pages.py``. A line between two ``$$`` is a formula of TeX.
"""

import importlib
import re
import runpy
import sys
from pathlib import Path

import architecture
import notebooks
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from jaxgran.cli.arguments import placeholder
from jaxgran.cli.mistakes import option_name, with_options
from jaxgran.maps.parameters import options as parameters
from jaxgran.maps.results import open_map
from jaxgran.page.explore import explore
from jaxgran.sampling.observables import OBSERVABLES

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
from benchmarks import pages  # noqa: E402 - not installed, but beside the package
CHARTS = ROOT / "benchmarks" / "results"
CHART = re.compile(r'(<img [^>]*src="([^"]*charts/[^"]+\.png)"[^>]*>)')
MATHEMATICS = re.compile(r"^\$\$(.+)\$\$$", re.MULTILINE)
PAGES = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md", "security.md": "SECURITY.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the charts and the drawing, and the pages that stand at the root of the project."""
    for chart in sorted(CHARTS.glob("*.png")):
        files.append(File.generated(config, f"charts/{chart.name}", abs_src_path=str(chart)))
    files.append(File.generated(config, "charts/architecture.svg", content=architecture.picture()))
    files.append(File.generated(config, "charts/paper.html", content=explore(open_map(CHARTS / "paper.nc")).text))
    for name in notebooks.NAMES:
        markdown, beside = notebooks.shown(name)
        files.append(File.generated(config, f"notebooks/{name}.md", content=markdown))
        for file, content in beside.items():
            files.append(File.generated(config, f"notebooks/{file}", content=content))
    discs = ROOT / "notebooks" / "tracked_discs.csv"
    files.append(File.generated(config, f"how-to/{discs.name}", abs_src_path=str(discs)))
    for page, source in PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put in the tables of what is measured and of the benchmarks."""
    markdown = pages.filled(markdown)
    charts = "../" * page.file.src_uri.count("/") + "charts/"
    markdown = re.sub(r"\{OPTIONS (\w+)\}", lambda mark: options(mark[1]), markdown)
    for mark, table in {"{OBSERVABLES}": observables, "{BENCHMARKS}": lambda: benchmarks(charts)}.items():
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
    for name, one in OBSERVABLES.items():
        unit, group = "–" if one.unit == "1" else one.unit, "root" if one.group == "/" else one.group
        rows.append(f"| `{name}` | {unit} | {group} | {one.meaning} |")
    return "\n".join(rows)


def options(command: str) -> str:
    """A table of the options of a command."""
    rows = ["| option | meaning | default |", "| --- | --- | --- |"]
    for name, one in getattr(importlib.import_module(f"jaxgran.cli.{command}"), f"{command.upper()}_OPTIONS").items():
        names = [f"-{one.short}", option_name(name)] if one.short else [option_name(name)]
        value = "" if one.kind is bool else f" {placeholder(one)}"
        meaning = with_options(one.help, parameters(command)) + (f" In {one.unit}." if one.unit else "")
        cells = (f"`{', '.join(names)}{value}`", meaning, one.default or "–")
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(rows)


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
