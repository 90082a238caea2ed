"""Notebooks are those of the scripts beside them, answer the question that they begin with, and are
kept with what they showed, so that a forge shows it.

They are run by ``QUICK=1 pytest --nbmake notebooks``.
"""

import json
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
def test_a_notebook_was_run_begins_with_a_question_and_shows_figures(path: Path) -> None:
    cells = jupytext.read(path).cells
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    assert not any(output["output_type"] == "error" for output in outputs)
    text = json.dumps([output.get("text", output.get("data", {})) for output in outputs])
    assert not re.search(r"/(home|root|tmp|work|Users)/|site-packages", text)
    title = cells[0].source.splitlines()[0]
    assert title.startswith("# ") and title.endswith("?")
    shown = [cell.source.splitlines()[-1] for cell in cells if cell.cell_type == "code"]
    assert any(line == "plt.show()" or re.match(r"jg\.\w+\(", line) for line in shown)
    assert 'os.environ.get("QUICK")' in "".join(cell.source for cell in cells)
