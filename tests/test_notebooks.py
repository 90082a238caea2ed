"""Notebooks are kept without outputs, as the scripts beside them say, and answer the question that they begin with.

They are run by ``QUICK=1 pytest --nbmake notebooks``.
"""

import base64
from importlib import import_module
from pathlib import Path

import jupytext
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks() -> None:
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_and_its_script_are_the_same(path: Path) -> None:
    notebook, script = jupytext.read(path), jupytext.read(path.with_suffix(".py"))
    assert [(cell.cell_type, cell.source) for cell in notebook.cells] == [
        (cell.cell_type, cell.source) for cell in script.cells
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_no_outputs_begins_with_a_question_and_ends_with_a_figure(path: Path) -> None:
    cells = jupytext.read(path).cells
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
    title = cells[0].source.splitlines()[0]
    assert title.startswith("# ") and title.endswith("?")
    last = cells[-1].source.splitlines()[-1]
    figures = ("plt.show()", "jg.flow_figure(", "jg.ratio_contours(", "jg.theory_errors(", "jg.enskog_factors(")
    assert last.startswith(figures)


def test_page_of_a_notebook_has_its_outputs_but_no_warnings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "docs" / "_build")
    page_of, longest, bare = (getattr(import_module("notebooks"), name) for name in ("page_of", "LONGEST", "BARE"))
    shown = [
        {"output_type": "stream", "name": "stdout", "text": ["force ", "ratio"]},
        {"output_type": "stream", "name": "stderr", "text": "/tmp/kernel.py:1: UserWarning"},
        {"output_type": "display_data", "data": {"image/png": base64.b64encode(b"picture").decode()}},
        {"output_type": "execute_result", "data": {"text/html": "<table>", "text/plain": "table"}},
        {"output_type": "execute_result", "data": {"text/html": "<p>" * longest, "text/plain": "page"}},
    ]
    title = {"cell_type": "markdown", "source": ["# Why?"]}
    cells = [title, {"cell_type": "code", "source": "1", "outputs": shown}]
    page = page_of({"cells": cells}, "01_why")
    assert page.markdown.startswith("# Why?\n\n```python\n1\n```\n\n```text\nforce ratio\n```\n\n![")
    assert "Warning" not in page.markdown and '<div class="output"><table></div>' in page.markdown
    assert page.files.keys() == {"01_why_0.png", "01_why_1.html"}
    assert all(f"{name}" in page.markdown for name in page.files) and page.files["01_why_0.png"] == b"picture"
    assert bare in page_of({"cells": [title, {"cell_type": "code", "source": "1", "outputs": []}]}, "01_why").markdown
