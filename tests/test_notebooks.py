"""Notebooks are kept without outputs, as the scripts beside them say, and answer the question that they begin with.

They are run by ``QUICK=1 pytest --nbmake notebooks``.
"""

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
