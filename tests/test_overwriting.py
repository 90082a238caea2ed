"""Nothing that took time is replaced: it is refused in a sentence, until --overwrite."""

import os
from pathlib import Path

import pytest
from command_line import (
    POINTS,
    assert_one_sentence,
    files,
    jaxgran,
    made_up_replicas,
    write_few_variables,
)
from drawn import write_without_drawing

from jaxgran.maps import ratio_map as ratio_map_module
from jaxgran.maps.results import open_map
from jaxgran.model.status import Status
from jaxgran.plotting.theory import CLUSTERS
from jaxgran.sampling.budget import LARGE_SYSTEM

MAP = ("map", *POINTS, "--seeds", "1")
BOTH = {(0, 0): Status.ok, (1, 0): Status.ok}


@pytest.fixture(autouse=True)
def made_up(monkeypatch) -> None:
    """Maps of made-up replicas, whose pictures are files of a few bytes.

    Their own files have what is printed and what decides which pictures there are.
    """
    write_without_drawing(monkeypatch)
    write_few_variables(monkeypatch, *LARGE_SYSTEM, *CLUSTERS)
    monkeypatch.setattr(ratio_map_module, "run_replicas", made_up_replicas(BOTH))


@pytest.fixture
def finished(made_up, tmp_path: Path) -> bytes:
    """The content of a finished map, jaxgran_map.nc."""
    assert jaxgran(tmp_path, *MAP).status == 0
    return (tmp_path / "jaxgran_map.nc").read_bytes()


def test_a_map_of_other_parameters_is_refused_and_the_first_of_them_named(
    finished: bytes, tmp_path: Path
) -> None:
    for name in ("timestep", "notes"):  # a picture of an earlier map, and one of the user's
        (tmp_path / f"jaxgran_map_{name}.png").touch()
    before = files(tmp_path)
    outcome = jaxgran(tmp_path, *MAP, "--strain", "9", "--grains", "64")
    assert_one_sentence(outcome)
    assert "--output 'jaxgran_map.nc' already exists and has a map with grains 256" in outcome.err
    assert (tmp_path / "jaxgran_map.nc").read_bytes() == finished and files(tmp_path) == before
    assert jaxgran(tmp_path, *MAP, "--grains", "64", "--overwrite").status == 0
    assert open_map(tmp_path / "jaxgran_map.nc").attrs["grains"] == 64
    assert before - files(tmp_path) == {"jaxgran_map_timestep.png"}


def test_what_is_no_map_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "jaxgran_map.nc").write_bytes(b"years of work")
    outcome = jaxgran(tmp_path, *MAP)
    assert_one_sentence(outcome)
    assert (tmp_path / "jaxgran_map.nc").read_bytes() == b"years of work"


def test_a_finished_map_is_taken_from_its_file_by_resume(
    finished: bytes, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(ratio_map_module, "run_replicas", None)  # nothing is run
    (tmp_path / "jaxgran_map_curves.png").unlink()
    outcome = jaxgran(tmp_path, *MAP, "--resume")
    assert outcome.status == 0 and "Force ratio" in outcome.out
    assert "jaxgran_map.nc is finished and is read from its file." in outcome.err
    assert "wrote jaxgran_map_curves.png" in outcome.err
    assert "wrote jaxgran_map.nc" not in outcome.err
    assert (tmp_path / "jaxgran_map.nc").read_bytes() == finished


def test_a_finished_map_of_other_code_is_not_taken_for_one_of_this(
    finished: bytes, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("jaxgran.maps.provenance.sources_digest", lambda: "other")
    assert_one_sentence(other := jaxgran(tmp_path, *MAP, "--resume"))
    assert "--output 'jaxgran_map.nc' was made with jaxgran 0" in other.err
    assert "it has code_digest " in other.err and "not 'other'" in other.err
    assert (tmp_path / "jaxgran_map.nc").read_bytes() == finished
    told = jaxgran(tmp_path, *MAP, "--resume", "--overwrite")
    assert told.status == 0 and "wrote jaxgran_map.nc" in told.err


def test_figures_are_those_of_the_data_that_a_command_wrote(tmp_path: Path, monkeypatch) -> None:
    half = made_up_replicas({(0, 0): Status.ok}, KeyboardInterrupt)
    with monkeypatch.context() as patch:
        patch.setattr(ratio_map_module, "run_replicas", half)
        assert jaxgran(tmp_path, *MAP).status == 130
    png, pdf = tmp_path / "jaxgran_map_curves.png", tmp_path / "jaxgran_map_curves.pdf"
    for picture in (png, pdf):
        picture.write_bytes(b"of the half")
    resumed = jaxgran(tmp_path, *MAP, "--resume")
    assert resumed.status == 0 and f"{pdf.name} shows the map as it was" in resumed.err
    assert png.read_bytes() != b"of the half" == pdf.read_bytes()


def test_figures_that_are_older_than_the_map_are_drawn_again(
    finished: bytes, tmp_path: Path
) -> None:
    """As after an interruption between the file and its figures."""
    curves = tmp_path / "jaxgran_map_curves.png"
    curves.write_bytes(b"an old figure")
    os.utime(curves, (0, 0))
    assert jaxgran(tmp_path, *MAP, "--resume").status == 0
    assert curves.read_bytes() != b"an old figure"
    assert not (tmp_path / "jaxgran_map_timestep.png").exists()  # the map has one time step
    curves.write_bytes(b"a newer figure")
    assert jaxgran(tmp_path, *MAP, "--resume").status == 0
    assert curves.read_bytes() == b"a newer figure"


def test_an_interrupted_map_does_not_replace_a_finished_one(
    finished: bytes, tmp_path: Path, monkeypatch
) -> None:
    half = made_up_replicas({(0, 0): Status.ok}, KeyboardInterrupt)
    monkeypatch.setattr(ratio_map_module, "run_replicas", half)
    outcome = jaxgran(tmp_path, *MAP, "--grains", "64", "--overwrite")
    assert outcome.status == 130
    assert "1 point missing; finished points are saved" in outcome.err
    assert (tmp_path / "jaxgran_map.nc").read_bytes() == finished
    assert len(list((tmp_path / "jaxgran_map.nc.unfinished").glob("replica-*.npz"))) == 1


def test_plot_and_a_map_without_overwrite_remove_nothing(finished: bytes, tmp_path: Path) -> None:
    names = ("jaxgran_map_timestep.pdf", "other_theory.pdf", "other_theory.svg")
    for name in names:  # none of which is a picture of these maps
        (tmp_path / name).write_bytes(b"by hand")
    assert jaxgran(tmp_path, "plot", "jaxgran_map.nc", "--format", "pdf").status == 0
    assert jaxgran(tmp_path, *MAP, "--output", "other.nc").status == 0
    assert jaxgran(tmp_path, *MAP, "--resume").status == 0  # the same map once more
    assert {(tmp_path / name).read_bytes() for name in names} == {b"by hand"}


@pytest.mark.parametrize("command", [MAP, ("merge", "jaxgran_map.nc")], ids=["map", "merge"])
def test_a_new_map_replaces_no_file_by_a_figure(
    finished: bytes, command: tuple[str, ...], tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("jaxgran.maps.merge.merge_maps", lambda paths: open_map(paths[0]))
    picture = tmp_path / "ratio_theory.png"
    picture.write_bytes(b"by hand")
    before = files(tmp_path)
    outcome = jaxgran(tmp_path, *command, "--output", "ratio.nc")
    assert_one_sentence(outcome)
    assert "the figure 'ratio_theory.png' already exists; name another output" in outcome.err
    assert files(tmp_path) == before
    assert jaxgran(tmp_path, *command, "--output", "ratio.nc", "--overwrite").status == 0
    assert picture.read_bytes() == b"by hand"  # a line of points has no such figure


def test_a_page_replaces_no_file(finished: bytes, tmp_path: Path) -> None:
    page = tmp_path / "jaxgran_map.html"
    page.write_bytes(b"notes")
    outcome = jaxgran(tmp_path, "explore", "jaxgran_map.nc")
    assert_one_sentence(outcome)
    assert "--output 'jaxgran_map.html' already exists; name another file" in outcome.err
    assert page.read_bytes() == b"notes"
    assert jaxgran(tmp_path, "explore", "jaxgran_map.nc", "--overwrite").status == 0
    assert page.read_bytes() != b"notes"


RUN = "run --restitution 0.5 --packing-fraction 0.6 --grains 32 --output flow.nc"


@pytest.mark.parametrize("option", ["trajectory", "movie"])
def test_frames_are_not_replaced(option: str, tmp_path: Path) -> None:
    file = tmp_path / ("flow.gsd" if option == "trajectory" else "flow.gif")
    file.write_bytes(b"frames")
    outcome = jaxgran(tmp_path, *RUN.split(), f"--{option}", file.name)
    assert_one_sentence(outcome)
    assert f"--{option} {file.name!r} already exists; name another file" in outcome.err
    assert files(tmp_path) == {file.name}
