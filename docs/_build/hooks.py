"""What the site shows from outside ``docs``: charts, notebooks, a drawing of the folders, and pages
of its root.

Pages stand in ``docs`` as they are read, with links into the repository; ``benchmarks/pages.py``
makes those with measured numbers from the templates in ``docs/_build/pages``. Here the links become
those of the site. Charts come from ``benchmarks/results`` into ``charts`` of the site. The drawing
of the folders, ``charts/architecture.svg``, is made from the imports of the code at every build,
and ``charts/paper.html`` from the dataset of the paper's map. The pages of ``executed.PAGES`` show
what their examples print. A line between two ``$$`` is a formula of TeX.
"""

import re
from pathlib import Path

import architecture
import executed
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import notebooks
from jaxgran.maps.results import open_map
from jaxgran.page.explore import explore

ROOT = Path(__file__).parents[2]
CHARTS = ROOT / "benchmarks" / "results"
LINKED_CHART = re.compile(r"(?:\.\./)+benchmarks/results/([\w.]+\.(?:png|gif))")
LINKED_NOTEBOOK = re.compile(r"(?:\.\./)+notebooks/(\w+)\.ipynb")
LINKED_PAGE = re.compile(r"(?:\.\./)+(CONTRIBUTING|CHANGELOG|SECURITY)\.md")
CHART = re.compile(r'(<img [^>]*src="([^"]*charts/[^"]+\.(?:png|gif))"[^>]*>)')
MATHEMATICS = re.compile(r"^\$\$(.+)\$\$$", re.MULTILINE)
PAGES = {
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "security.md": "SECURITY.md",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the charts and the drawing, and the pages that stand at the root of the project."""
    for chart in sorted([*CHARTS.glob("*.png"), *CHARTS.glob("*.gif")]):
        files.append(File.generated(config, f"charts/{chart.name}", abs_src_path=str(chart)))
    files.append(File.generated(config, "charts/architecture.svg", content=architecture.picture()))
    files.append(
        File.generated(
            config, "charts/paper.html", content=explore(open_map(CHARTS / "paper.nc")).text
        )
    )
    for name in notebooks.NAMES:
        markdown, beside = notebooks.shown(name)
        files.append(File.generated(config, f"notebooks/{name}.md", content=markdown))
        for file, content in beside.items():
            files.append(File.generated(config, f"notebooks/{file}", content=content))
    for page, source in PAGES.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Run the examples, make links into the repository those of the site, and typeset formulas."""
    name = page.file.src_uri
    if name in executed.PAGES:
        markdown, pictures = executed.executed(markdown, name.removesuffix(".md"))
        for file, content in pictures.items():
            files.append(File.generated(config, file, content=content))
    root = "../" * name.count("/")
    markdown = LINKED_CHART.sub(rf"{root}charts/\1", markdown)
    markdown = LINKED_NOTEBOOK.sub(rf"{root}notebooks/\1.md", markdown)
    markdown = LINKED_PAGE.sub(lambda link: f"{root}{link[1].lower()}.md", markdown)
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
