"""A table fits the terminal, loses nothing, and has the letters that the terminal has."""

import sys
from contextlib import redirect_stdout
from io import BytesIO, StringIO, TextIOWrapper

import pytest

from jaxgran.cli.output import print_table, use_plain_letters

RATIOS = [0.1 * k for k in range(1, 8)]
FRACTIONS = ("0.5", "0.65", "0.7")
MAP = (
    "Force ratio at dt = 0.001 / shear rate",
    ["packing fraction", *(f"{alpha:.2g}" for alpha in RATIOS)],
    [[nu, *(f"{10 * float(nu) + alpha:.4f} ± 0.0019" for alpha in RATIOS)] for nu in FRACTIONS],
)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_table_fits_the_terminal_and_loses_nothing(width: int, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    with redirect_stdout(StringIO()) as out:
        print_table(*MAP)
    text = out.getvalue()
    assert max(map(len, text.splitlines())) <= width and "…" not in text
    digits = "".join(text.split())
    for _, *cells in MAP[2]:
        assert all(cell.split()[0][:4] in digits for cell in cells)
    assert text.count("±") == len(FRACTIONS) * len(RATIOS)
    assert text.count(" ± 0.0019") == text.count("±")  # no number is broken


def test_letters_that_a_terminal_lacks_are_written_in_others(monkeypatch) -> None:
    content = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(content, "ascii"))
    monkeypatch.setattr(sys, "stderr", StringIO())
    monkeypatch.setenv("COLUMNS", "200")
    use_plain_letters()
    print("σγ̇ … ☃")
    print_table(*MAP)
    sys.stdout.flush()
    text = content.getvalue().decode("ascii")
    assert text.startswith("sigmagamma-dot ... ?\n") and "6.6000 +- 0.0019" in text
