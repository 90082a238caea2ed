"""All benchmarks are run by one command, their results are named once, and what the charts judge by is right."""

import inspect
import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from matplotlib.text import Text

from benchmarks import __main__ as door
from benchmarks import output, speed_vs_accuracy, timestep_study
from benchmarks.draw import PICTURES
from benchmarks.output import Output
from benchmarks.registry import BENCHMARKS

ROOT = Path(__file__).parents[1]


def command(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-m", "benchmarks", *words], cwd=ROOT, capture_output=True, text=True)


def committed() -> list[str]:
    """Names of the results under version control; all that are there where this is no checkout."""
    if not (ROOT / ".git").exists():
        return [file.name for file in output.RESULTS.iterdir()]
    listed = subprocess.run(["git", "ls-files", "."], cwd=output.RESULTS, capture_output=True, text=True, check=True)
    return listed.stdout.split()


def test_every_result_is_named_by_one_benchmark_and_every_name_is_there() -> None:
    named = [file for one in BENCHMARKS for file in one.files]
    assert sorted(named) == sorted(committed())
    assert all((output.RESULTS / file).is_file() for file in named)


@pytest.mark.parametrize("name", PICTURES)
def test_picture_of_a_result_has_the_width_of_a_column_or_two_and_text_that_can_be_read(name: str) -> None:
    figure = PICTURES[name]()
    figure.draw_without_rendering()
    assert figure.get_figwidth() * 2.54 in (pytest.approx(8.5), pytest.approx(17))
    texts = [text for text in figure.findobj(Text) if text.get_text().strip() and text.get_visible()]
    assert min(text.get_fontsize() for text in texts) >= 6.99


def test_names_are_unique_and_no_result_looks_like_that_of_a_quick_run() -> None:
    names = [one.name for one in BENCHMARKS]
    assert len(set(names)) == len(names)
    assert not [file for one in BENCHMARKS for file in one.files if "_quick" in file]


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda one: one.name)
def test_run_takes_the_options_of_the_registry(benchmark) -> None:
    module = import_module(benchmark.module_name)
    options = [option.name.lstrip("-").replace("-", "_") for option in benchmark.options]
    first, *others = inspect.signature(module.run).parameters.values()
    assert first.name == "output"
    assert [one.name for one in others] == options
    assert all(one.default is not one.empty for one in others)
    assert f"python -m benchmarks {benchmark.name}" in module.__doc__


def test_list_names_question_minutes_and_results_without_jax() -> None:
    script = "import sys; from benchmarks.__main__ import main; main([]); assert 'jax' not in sys.modules"
    listed = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert listed.returncode == 0, listed.stderr
    for one in BENCHMARKS:
        assert one.question in listed.stdout
        assert f"{one.name}  {one.minutes[0]:g} min" in listed.stdout
        assert all(file in listed.stdout for file in one.files)


def test_an_unknown_name_is_refused_and_an_option_belongs_to_its_benchmark() -> None:
    for words in (["no_such"], ["validation", "--dataset", "x"], ["flow_picture", "--colour", "no_such"]):
        with pytest.raises(SystemExit) as end:
            door.parser().parse_args(words)
        assert end.value.code == 2
    chosen = vars(door.parser().parse_args(["reference_map", "--folder", "maps", "--quick"]))
    assert chosen["folder"] == Path("maps")


def test_a_full_run_is_refused_from_a_changed_tree(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """A quick run is not refused, nor one that is asked for; what is left behind is nothing."""
    runs = []
    monkeypatch.setattr(door, "set_up", lambda one_core: None)
    monkeypatch.setattr(door, "import_module", lambda name: type("made", (), {"run": staticmethod(runs.append)}))
    monkeypatch.setattr(output, "uncommitted", lambda: ["jaxgran/model/flow.py", "notes.txt"])
    words = ["validation", "--output", str(tmp_path / "results")]
    with pytest.raises(SystemExit) as end:
        door.main(words)
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "jaxgran/model/flow.py and 1 more" in said and "--allow-uncommitted" in said
    assert said.count("\n") == 1 and said.endswith(".\n")
    assert not runs and not (tmp_path / "results").exists()
    door.main([*words, "--quick"])
    door.main([*words, "--allow-uncommitted"])
    assert [one.quick for one in runs] == [True, False]
    assert runs[1].hardware["commit"].endswith("-dirty")
    monkeypatch.setattr(output, "uncommitted", list)
    door.main(words)
    assert not runs[2].hardware["commit"].endswith("-dirty")


def test_all_go_on_after_what_is_done_and_repeat_what_failed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    started: list[list[str]] = []
    failing = {BENCHMARKS[1].name}

    def run(command: list[str], cwd: Path) -> subprocess.CompletedProcess:
        started.append(command[3:])
        return subprocess.CompletedProcess(command, int(command[3] in failing))

    monkeypatch.setattr(door, "set_up", lambda one_core: None)
    monkeypatch.setattr(door.subprocess, "run", run)
    monkeypatch.setattr(output, "hardware", lambda: {"commit": "abc"})

    def started_by_all(status: int) -> list[str]:
        started.clear()
        with pytest.raises(SystemExit) as end:
            door.main(["all", "--quick", "--output", str(tmp_path)])
        assert end.value.code == status
        assert all(words == ["--output", str(tmp_path), "--quick"] for _, *words in started)
        return [name for name, *_ in started]

    assert started_by_all(1) == [one.name for one in BENCHMARKS]
    failed = failing.pop()
    assert started_by_all(0) == [failed]
    assert started_by_all(0) == []
    assert f"{failed}: status 1" in capsys.readouterr().out


def test_results_say_what_they_were_measured_with_and_quick_ones_have_names_of_their_own(tmp_path: Path) -> None:
    made = {"processor": "one", "commit": "abc"}
    for quick, name in ((False, "paper"), (True, "paper_quick")):
        place = Output(tmp_path / "new", quick, made)
        place.write_json("paper", {"value": 1})
        assert json.loads((tmp_path / "new" / f"{name}.json").read_text()) == {"hardware": made, "value": 1}
    place.write_rows("rows", {"head": 2}, "rows", [{"a": 1.0}, {"a": float("nan")}])
    written = (tmp_path / "new" / "rows_quick.json").read_text()
    assert json.loads(written) == {"hardware": made, "head": 2, "rows": [{"a": 1.0}, {"a": None}]}
    assert '\n  {"a": 1.0},\n' in written


def config(seconds: float, error: float, noise: float, status: str = "ok") -> dict:
    return {"seconds_per_strain": seconds, "status": status, "errors": {"pressure": (error, noise)}}


def test_front_is_what_nothing_beats_in_cost_and_beyond_noise_in_error() -> None:
    rows = [
        config(1.0, 0.10, 0.01),
        config(2.0, -0.01, 0.005),
        config(3.0, 0.012, 0.005),  # dearer than the second, no worse within the noise
        config(4.0, 0.05, 0.005),  # dearer and worse than the second
        config(0.5, 0.0, 0.001, "deep_overlap"),  # beats nothing, and is on no front
    ]
    assert [speed_vs_accuracy.on_front(row, rows, "pressure") for row in rows] == [True, True, True, False, False]


def test_extrapolation_finds_the_limit_of_two_power_laws_within_its_interval() -> None:
    dt, rng = 10.0 ** -(6 - 0.5 * np.arange(7)), np.random.default_rng(0)
    for limit, exponents in ((0.0, (0.5, 1.0)), (0.7, (0.3, 0.4)), (2.0, (0.8, 0.6))):
        exact = [limit + amplitude * dt**power for amplitude, power in zip((3.0, 5.0), exponents, strict=True)]
        data = [(dt, rng.normal(excess, 0.01 * excess), 0.01 * excess) for excess in exact]
        (best, low, high), powers = timestep_study.joint_fit(data)
        width = high - low
        assert low <= best <= high
        assert low - width <= limit <= high + width
        if width < 0.1 * (1 + limit):
            np.testing.assert_allclose(powers, exponents, atol=0.15)
