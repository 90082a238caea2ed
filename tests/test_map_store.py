"""The store of a map gives back what was kept, and tells what is damaged or foreign."""

import errno
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from flows import assert_same_bits
from synthetic import random_replica, refused

from jaxgran import files
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.engine import Jax
from jaxgran.maps import provenance, store
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.replica import Replica, ReplicaId
from jaxgran.maps.results import write_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.store import Store
from jaxgran.model.status import Status

LOOSE = BarzilaiBorwein(tolerance=1e-3)
SETTINGS = MapSettings((0.5, 0.9), (0.5, 0.6), grains=64, seeds=2, strain=2.0)


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "map.nc"


def opened(output: Path, settings: MapSettings = SETTINGS, resume=True, overwrite=False) -> Store:
    return Store(output, settings, resume, overwrite)


def some() -> list[Replica]:
    """Two seeds of packing fraction and restitution (0.5, 0.5), (0.5, 0.9) and (0.6, 0.5)."""
    rng = np.random.default_rng(0)
    return [
        random_replica(rng, SETTINGS, Status.not_steady if point == 1 else 0, point, seed)
        for point in range(3)
        for seed in range(2)
    ]


def cut_off(output: Path) -> dict[ReplicaId, Replica]:
    """A run that keeps three points of four and ends without having finished."""
    run = opened(output, resume=False)
    for replica in some():
        run.add(replica)
    run.close()
    return run.replicas


def finished(output: Path) -> list[Replica]:
    """A file with all replicas of the map."""
    rng = np.random.default_rng(0)
    keys = [(point, seed) for point in range(4) for seed in range(2)]
    replicas = [random_replica(rng, SETTINGS, Status.ok, *key) for key in keys]
    write_dataset(map_dataset(SETTINGS, replicas, {}), output)
    return replicas


def test_what_is_kept_comes_back_bit_for_bit(output: Path) -> None:
    kept = cut_off(output)
    resumed = opened(output)
    assert_same_bits(resumed.replicas, kept)
    assert resumed.damaged == [] and resumed.finished is None
    rng = np.random.default_rng(1)
    for seed in range(2):
        resumed.add(random_replica(rng, SETTINGS, 0, 3, seed))
    resumed.close(written=True)
    assert list(output.parent.iterdir()) == []


def test_an_unfinished_map_is_never_overwritten(output: Path) -> None:
    cut_off(output)
    for overwrite in (False, True):
        with refused("to continue it"):
            opened(output, resume=False, overwrite=overwrite)
    opened(output).close()


MORE = {
    "seeds": {"seeds": 3},
    "restitution": {"restitution": (0.5, 0.7, 0.9)},
    "grains": {"grains": (64, 128)},
    "timestep": {"timestep": (1e-3, 5e-4)},
}


@pytest.mark.parametrize("name", MORE)
def test_a_finished_map_is_extended_by_what_is_missing(name: str, output: Path) -> None:
    written = finished(output)
    whole = opened(output)
    whole.close()
    assert whole.finished is not None
    with refused("already exists and has a map with .* pass `resume=True` to extend it"):
        opened(output, replace(SETTINGS, **MORE[name]), resume=False)
    extended = opened(output, replace(SETTINGS, **MORE[name]))
    extended.close()
    assert_same_bits(extended.replicas, {replica.id: replica for replica in written})
    assert extended.finished is None
    with refused("which this one lacks"):  # fewer points would lose some
        opened(output, replace(SETTINGS, packing_fraction=(0.6,)))
    assert list(output.parent.iterdir()) == [output]
    fewer = opened(output, replace(SETTINGS, packing_fraction=(0.6,)), overwrite=True)
    fewer.close()
    assert len(fewer.replicas) == 4


@pytest.mark.parametrize("change", [{"solver": LOOSE}, {"strain": 2.5}, {"engine": Jax()}])
def test_another_map_is_refused_and_the_difference_named(output: Path, change: dict) -> None:
    cut_off(output)
    with refused(f"has {next(iter(change))} "):
        opened(output, replace(SETTINGS, **change))


def test_a_map_begun_on_the_processor_continues_there_beside_an_accelerator(
    output: Path, monkeypatch
) -> None:
    cut_off(output)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_device(jax.devices("cpu")[0]):
        opened(output).close()


DAMAGE = {
    "torn": lambda whole: whole[: len(whole) // 2],
    "flipped": lambda whole: whole[:-64] + bytes(255 - x for x in whole[-64:]),
    "empty": lambda _: b"",
}


@pytest.mark.parametrize("how", DAMAGE)
def test_damaged_settings_are_one_sentence_and_a_damaged_replica_is_removed(
    output: Path, how: str
) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    replicas, about = [*folder.glob("replica-*-0.npz")], folder / "settings.json"
    for file in replicas:
        file.write_bytes(DAMAGE[how](file.read_bytes()))
    resumed = opened(output)
    assert {replica.seed for replica in resumed.replicas} == {1}
    assert sorted(resumed.damaged) == sorted(path.name for path in replicas)
    assert not any(path.exists() for path in replicas)
    resumed.close()
    about.write_bytes(DAMAGE[how](about.read_bytes()))
    with refused("damaged: remove the folder"):
        opened(output)


def test_a_map_continues_with_other_axes_and_seeds_and_keeps_what_it_does_not_need(
    output: Path,
) -> None:
    kept = cut_off(output)
    change = {"packing_fraction": (0.6,), "restitution": (0.5,), "seeds": 1, "first_seed": 1}
    resumed = opened(output, replace(SETTINGS, **change))
    (name,) = resumed.replicas
    assert_same_bits(resumed.replicas, {name: kept[name]})
    resumed.close(written=True)
    again = opened(output)
    assert_same_bits(again.replicas, {key: x for key, x in kept.items() if key != name})
    again.close()


def test_with_an_error_the_number_of_seeds_is_that_of_the_unfinished_map(output: Path) -> None:
    settings = replace(SETTINGS, strain=None, error=0.1)
    run = opened(output, settings, resume=False)
    run.add(some()[0])
    run.close()
    opened(output, replace(settings, restitution=(0.5,))).close()
    run = opened(output, settings, resume=True)
    run.add(some()[2])
    run.close()
    with refused("has seeds 2, not 3"):
        opened(output, replace(settings, seeds=3))


def test_a_map_of_other_sources_is_not_continued(output: Path, monkeypatch) -> None:
    cut_off(output)
    monkeypatch.setattr("jaxgran.maps.provenance.sources_digest", lambda: "other")
    with refused("has code_digest "):
        opened(output)


def test_a_map_of_another_version_names_it_and_its_commit_and_not_to_remove_it(
    output: Path, monkeypatch
) -> None:
    older = provenance.made_with() | {"version_jaxgran": "0.1.0", "commit": "abc1234"}
    with monkeypatch.context() as patch:
        patch.setattr(store, "made_with", lambda: older)
        cut_off(output)
    with refused("was begun by jaxgran 0.1.0, commit abc1234, and this is") as caught:
        opened(output)
    assert "resume it there" in str(caught.value) and "remove" not in str(caught.value)


def test_workers_with_another_working_folder_find_the_blocks(output: Path, monkeypatch) -> None:
    monkeypatch.chdir(output.parent)
    run = opened(Path(output.name), resume=False)
    assert run.blocks_path([some()[0].id]).parent == output.with_name("map.nc.unfinished")
    run.close()


def test_what_was_being_written_when_a_process_was_killed_is_tidied_up(output: Path) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    litters = [
        folder / ".replica-0123456789abcdef.npz",
        folder / ".settings-0123456789abcdef.json",
        output.with_name(".map-0123456789abcdef.nc"),
    ]
    for litter in litters:
        litter.write_bytes(b"half")
    other = output.with_name(".map-of-mine.nc")
    other.write_bytes(b"")
    opened(output).close()
    assert not any(litter.exists() for litter in litters) and other.exists()


def test_what_is_not_of_the_map_is_left_alone(output: Path) -> None:
    folder, kept = output.with_name("map.nc.unfinished"), finished(output)
    output.unlink()
    run = opened(output, resume=False)
    for replica in kept:
        run.add(replica)
    (folder / "notes.txt").write_text("mine")
    output.write_bytes(b"of another process")
    data = map_dataset(SETTINGS, kept, {})
    with refused("another process wrote meanwhile; this map is written to"):
        run.write(data, interrupted=False)
    run.close()
    assert output.read_bytes() == b"of another process"
    assert len([*output.parent.glob("map-*.nc")]) == 1
    output.unlink()
    again = opened(output)
    again.write(data, interrupted=False)
    again.close(written=True)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_replicas_without_settings_are_refused_and_not_removed(output: Path) -> None:
    cut_off(output)
    folder = output.with_name("map.nc.unfinished")
    (folder / "settings.json").unlink()
    with refused("has replicas, and no settings.json"):
        opened(output)
    assert len(list(folder.glob("replica-*.npz"))) == 6


def test_a_map_that_cannot_be_extended_names_what_is_in_the_way(output: Path) -> None:
    finished(output)
    with refused("solver '.*tolerance"):
        opened(output, replace(SETTINGS, restitution=(0.5, 0.7, 0.9), solver=LOOSE))


def test_a_file_system_without_locks_is_no_obstacle(output: Path, monkeypatch) -> None:
    def no_locks(*_) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(files.fcntl, "flock", no_locks)
    kept = cut_off(output)
    monkeypatch.setattr(files, "fcntl", None)
    resumed = opened(output)
    assert_same_bits(resumed.replicas, kept)
    resumed.close()
