"""What the site shows from outside ``docs``: charts, sections of the README, contributing and the change log.

Nothing is kept twice. Charts come from ``benchmarks/results`` into ``charts`` of the site. A line

    {README: Section}    or    {README: Section / Paragraph.}

in a page stands for a section of the README, or for the part of it that begins with that bold paragraph, up to the next
one; ``{README: Section / }`` is what precedes the first. A section that is not there stops the build. ``{OBSERVABLES}``
stands for the names, units and meanings in ``jaxgran/sampling/observables.py``.
"""

import ast
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
CHARTS = ROOT / "benchmarks" / "results"
PAGES = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
_INCLUDED = re.compile(r"^\{README: (?P<section>[^/}]+?)(?P<part> / (?P<lead>[^}]*))?\}$", re.MULTILINE)
_CHART = re.compile(r"\]\(benchmarks/results/([\w.]+)\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the charts, and the pages that stand at the root of the project."""
    for chart in sorted(CHARTS.glob("*.png")):
        files.append(File.generated(config, f"charts/{chart.name}", abs_src_path=str(chart)))
    for page, source in PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put in the sections of the README, and point at the charts of the site."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")

    def included(line: re.Match) -> str:
        text = section(readme, line["section"])
        return text if line["part"] is None else paragraph(text, line["lead"].strip())

    if "{OBSERVABLES}" in markdown:
        markdown = markdown.replace("{OBSERVABLES}", observables())
    charts = "../" * page.file.src_uri.count("/") + "charts/"
    return _CHART.sub(rf"]({charts}\1)", _INCLUDED.sub(included, markdown))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Stop where a table of a docstring was not understood."""
    if "====" in html:
        raise PluginError(f"{page.file.src_uri} shows the borders of a table as they are.")
    return html


def observables() -> str:
    """A table of what is measured, read from the source: importing it would start JAX."""
    tree = ast.parse((ROOT / "jaxgran" / "sampling" / "observables.py").read_text(encoding="utf-8"))
    constants = {name.id: value for name, value in map(_assigned, tree.body) if name is not None}
    stress_unit = ast.literal_eval(constants["STRESS_UNIT"])
    rows = ["| name | unit | meaning |", "| --- | --- | --- |"]
    for name, about in zip(constants["OBSERVABLES"].keys, constants["OBSERVABLES"].values, strict=True):
        meaning, unit = (stress_unit if isinstance(x, ast.Name) else ast.literal_eval(x) for x in about.elts)
        rows.append(f"| `{ast.literal_eval(name)}` | {'–' if unit == '1' else unit} | {meaning} |")
    return "\n".join(rows)


def _assigned(statement: ast.stmt) -> tuple:
    """Name and value of an assignment to one name; None twice for anything else."""
    if isinstance(statement, ast.AnnAssign):
        return statement.target, statement.value
    one = isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name)
    return (statement.targets[0], statement.value) if one else (None, None)


def section(text: str, title: str) -> str:
    """The text under a heading of the second level."""
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if found is None:
        raise PluginError(f"README.md has no section {title!r}.")
    return found[1].strip("\n")


def paragraph(text: str, lead: str) -> str:
    """The part of a section that begins with a bold lead, without it; of an empty lead, what precedes the first."""
    parts = re.split(r"^\*\*([^*\n]+)\*\* ?", text, flags=re.MULTILINE)
    known = {"": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}
    if lead not in known:
        raise PluginError(f"README.md has no paragraph {lead!r} in that section.")
    return known[lead].strip("\n")
