"""The command line does what it says, and says in one sentence what it cannot do."""

import errno
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import typer
import xarray as xr
from command_line import (
    POINTS,
    Outcome,
    assert_one_sentence,
    files,
    in_a_process,
    jaxgran,
    made_up_replicas,
    write_few_variables,
)
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from PIL import Image
from synthetic import one_sentence, random_replica

from jaxgran.cli import app, options
from jaxgran.cli import map as map_module
from jaxgran.cli.output import in_brackets
from jaxgran.cli.run import _complete_at_the_end
from jaxgran.contact.projected_methods import Jacobi
from jaxgran.environment import usable_cores
from jaxgran.io import trajectory
from jaxgran.io.trajectory import read_trajectory
from jaxgran.maps import ratio_map as ratio_map_module
from jaxgran.maps.results import open_map, write_dataset
from jaxgran.maps.schema import flattened, path_of
from jaxgran.maps.start import combined
from jaxgran.maps.variables import NOT_RUN
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import with_error
from jaxgran.model.status import Status
from jaxgran.plotting.map_figures import FIGURES
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.thresholds import LEAST_SAMPLE

SMALL_MAP = (
    "map --restitution 0.5,0.9 --packing-fraction 0.5,0.6 --grains 32 --seeds 1 --timestep 1e-3 "
    "--equilibrate 0.5 --strain 2 --workers 1 --output small.nc"
)
SAME = "grains", "seeds", "timestep", "strain", "equilibrate", "tolerance", "activation"
SAME += ("precision", "solver", "engine", "solver_requested", "engine_requested")
PICTURES = {f"small_{name}.png" for name in ("curves", "contours", "theory", "factors", "clusters")}
FRAMES = ["--trajectory", "flow.gsd", "--frame-strain", "0.1"]
SMALL_RUN = "run --restitution 0.7 --packing-fraction 0.6 --grains 32 --timestep auto --strain 1"


@pytest.fixture
def no_figures(monkeypatch) -> None:
    """A map writes its dataset alone: drawing takes longer than all else that these tests do."""
    monkeypatch.setattr("jaxgran.plotting.map_figures.save_figures", lambda *_, **__: [])


# Lists


def restitutions(text: str) -> tuple[float, ...]:
    return options.parse("restitution", map_module.MAP_OPTIONS["restitution"], text)


@given(st.integers(0, 100), st.integers(0, 100), st.integers(2, 50))
def test_range_includes_both_ends_and_has_equal_gaps(start: int, stop: int, count: int) -> None:
    numbers = restitutions(f"{start / 100}:{stop / 100}:{count}")
    assert len(numbers) == count
    assert (numbers[0], numbers[-1]) == (start / 100, stop / 100)
    np.testing.assert_allclose(np.diff(numbers), (stop - start) / 100 / (count - 1), atol=2e-12)


def test_a_range_of_time_steps_has_equal_ratios() -> None:
    row = map_module.MAP_OPTIONS["timestep"]
    assert options.parse("timestep", row, "1e-5:1e-3:3") == (1e-5, 1e-4, 1e-3)
    with pytest.raises(typer.BadParameter, match="must be auto"):
        options.parse("timestep", row, "0:1e-3:3")


# Mistakes

FLOW = "run --restitution 0.5 --packing-fraction 0.6"
MISTAKES = {  # one for each kind of option, check and file
    "map --restitution 0.1:0.9:1": "'--restitution': must be a number or a list",
    "map --restitution 0.5:inf:3": "'--restitution': must be a number or a list",
    "map --scheduler 127.0.0.1": "--scheduler must be an address such as tcp://",
    f"{FLOW} --trajectory flow.gsd --output flow.nc --resume": "--movie exclude --resume",
    "map --grains auto": "--grains auto requires --error",
    f"{FLOW} --timestep abc": "'--timestep': must be auto or a number, not 'abc'",
    f"{FLOW} --seeds 1.5": "'--seeds': must be a whole number, not '1.5'",
    "map --preset fast": "'--preset': must be quick, paper or dense, not 'fast'",
    "map --scheduler tcp://127.0.0.1:9 --workers 2": "--scheduler and --workers exclude each other",
    "map --from-map text.nc": "not a NetCDF file",
    f"{FLOW} --frame-strain 1": "--frame-strain requires --trajectory or --movie",
    f"{FLOW} --trajectory flow.gsd --force-strain 1": "at most the strain between",
    f"{FLOW} --movie flow.gif --seeds 2": "show one flow of one seed: leave out --seeds",
    "where --restitution 0.5": "--restitution and --packing-fraction are required, or --law",
    "where --restitution 0.1:0.9:100000 --packing-fraction 0.7:0.8:1000": "pairs, not 100000000",
    "where --law text.nc": "--law must be a file name that ends in .csv",
    f"{FLOW} --resume": "--resume requires --output",
    "run --restitution 0.5": "Missing option '--packing-fraction'",
    "where --restitution 0.7 --packing-fraction 0.9": "must be between 0.1 and 0.83",
    "draw": "No such command 'draw'",
    "run --alpha 0.5": "No such option: --alpha (Possible options: --restitution)",
    "map --outptu map.nc": "No such option: --outptu (Possible options: --output)",
    "map --restitution 0.1 0.5 0.9": "unexpected extra argument(s) (0.5 0.9)",
}


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_one_sentence_and_leaves_nothing_behind(command: str, tmp_path: Path) -> None:
    (tmp_path / "text.nc").write_text("not a map")
    outcome = jaxgran(tmp_path, *command.split())
    assert_one_sentence(outcome)
    assert MISTAKES[command] in outcome.err
    assert files(tmp_path) == {"text.nc"}


@pytest.mark.parametrize(
    "command", ["map --grains auto", f"{FLOW} --timestep abc", "where --restitution 2"]
)
def test_a_mistake_is_an_object_where_json_is_asked_for(command: str, tmp_path: Path) -> None:
    outcome = jaxgran(tmp_path, *command.split(), "--json")
    error = parsed(outcome.out)["error"]["value"]
    assert one_sentence(error) and error in outcome.err and outcome.status == 2


# What the commands do


@pytest.fixture(scope="module")
def small_map(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    folder = tmp_path_factory.mktemp("map")
    return folder, jaxgran(folder, *SMALL_MAP.split())


def test_map_writes_a_dataset_and_its_figures(small_map, small_data) -> None:
    folder, _ = small_map
    assert files(folder) == {"small.nc", *PICTURES}
    for name in PICTURES:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    data = small_data
    np.testing.assert_array_equal(data.restitution, [0.5, 0.9])
    np.testing.assert_array_equal(data.packing_fraction, [0.5, 0.6])
    assert np.all(data.force_ratio >= 0.99)
    assert np.all(data["sums/equilibration_strain"] == 0.5)
    assert data.attrs["command"] == f"jaxgran {SMALL_MAP}"
    assert data.attrs["replica_steps_per_second"] > 0


@pytest.fixture(scope="module")
def small_data(small_map) -> xr.DataTree:
    return open_map(small_map[0] / "small.nc")


def test_map_prints_the_tables_and_the_progress_apart(small_map, small_data) -> None:
    (_, (_, out, err)), data = small_map, small_data
    pressure = data.pressure_large_system_ci95.sel(error_source="total")
    for values, halves in (
        (data.force_ratio, HALF_INTERVAL * data.force_ratio_stderr),
        (data.pressure_large_system, pressure),
    ):
        pairs = zip(values.values.flat, halves.values.flat, strict=True)
        assert all(in_brackets(float(x), float(half)) in out for x, half in pairs)
    off = abs(data["theory/pressure"] / data.pressure_large_system - 1)
    assert f"pressure of a large system at {int((off <= 0.1).sum())} of 4 points" in out
    assert "4/4 points" not in out and "4/4 points" in err and "wrote small.nc" in err


def test_map_prints_json_of_every_point(small_map, small_data) -> None:
    outcome = jaxgran(small_map[0], *SMALL_MAP.split(), "--resume", "--json")
    printed = parsed(outcome.out)
    for name in ("force_ratio", "pressure", "status"):
        assert np.shape(printed[name]["value"]) == (2, 2)
    np.testing.assert_array_equal(printed["pressure"]["value"], small_data.pressure)
    np.testing.assert_array_equal(
        printed["pressure_large_system"]["ci95"],
        small_data.pressure_large_system_ci95.sel(error_source="total"),
    )
    assert printed["timestep"]["unit"] == "1 / shear rate"
    assert {*np.ravel(printed["status"]["value"])} <= {*Status.__members__}


@pytest.mark.filterwarnings("always:differs from")
def test_a_map_is_repeated_from_its_file_and_other_versions_are_named(
    small_data, no_figures, tmp_path: Path, monkeypatch
) -> None:
    other, data = tmp_path / "other.nc", small_data.copy()
    write_few_variables(monkeypatch, "pressure")
    data.attrs["version_jax"] = "0.1.0"
    write_dataset(data, other)
    outcome = jaxgran(
        tmp_path, "map", "--from-map", "other.nc", "--workers", "1", "--output", "again.nc"
    )
    again = open_map(tmp_path / "again.nc")
    assert again.force_ratio.equals(data.force_ratio) and again.pressure.equals(data.pressure)
    assert (
        f"version jax 0.1.0 there, {again.attrs['version_jax']} here" in outcome.err.splitlines()[0]
    )
    assert {k: v for k, v in again.attrs.items() if k in SAME} == {
        k: v for k, v in data.attrs.items() if k in SAME
    }


def test_plot_makes_its_folder_and_writes_other_formats_without_caption(
    small_map, tmp_path: Path, monkeypatch
) -> None:
    figures = tmp_path / "new" / "figures"
    for name in FIGURES:
        monkeypatch.setitem(FIGURES, name, FIGURES[name]._replace(draw=lambda _: Figure()))
    words = ("--output", str(figures), "--format", "svg", "--no-caption")
    assert jaxgran(small_map[0], "plot", "small.nc", *words).status == 0
    assert files(figures) == {name.replace(".png", ".svg") for name in PICTURES}


@pytest.fixture(scope="module")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    folder = tmp_path_factory.mktemp("run")
    return folder, jaxgran(
        folder, *SMALL_RUN.split(), *FRAMES, *["--movie", "flow.gif", "--output", "flow.nc"]
    )


def test_run_writes_frames_as_a_trajectory_and_as_a_movie(small_run) -> None:
    folder, outcome = small_run
    assert outcome.status in (0, 3)
    assert files(folder) == {"flow.nc", "flow.gsd", "flow.gif"}
    strain = read_trajectory(folder / "flow.gsd").strain
    timestep = open_map(folder / "flow.nc").attrs["timestep"]
    np.testing.assert_allclose(strain, 0.1 * np.arange(11), atol=0.51 * timestep)
    with Image.open(folder / "flow.gif") as film:
        assert film.n_frames == 11


def test_a_disk_that_is_full_before_the_last_frame_leaves_the_trajectory_of_before(
    tmp_path: Path, monkeypatch
) -> None:
    """An interruption keeps the frames that are whole."""
    path, append = tmp_path / "flow.gsd", trajectory._append
    for error, status in ((OSError(errno.ENOSPC, "No space left"), 1), (KeyboardInterrupt(), 130)):

        def failing(file: Path, frame: Any, step: int, error=error) -> None:
            if step > 0:
                raise error
            append(file, frame, step)

        path.write_bytes(b"old")
        monkeypatch.setattr(trajectory, "_append", failing)
        outcome = jaxgran(tmp_path, *SMALL_RUN.split(), *FRAMES, "--overwrite")
        assert outcome.status == status and files(tmp_path) == {"flow.gsd"}
        assert (path.read_bytes() == b"old") == (status == 1)
    assert read_trajectory(path).step.tolist() == [0]


def parsed(text: str) -> dict[str, Any]:
    """The JSON that a command prints: one object, in which every name has the same keys."""
    entries = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert all(
        list(entry)[:5] == ["value", "stderr", "ci95", "unit", "meaning"]
        for entry in entries.values()
    )
    return entries


def test_run_prints_rows_of_physics_or_json_of_every_average(small_run) -> None:
    folder, _ = small_run
    command = (*SMALL_RUN.split(), "--output", "flow.nc", "--resume")
    table, as_json = (jaxgran(folder, *command, *more) for more in ((), ("--json",)))
    assert "shear-stress ratio" in table.out
    printed, data = parsed(as_json.out), flattened(open_map(folder / "flow.nc")).squeeze()
    rows = {line[2:14].strip(): line.split() for line in table.out.splitlines()}  # the last of each
    for row, name in (("pressure", "pressure"), ("local T", "granular_temperature")):
        assert f"{data[f'theory/{name}'].item():.3g}" in rows[row]
    for name, row in OBSERVABLES.items():
        entry = {key: np.array(printed[name][key], float) for key in ("value", "stderr")}
        np.testing.assert_array_equal(entry["value"], data[path_of(name)])  # null is NaN
        if row.group != "diagnostics":
            np.testing.assert_array_equal(entry["stderr"], data[f"{path_of(name)}_stderr"])
        assert printed[name]["unit"] == row.unit
    assert printed["status"]["value"] in Status.__members__ and printed["grains"]["value"] == 32
    assert as_json.status == table.status


@pytest.mark.skipif(os.name != "posix", reason="a pipe of another kind")
def test_a_reader_that_has_gone_ends_a_command_in_silence(tmp_path: Path) -> None:
    """As in ``jaxgran where ... | head -2``."""
    words = ("-m", "jaxgran", *["where", "--restitution", "0.5", "--packing-fraction", "0.6"])
    with subprocess.Popen(
        [sys.executable, *words], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == (b"", 1)


@pytest.mark.skipif(os.name != "posix", reason="a shell of another kind")
@pytest.mark.parametrize(
    "words", ["info", "where --restitution 0.5 --packing-fraction 0.6", SMALL_RUN]
)
def test_a_command_without_a_standard_output_ends_as_ever(words: str, tmp_path: Path) -> None:
    """As in ``jaxgran info >&-``."""
    command = ["sh", "-c", f'exec "$0" -m jaxgran {words} >&-', sys.executable]
    flags = {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    variables = os.environ | flags  # programs of other tests are loaded
    done = subprocess.run(command, cwd=tmp_path, env=variables, stderr=subprocess.PIPE, text=True)
    assert done.returncode in (0, 3) and "Traceback" not in done.stderr


def test_run_prints_a_column_for_each_number_of_grains(tmp_path: Path) -> None:
    words = "run --restitution 0.7 --packing-fraction 0.6 -n 32,64 --strain 1 --equilibrate 1"
    outcome = jaxgran(tmp_path, *words.split(), "--output", "flow.nc")
    data = flattened(open_map(tmp_path / "flow.nc")).squeeze()
    (row,) = (line for line in outcome.out.splitlines() if line.startswith("  collision rate"))
    for rate, error in zip(data.collision_rate, data.collision_rate_stderr, strict=True):
        assert with_error(rate.item(), error.item()) in row


def test_an_error_is_asked_for_in_place_of_a_strain(tmp_path: Path) -> None:
    words = "run --restitution 0.7 --packing-fraction 0.6 --grains 32 --error 0.1 --output flow.nc"
    outcome = jaxgran(tmp_path, *words.split())
    data = open_map(tmp_path / "flow.nc")
    assert data.attrs["error"] == 0.1
    for name in ("force_ratio", "pressure", "shear_stress"):
        assert np.all(1.96 * data[f"{name}_stderr"] <= 0.5 * 0.1 * data[name])
    assert (outcome.status, data.status.item()) == (3, Status.imprecise)  # 32 grains are too few
    assert data["sums/strain"].item() >= LEAST_SAMPLE
    assert "relative errors: 0.1 requested" in outcome.err


def test_info_names_versions_devices_and_folders(tmp_path: Path) -> None:
    outcome = in_a_process(tmp_path, "info")
    assert (outcome.status, outcome.err) == (0, "")
    rows = [line for line in outcome.out.splitlines() if "  " in line]
    lines = dict(re.split(r"\s{2,}", row, maxsplit=1) for row in rows)
    assert lines["precision"] == "float64" and lines["engine"] == "auto takes numba"
    assert lines["jaxgran"].startswith(version("jaxgran")) and str(usable_cores()) in lines["cores"]
    for name in ("cache folder", "compiled programs", "numba engine", "figures"):
        folder, _, state = lines[name].partition(", ")
        assert Path(folder).is_dir() and state == "works", name
    printed = parsed(jaxgran(tmp_path, "info", "--json").out)
    assert {name.replace(" ", "_") for name in lines} == set(printed)
    assert {"python", "jax", "jaxlib", "devices", "platform", "processor", "memory"} < set(printed)


def test_a_platform_that_is_not_there_is_one_sentence(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    info, refused = (in_a_process(tmp_path, command) for command in ("info", "map"))
    assert (info.status, info.err) == (0, "")
    assert "cuda" in next(line for line in info.out.splitlines() if line.startswith("devices"))
    assert_one_sentence(refused)
    assert "cuda" in refused.err


# Help


HELPS = {"": app.EXAMPLES, **{f"{name} ": shown for name, (*_, shown) in app.COMMANDS.items()}}


@pytest.mark.parametrize("command", HELPS)
def test_help_teaches_by_examples_that_are_accepted(command: str, tmp_path: Path) -> None:
    outcome = jaxgran(tmp_path, *command.split(), "--help")
    assert outcome.status == 0 and jaxgran(tmp_path, *command.split(), "-h") == outcome
    group = typer.main.get_command(app.app)
    assert HELPS[command]
    for example in HELPS[command].values():
        assert example.replace(" ", "") in outcome.out.replace(" ", "")
        first, name, *words = shlex.split(example)
        assert first == "jaxgran" and (
            "--help" in words or group.commands[name].make_context(name, list(words))
        )


def test_given_options_replace_what_a_file_chose_for_its_error() -> None:
    """Grains by point are those of the file's points; either a strain or an error holds."""
    chosen = {"restitution": (0.5,), "grains": 512, "grains_by_point": (512,), "error": 0.1}
    assert combined(chosen, {}) == chosen
    more = {"restitution": (0.2, 0.5)}
    assert combined(chosen, more) == more | {"grains": "auto", "error": 0.1}
    assert "grains_by_point" not in combined(chosen, {"grains": 256})
    assert combined({"part": "2/3"}, {"seeds": 2}) == {"part": "2/3", "seeds": 2}
    assert "part" not in combined({"part": "2/3"}, {"restitution": (0.5,)})
    assert combined(chosen, {"strain": 20.0}).keys() == chosen.keys() - {"error"} | {"strain"}
    given = {"error": 0.1, "grains": 400}
    assert combined({"strain": 4.0, "seeds": 4}, given) == given | {"timestep": "auto", "seeds": 1}


def test_seeds_and_the_choices_of_a_solve_reach_the_flow(tmp_path: Path, monkeypatch) -> None:
    asked = []

    def notes(settings, *_, **__) -> Iterator:
        asked.append(settings)
        for seed in range(settings.seeds):
            yield random_replica(np.random.default_rng(seed), settings, seed=seed)

    monkeypatch.setattr(ratio_map_module, "run_replicas", notes)
    words = "--seeds 2 --first-seed 7 --tolerance 1e-6 --solver jacobi --activation touching"
    assert jaxgran(tmp_path, *FLOW.split(), "--strain", "20", *words.split()).status == 0
    (one,) = asked
    assert (one.seeds, one.first_seed, one.activation) == (2, 7, "touching")
    assert one.solver == Jacobi(tolerance=1e-6)


def test_every_bad_status_is_named_with_its_point(no_figures, tmp_path: Path, monkeypatch) -> None:
    points = dict(enumerate(Status))
    monkeypatch.setattr("jaxgran.maps.results.write_dataset", lambda *_: None)
    made = made_up_replicas({(k, 0): status for k, status in points.items()})
    monkeypatch.setattr(ratio_map_module, "run_replicas", made)
    words = ("--restitution", f"0:0.9:{len(points)}", "--packing-fraction", "0.6", "--seeds", "1")
    outcome = jaxgran(tmp_path, "map", *words)
    assert outcome.status == 3
    for k, status in points.items():
        place = f"at (restitution {0.9 * k / (len(points) - 1):g}, packing fraction 0.6)"
        named = f"{status.name.replace('_', ' ')} {place}" in outcome.err
        assert named == (status != Status.ok), status
    assert outcome.out.count(" *") >= len(points) - 1


def test_interrupted_map_is_saved_and_says_how_to_go_on(tmp_path: Path, monkeypatch) -> None:
    write_few_variables(monkeypatch)
    monkeypatch.setattr(
        ratio_map_module, "run_replicas", made_up_replicas({(1, 0): Status.ok}, KeyboardInterrupt)
    )
    outcome = jaxgran(tmp_path, "map", *POINTS, "--seeds", "1", "--output", "half.nc")
    assert outcome.status == 130
    assert files(tmp_path) == {"half.nc", "half.nc.unfinished"}
    data = open_map(tmp_path / "half.nc")
    np.testing.assert_array_equal(data.status, [[NOT_RUN, Status.ok]])
    assert np.isnan(data.force_ratio[0, 0]) and np.isfinite(data.force_ratio[0, 1])
    command = "jaxgran map --restitution 0.5,0.9 --packing-fraction 0.6 --seeds 1 --output half.nc"
    assert "1 point missing; finished points are saved" in outcome.err
    assert outcome.err.rstrip().endswith(f"Continue: {command} --resume")


@pytest.mark.parametrize(
    "moment",
    ["maps.results.write_dataset", "plotting.map_figures.save_figures", "cli.map.print_map"],
)
def test_an_interruption_after_the_last_point_says_how_to_go_on(
    moment: str, tmp_path: Path, monkeypatch
) -> None:
    """While the dataset is written, while the figures are drawn, and while tables are printed."""
    write_few_variables(monkeypatch)
    done = {(0, 0): Status.ok, (1, 0): Status.ok}
    monkeypatch.setattr(ratio_map_module, "run_replicas", made_up_replicas(done))
    monkeypatch.setattr(f"jaxgran.{moment}", Mock(side_effect=KeyboardInterrupt))
    outcome = jaxgran(tmp_path, "map", *POINTS, "--seeds", "1", "--output", "done.nc")
    assert outcome.status == 130 and outcome.out == ""
    assert "jaxgran: interrupted; finished points are saved. Continue: jaxgran map" in outcome.err
    assert outcome.err.rstrip().endswith("--output done.nc --resume")


def test_a_flow_interrupted_before_it_has_a_value_prints_one_sentence(
    tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(ratio_map_module, "run_replicas", made_up_replicas({}, KeyboardInterrupt))
    flow = (*FLOW.split(), "--quiet", "--output", "flow.nc")
    outcome, as_json = jaxgran(tmp_path, *flow), jaxgran(tmp_path, *flow, "--json")
    said = "jaxgran: interrupted; nothing is saved.\n"
    assert outcome == (130, "", said)
    assert (as_json.status, as_json.err) == (130, said)
    assert parsed(as_json.out)["force_ratio"]["value"] is None
    assert not files(tmp_path)


def test_an_interruption_after_the_result_adds_nothing_to_its_json(
    tmp_path: Path, monkeypatch
) -> None:
    done = made_up_replicas({(0, 0): Status.ok})
    monkeypatch.setattr(ratio_map_module, "run_replicas", done)
    monkeypatch.setattr("jaxgran.cli.run.finish", Mock(side_effect=KeyboardInterrupt))
    outcome = jaxgran(tmp_path, *FLOW.split(), "--json")
    assert outcome.status == 130 and "error" not in parsed(outcome.out)


def test_a_recording_touches_no_frames_but_its_own(tmp_path: Path) -> None:
    trajectory, own = tmp_path / "flow.gsd", tmp_path / "flow.gsd.unfinished-1"
    of_another = tmp_path / "flow.gsd.unfinished-2"
    of_another.write_bytes(b"frames of another")
    recorded = {"trajectory": trajectory, "unfinished": own}
    with pytest.raises(OSError), _complete_at_the_end(recorded, overwrite=False):
        own.write_bytes(b"frames")
        raise OSError
    assert files(tmp_path) == {of_another.name}
    with _complete_at_the_end(recorded, overwrite=False):
        own.write_bytes(b"frames")
        trajectory.write_bytes(b"written meanwhile")
    assert recorded.pop("trajectory") == own
    assert trajectory.read_bytes() == b"written meanwhile" and own.read_bytes() == b"frames"
    with _complete_at_the_end(recorded | {"trajectory": trajectory}, overwrite=True):
        pass
    assert trajectory.read_bytes() == b"frames" and not own.exists()
    assert of_another.read_bytes() == b"frames of another"


def test_an_interruption_inside_compiled_code_is_one(tmp_path: Path, monkeypatch) -> None:
    """Python functions that C calls back end in a SystemError, whose cause is Ctrl-C."""

    class Inside(SystemError):
        __cause__ = KeyboardInterrupt()

    made = made_up_replicas({(1, 0): Status.ok}, Inside)
    monkeypatch.setattr(ratio_map_module, "run_replicas", made)
    outcome = jaxgran(tmp_path, "map", *POINTS, "--seeds", "1", "--output", "half.nc")
    assert outcome.status == 130 and outcome.err.rstrip().endswith("--output half.nc --resume")
    monkeypatch.setattr("jaxgran.maps.results.open_map", Mock(side_effect=SystemError))
    with pytest.raises(SystemError):
        jaxgran(tmp_path, "plot", "half.nc")
