"""A table fits the terminal in pages that name their rows, and the letters that the terminal
has.
"""

import sys
from contextlib import redirect_stdout
from io import BytesIO, StringIO, TextIOWrapper

import pytest

from jaxgran.cli.tables import Table, print_table, use_plain_letters

RATIOS = [0.1 * k for k in range(1, 8)]
FRACTIONS = ("0.5", "0.65", "0.7")
MAP = Table(
    "Force ratio at dt = 0.001 / shear rate",
    ["packing fraction", *(f"{alpha:.2g}" for alpha in RATIOS)],
    [[nu, *(f"{10 * float(nu) + alpha:.4f} ± 0.0019" for alpha in RATIOS)] for nu in FRACTIONS],
)


def printed(table: Table) -> str:
    with redirect_stdout(StringIO()) as out:
        print_table(table)
    return out.getvalue()


@pytest.mark.parametrize("width", [40, 80, 120])
def test_every_page_fits_the_terminal_names_its_rows_and_loses_nothing(
    width: int, monkeypatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    out = printed(MAP)
    assert max(map(len, out.splitlines())) <= width and "…" not in out
    for nu, *cells in MAP.rows:
        rows = [line for line in out.splitlines() if line.split()[:1] == [nu]]
        assert len(rows) == out.count("Force ratio") > 1
        assert all(any(cell in row for row in rows) for cell in cells)


def test_letters_that_a_terminal_lacks_are_written_in_others(monkeypatch) -> None:
    content = BytesIO()
    monkeypatch.setattr(sys, "stdout", TextIOWrapper(content, "ascii"))
    monkeypatch.setattr(sys, "stderr", StringIO())
    use_plain_letters()
    print("σγ̇ … ☃")
    print_table(MAP)
    sys.stdout.flush()
    out = content.getvalue().decode("ascii")
    assert out.startswith("sigmagamma-dot ... ?\n")
    lines = [line for line in out.splitlines() if line.startswith("| ")]
    assert (
        "6.6000 +- 0.0019" in out and len({len(line) for line in lines}) == 1
    )  # columns stay straight
