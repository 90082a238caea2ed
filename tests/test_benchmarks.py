"""All benchmarks are run by one command, their results are named once, and what the charts judge by is right."""

import inspect
import subprocess
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks import __main__ as door
from benchmarks import output
from benchmarks.registry import BENCHMARKS

ROOT = Path(__file__).parents[1]


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


@pytest.mark.parametrize("benchmark", BENCHMARKS, ids=lambda one: one.name)
def test_run_takes_the_options_of_the_registry(benchmark) -> None:
    module = import_module(benchmark.module_name)
    options = [option.name.lstrip("-").replace("-", "_") for option in benchmark.options]
    first, *others = inspect.signature(module.run).parameters.values()
    assert first.name == "output"
    assert [one.name for one in others] == options
    assert all(one.default is not one.empty for one in others)
    assert f"python -m benchmarks {benchmark.name}" in module.__doc__


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
