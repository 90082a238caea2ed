"""One command runs all benchmarks, their results are used, and charts judge rightly."""

import inspect
import json
import math
import subprocess
from functools import partial
from importlib import import_module
from itertools import product
from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest
from matplotlib.text import Text

from benchmarks import output
from benchmarks.__main__ import benchmarks, parser_of
from benchmarks.cores import on_all_cores
from benchmarks.draw import PICTURES
from benchmarks.peers import front
from benchmarks.reference_map import BETWEEN, DENSER, PLANE, reference_points
from benchmarks.timestep_study import arrays
from jaxgran.maps.results import open_map

ROOT = Path(__file__).parents[1]


def committed() -> list[str]:
    """Names of the results under version control; all that are there where this is no checkout."""
    if not (ROOT / ".git").exists():
        return [file.name for file in output.RESULTS.iterdir()]
    listed = subprocess.run(
        ["git", "ls-files", "."], cwd=output.RESULTS, capture_output=True, text=True, check=True
    )
    return listed.stdout.split()


def test_every_result_is_named_by_a_page_or_a_program() -> None:
    sources = [*(ROOT / "docs" / "_build").rglob("*.md"), *ROOT.glob("*/*.py")]
    text = "".join(path.read_text(encoding="utf-8") for path in sources)
    for name in committed():
        stem = Path(name).stem
        assert any(use in text for use in (name, f"results.{stem}", f'"{stem}"')), name


@pytest.mark.parametrize("name", benchmarks())
def test_a_benchmark_says_its_command_and_its_options_can_be_given(name: str) -> None:
    module = import_module(f"benchmarks.{name}")
    assert f"python -m benchmarks {name}" in module.__doc__
    first, *parameters = inspect.signature(module.run).parameters.values()
    assert first.name == "output"
    assert all(parameter.default is not parameter.empty for parameter in parameters)
    shared = {"quick": True, "output": ANY, "replace": False}
    given = vars(parser_of(name, module).parse_args(["--quick"]))
    assert given == {x.name: x.default if x.default is False else None for x in parameters} | shared


def root_of(folder: Path, number: int) -> float:
    """A task that notes its name, and fails for a negative number."""
    (folder / f"{number}.called").touch(exist_ok=False)
    return math.sqrt(number)


def test_a_long_benchmark_that_was_stopped_goes_on_with_what_is_missing(tmp_path: Path) -> None:
    kept, task = tmp_path / "kept", partial(root_of, tmp_path)
    with pytest.raises(ValueError, match=r"math domain|nonnegative"):
        on_all_cores(task, [4, -1], lambda number: number, kept)
    (tmp_path / "-1.called").unlink()
    assert on_all_cores(task, [9, 4], lambda number: number, kept) == [3, 2]  # 4 not once more


def test_what_is_kept_of_a_result_is_that_of_its_hardware_until_it_is_written(
    tmp_path: Path,
) -> None:
    """And what is not a number is null, anywhere."""
    one, other = (
        output.Output(tmp_path, False, {"processor": x, "commit": "1"}) for x in ("one", "other")
    )
    folders = [x.unfinished("study") for x in (one, other)]
    for folder in folders:
        assert folder is not None
        folder.mkdir()
    rows = [{"α": np.nan, "pair": (1.0, np.nan)}]
    one.write_json("study", {"mean": {"x": np.nan}, "rows": rows})
    assert [x.exists() for x in folders if x] == [False, True]
    content = json.loads((tmp_path / "study.json").read_text("utf-8"))
    assert content["mean"] == {"x": None} and content["rows"] == [{"α": None, "pair": [1.0, None]}]
    changed = output.Output(tmp_path, False, {"commit": "1-dirty"})
    assert changed.unfinished("study") is None


@pytest.mark.parametrize("name", PICTURES)
def test_picture_of_a_result_has_the_width_of_a_column_or_two_and_text_that_can_be_read(
    name: str,
) -> None:
    figure = PICTURES[name]()
    figure.draw_without_rendering()
    assert figure.get_figwidth() * 2.54 in (pytest.approx(8.5), pytest.approx(17))
    texts = [
        text for text in figure.findobj(Text) if text.get_text().strip() and text.get_visible()
    ]
    assert min(text.get_fontsize() for text in texts) >= 6.99


def test_a_time_step_without_scatter_takes_a_third_of_the_error_of_the_next_coarser_one() -> None:
    found = ((1e-6, 1.0, np.nan), (1e-5, 1.0, 0.0), (1e-4, 1.1, 0.09), (1e-3, 1.2, 0.03))
    names = ("timestep", "force_ratio", "stderr")
    _, excess, error = arrays([dict(zip(names, one, strict=True)) for one in found])
    np.testing.assert_allclose(excess, [0.0, 0.0, 0.1, 0.2], atol=1e-15)
    np.testing.assert_allclose(error, [0.01, 0.03, 0.09, 0.03])


def has_16_000(packing_fraction: float, restitution: float) -> bool:
    """Whether the page on validation says that the reference map has 16,000 grains there."""
    less_dissipative = restitution <= 0.4 and 0.5 <= packing_fraction <= 0.74
    return less_dissipative or (restitution <= 0.2 and packing_fraction <= 0.75)


def test_points_of_the_reference_map_are_those_of_its_four_maps() -> None:
    """Each has the averages of the map with the most grains, in the order of its axes."""
    points = reference_points()
    plane, between, dense, dissipative = (open_map(output.RESULTS / name) for name in PLANE)
    assert np.all(np.diff(points.packing_fraction) > 0)
    assert points.sizes["packing_fraction"] == plane.sizes["packing_fraction"]
    for nu, alpha in product(points.packing_fraction.values, points.restitution.values):
        source, grains = (plane, 6400 if nu < 0.72 else 1600)
        if nu in (*BETWEEN, *DENSER):
            source, grains = (between, 6400) if nu in BETWEEN else (dense, 3200)
        if has_16_000(nu, alpha):
            source, grains = dissipative, 16_000
        where = {"packing_fraction": nu, "restitution": alpha}
        assert points.pressure.sel(where) == source.pressure.sel(where)
        assert points.point_grains.sel(where) == grains
        assert points.point_seeds.sel(where) == source.attrs["seeds"]
    in_order = points.point_grains.values.ravel()
    np.testing.assert_array_equal(points.attrs["grains_by_point"], in_order)


def test_a_program_that_was_left_out_is_not_said_to_fail() -> None:
    flow = {"restitution": 0.8, "packing_fraction": 0.6, "discs": 256}
    failed = [{"curve": name, "setting": 1.0, "failure": "x"} for name in ("LAMMPS", "jaxgran")]
    assert "LAMMPS" not in front.table([flow | {"rows": failed[1:]}])
    table = front.table([flow | {"rows": failed}])
    assert "| LAMMPS | – | fails |" in table and "collapse" not in table
