"""What a figure shows, as text."""

from matplotlib.figure import Figure


def legend_texts(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def caption(figure: Figure) -> str:
    return figure.get_supxlabel()
