"""A table fits the terminal in pages that name their rows, and the letters that the terminal has."""

import sys
from contextlib import redirect_stdout
from io import BytesIO, StringIO, TextIOWrapper

import numpy as np
import pytest
from synthetic import random_replica

from jaxgran.cli.measure import _say_imprecise, print_budget
from jaxgran.cli.tables import Table, print_table, use_plain_letters
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status

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
def test_every_page_fits_the_terminal_names_its_rows_and_loses_nothing(width: int, monkeypatch) -> None:
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
    assert "6.6000 +- 0.0019" in out and len({len(line) for line in lines}) == 1  # columns stay straight


def test_a_map_without_a_number_prints_no_table_and_no_error(capsys) -> None:
    settings = MapSettings((0.5, 0.9), (0.6,), grains=32, seeds=1, error=0.1)
    rng, jammed = np.random.default_rng(0), {(k, 0): Status.infeasible for k in range(2)}
    for bad in (jammed, {}, {(0, 0): Status.infeasible}):
        replicas = {key: random_replica(rng, settings, status) for key, status in bad.items()}
        if len(bad) == 1:
            replicas[1, 0] = random_replica(rng, settings)
        data = map_dataset(settings, replicas, {"command": "jaxgran map"})
        print_budget(data)
        _say_imprecise(data)
        out, err = capsys.readouterr()
        assert "nan" not in out + err
        assert (bool(out), "0.1 requested" in err) == ((True, True) if len(bad) == 1 else (False, False))
