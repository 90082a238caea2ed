"""What a figure shows, as text."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from jaxgran.plotting import drawing, losses, map_figures, ratio, theory


def leave_out_layout(patch: pytest.MonkeyPatch) -> None:
    """Figures keep their parts where Matplotlib puts them first: the layout takes longer than all that is drawn."""
    for module in (drawing, losses, ratio, theory):
        patch.setattr(module, "fix_layout", lambda figure: figure.set_layout_engine("none"))


def legend_texts(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def caption(figure: Figure) -> str:
    return figure.get_supxlabel()


def write_without_drawing(patch: pytest.MonkeyPatch) -> None:
    """Pictures are files of a few bytes, for tests of which files are written."""
    patch.setattr(map_figures, "_draw", lambda draw, data, path, *_: Path(path).write_bytes(b"a picture"))
