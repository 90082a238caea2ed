"""The file of tracked discs is what its command makes, and the page about it shows what the fit prints."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import jaxgran

from benchmarks.tracked_discs import FRAMES, RATE, RESTITUTION, rows

ROOT = Path(__file__).parents[1]
FILE = ROOT / "notebooks" / "tracked_discs.csv"
PAGE = (ROOT / "docs" / "commands" / "fit.md").read_text(encoding="utf-8")
FITS = re.findall(r"^\| `jaxgran (fit \w+\.csv[^`]*)` \| ([^|]+) \| ([^|]+) \| (\d+) \|$", PAGE, re.MULTILINE)


def differenced() -> pd.DataFrame:
    """Velocities from the positions of the frames before and after, where the disc is seen in both."""
    seen = pd.read_csv(FILE).sort_values(["id", "frame"])
    of_disc = seen.groupby("id")
    during = (of_disc.frame.shift(-1) - of_disc.frame.shift(1)) / RATE
    for name in ("x", "y"):
        seen[f"v{name}"] = (of_disc[name].shift(-1) - of_disc[name].shift(1)) / during
    return seen.dropna()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tracked")
    (folder / FILE.name).write_bytes(FILE.read_bytes())
    pd.read_csv(FILE).drop(columns=["vx", "vy"]).to_csv(folder / "positions.csv", index=False)
    differenced().to_csv(folder / "differenced.csv", index=False)
    return folder


def test_the_command_makes_the_same_bytes() -> None:
    assert FILE.stat().st_size < 300_000
    assert FILE.read_bytes() == ("\n".join(rows(FRAMES)) + "\n").encode()


def numbers_of(words: str) -> list[float]:
    return [float(number) for number in re.findall(r"\d+\.?\d*", words)]


def same_fit(shown: dict[str, str], printed: dict[str, str]) -> None:
    """The same within a fifth of the standard error: by other rounding a collision more or less is told from noise."""
    ((_, error),) = [numbers_of(words) for name, words in shown.items() if name.startswith("restitution")]
    bounds = {"restitution": 0.2 * error, "95": 0.2 * error, "collisions,": 2}
    for name, words in shown.items():
        bound = bounds.get(name.split()[0], 0)
        relative = 0 if bound else 0.02
        np.testing.assert_allclose(numbers_of(printed[name]), numbers_of(words), relative, bound, err_msg=name)


def rows_of(text: str) -> dict[str, str]:
    """The rows of a printed table, by name."""
    rows = [re.split(r"\s{2,}", line.strip()) for line in text.splitlines()]
    return {row[0]: row[1] for row in rows if len(row) == 2}


def test_the_page_shows_the_file_and_what_the_fit_prints(folder: Path) -> None:
    shown = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    of_page, printed = rows_of(shown[0]), rows_of(jaxgran(folder, "fit", FILE.name).out)
    assert list(of_page) == list(printed)
    same_fit({name: words for name, words in of_page.items() if name != "of the tracks"}, printed)
    assert FILE.read_text(encoding="utf-8").startswith(shown[1])


@pytest.mark.parametrize("row", FITS, ids=lambda row: row[0])
def test_the_page_shows_the_fits_with_less(row: tuple[str, ...], folder: Path) -> None:
    command, *shown = row
    printed = rows_of(jaxgran(folder, *command.split()).out)
    names = ("restitution ± standard error", "95 % interval", "collisions, rejected")
    used = printed["collisions, rejected"].split(",")[0]
    same_fit(dict(zip(names, shown, strict=True)), printed | {"collisions, rejected": used})
    low, high = numbers_of(shown[1])
    assert low <= RESTITUTION <= high
