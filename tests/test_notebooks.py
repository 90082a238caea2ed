"""Notebooks are kept without outputs, as the scripts beside them say, and answer the question that
they begin with.

They are run by ``QUICK=1 pytest --nbmake notebooks``.
"""

import re
from pathlib import Path

import jupytext
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks() -> None:
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_and_its_script_are_the_same(path: Path) -> None:
    notebook, script = jupytext.read(path), jupytext.read(path.with_suffix(".py"))
    assert [(cell.cell_type, cell.source) for cell in notebook.cells] == [
        (cell.cell_type, cell.source) for cell in script.cells
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_no_outputs_begins_with_a_question_and_shows_figures(path: Path) -> None:
    cells = jupytext.read(path).cells
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
    title = cells[0].source.splitlines()[0]
    assert title.startswith("# ") and title.endswith("?")
    shown = [cell.source.splitlines()[-1] for cell in cells if cell.cell_type == "code"]
    assert any(line == "plt.show()" or re.match(r"jg\.\w+\(", line) for line in shown)
    assert 'os.environ.get("QUICK")' in "".join(cell.source for cell in cells)
