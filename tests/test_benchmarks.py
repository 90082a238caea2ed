"""All benchmarks are run by one command, their results are named once, and what the charts judge by is right."""

import inspect
import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from observed import RESTITUTION, noisy, tracks

import jaxgran as jg
from benchmarks import __main__ as door
from benchmarks import fit_design, fit_map, fit_methods, fit_rivals, output, speed_vs_accuracy, timestep_study
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
    chosen = vars(door.parser().parse_args(["closure_study", "map.nc", "--quick"]))
    assert chosen["dataset"] == Path("map.nc")


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


def test_uncommitted_changes_are_those_beside_the_results(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def git(*words: str) -> None:
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=tmp_path, check=True)

    monkeypatch.setattr(output, "ROOT", tmp_path)
    assert output.uncommitted() == []  # no checkout
    folder = tmp_path / "benchmarks" / "results"
    folder.mkdir(parents=True)
    (tmp_path / "code.py").write_text("1\n")
    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "--message", "first")
    (folder / "paper.json").write_text("{}\n")
    assert output.uncommitted() == []
    (tmp_path / "code.py").write_text("2\n")
    (tmp_path / "more.py").write_text("3\n")
    assert sorted(output.uncommitted()) == ["code.py", "more.py"]


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
    assert speed_vs_accuracy.staircase(rows, "pressure") == rows[:2]


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


def test_other_methods_find_the_restitution_of_tracked_discs() -> None:
    """Single collisions by hand, and simulations that follow eight frames."""
    discs = noisy(tracks(), 1e-4, 0.01)
    noise = fit_rivals.Noise(float(np.std(discs.velocities - tracks().velocities)), 1e-4)
    pairs = fit_rivals.pairs_of(discs)
    assert abs(fit_rivals.by_hand(pairs, noise) - RESTITUTION) < 3e-3
    restitution, tried = fit_rivals.by_simulations(pairs, noise, 1e-9, window=8, every=8)
    assert abs(restitution - RESTITUTION) < 5e-3
    assert tried > 5


def test_charts_of_fits_show_every_point_with_a_result_and_no_other() -> None:
    row = {
        "restitution": 0.3,
        "packing_fraction": 0.6,
        "camera": "steady",
        "fits": 4,
        "held": 3,
        "coverage": (0.3, 0.95),
    }
    row |= {"bias_in_errors": -1.0, "spread_in_errors": 1.0, "rejected": 1.0, "collisions": 3.0}
    figure = fit_map.draw([row, row | {"fits": 0}, row | {"camera": "quicker"}])
    share, bias, left_out = figure.axes
    assert [len(axes.containers) for axes in (share, bias)] == [2, 2]
    assert [line.get_ydata()[0] for line in left_out.lines if len(line.get_ydata())] == [0.25, 0.25]

    done = {"restitution": 0.6, "velocity_noise": 0.01, "position_noise": 1e-4, "interval": 0.005, "seconds": 1.0}
    done |= {"error": 1e-3, "error_stderr": 1e-4}
    name, other = list(fit_methods.STYLES)[:2]
    rows = [done | {"method": name, "frames": n} for n in (20, 50)]
    rows.append({**done, "method": other, "frames": 20, "error": None})
    frames, interval, _ = fit_methods.draw(rows).axes
    drawn = {each.get_label(): each.lines[0].get_xdata().tolist() for each in frames.containers}
    assert drawn[name] == [20, 50] and drawn[other] == []
    assert interval.containers[0].lines[0].get_xdata().tolist() == [0.005]


def test_design_is_compared_with_the_errors_that_fits_state_and_with_how_far_they_are_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Four fits, off by 2 of the errors that they state; a fifth one is refused."""
    fits = [SimpleNamespace(restitution=0.5 + sign * 2e-3, stderr=1e-3, collisions=30) for sign in (1, -1, 1, -1)]
    tracks = jg.Tracks(np.arange(2.0), np.ones(1), np.ones(1), *np.zeros((2, 2, 1, 2)), np.ones((2, 3)), 1.0)
    found = iter([*fits, None] * 2)

    def fitted(seen: jg.Tracks) -> SimpleNamespace:
        fit = next(found)
        if fit is None:
            raise jg.InputError("tracks must show more.")
        return fit

    def expected(flow: jg.ShearFlow, frames: int, noise: jg.TrackNoise, **options) -> jg.FisherInformation:
        if noise.velocity is None:
            raise jg.InputError("nothing will be learnt.")
        return jg.FisherInformation(1e6, 1e-3, 1e-4, 40.0, 0.5, options["frame_strain"], 0.1, 0.5, 0.5, 0.0)

    monkeypatch.setattr(fit_design, "trajectories", lambda *given: [tracks] * 5)
    monkeypatch.setattr(jg, "fit_restitution", fitted)
    monkeypatch.setattr(jg, "fisher_information", expected)
    rows = fit_design.fit_rows(0.5, 0.4, 0.1, 5)
    for row in rows:
        assert row["fits"] == 4
        assert row["stated"] == pytest.approx(1e-3)
        assert row["off"] == pytest.approx(2e-3)
        assert row["off_error"] == pytest.approx(2e-3 / np.sqrt(8))
    assert rows[1]["refused"] == "nothing will be learnt."
    left, _, right = fit_design.picture(rows, rows, rows).axes
    drawn = [bars.lines[0].get_xydata() for bars in left.containers]
    np.testing.assert_allclose([y for line in drawn for _, y in line], [1, 2])  # over the prediction; one is refused
    assert [len(bars.lines[0].get_xydata()) for bars in right.containers] == [1, 0]
