"""Tracks are the same from every file that can hold them; what is no such file is one sentence, and exit status 2."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gsd.hoomd
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from command_line import assert_one_sentence, jaxgran
from observed import FRAMES, GRAINS, RESTITUTION, noisy, tracks

from jaxgran.inference.restitution import fit_restitution
from jaxgran.io.track_files import read_tracks
from jaxgran.io.tracks import Tracks, nearest_image, tracks_of_states
from jaxgran.io.trajectory import write_trajectory
from jaxgran.model.cell import cell_side
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State

INTERVAL = float(np.diff(tracks().time).mean())


def rows_of(seen: Tracks) -> pd.DataFrame:
    """One row for each disc in each frame in which it is seen; ids are no numbers of places."""
    frame, grain = np.indices(seen.positions.shape[:2])
    columns = {
        "frame": 3 * frame + 7,  # a camera that was read out every third time
        "id": 100 + 2 * grain,
        "x": seen.positions[..., 0],
        "y": seen.positions[..., 1],
        "vx": seen.velocities[..., 0],
        "vy": seen.velocities[..., 1],
        "diameter": np.broadcast_to(seen.diameters, frame.shape),
    }
    rows = pd.DataFrame({name: column.ravel() for name, column in columns.items()}).dropna()
    return rows.sample(frac=1, random_state=0)  # in any order


def peculiar(seen: Tracks) -> Tracks:
    velocities = seen.velocities.copy()
    velocities[..., 0] -= seen.shear_rate * seen.positions[..., 1]
    return replace(seen, velocities=velocities)


def write_csv(path: Path, seen: Tracks) -> None:
    rows_of(seen).to_csv(path, index=False)


def write_spaces(path: Path, seen: Tracks) -> None:
    rows = rows_of(seen)
    radii = rows.assign(Radius=rows.diameter / 2, Particle=rows.id).drop(columns=["diameter", "id"])
    path.write_text("# tracked by hand\n" + radii.to_csv(index=False, sep=" "))


def write_fields(path: Path, seen: Tracks) -> None:
    with h5py.File(path, "w") as file:
        file["tracks"] = rows_of(seen).to_records(index=False)


def write_datasets(path: Path, seen: Tracks) -> None:
    with h5py.File(path, "w") as file:
        for name, column in rows_of(seen).items():
            file[f"discs/{name}"] = column.to_numpy()


def write_dump(path: Path, seen: Tracks, scaled: bool = False) -> None:
    """As LAMMPS writes it, with bounds that hold the tilted cell."""
    with path.open("w") as file:
        for k in range(len(seen.time)):
            width, height, offset = seen.cell[k]
            here = np.isfinite(seen.positions[k, :, 0])
            file.write(f"ITEM: TIMESTEP\n{500 * k}\nITEM: NUMBER OF ATOMS\n{here.sum()}\n")
            file.write("ITEM: BOX BOUNDS xy xz yz pp pp pp\n")
            file.write(
                f"{min(0, offset):.9f} {width + max(0, offset):.9f} {offset:.9f}\n0 {height:.9f} 0\n-0.5 0.5 0\n"
            )
            kind = ("xs", "ys", "zs") if scaled else ("x", "y", "z")
            file.write(f"ITEM: ATOMS id type {' '.join(kind)} vx vy radius\n")
            for grain in np.flatnonzero(here)[::-1]:
                (x, y), (u, v) = seen.positions[k, grain], seen.velocities[k, grain]
                if scaled:
                    x, y = (x - offset * y / height) / width, y / height
                file.write(f"{grain + 1} 1 {x:.9f} {y:.9f} 0 {u:.9f} {v:.9f} {seen.diameters[grain] / 2:.9f}\n")


def write_gsd(path: Path, seen: Tracks, three: bool = True, flat: bool = True) -> None:
    """As HOOMD-blue writes it: single precision, types, a box of three dimensions, no logs."""
    with gsd.hoomd.open(path, "w") as file:
        for k in range(len(seen.time)):
            width, height, offset = seen.cell[k]
            frame = gsd.hoomd.Frame()
            frame.configuration.step = 100 * k
            frame.configuration.dimensions = 3 if three else 2
            frame.configuration.box = [width, height, 1 if three else 0, offset / height, 0, 0]
            frame.particles.N = GRAINS
            frame.particles.types = ["A", "B"]
            frame.particles.typeid = np.arange(GRAINS) % 2
            y = seen.positions[k, :, 1] - height / 2
            x = seen.positions[k, :, 0] - width / 2
            z = np.zeros(GRAINS) if flat else np.linspace(-0.5, 0.5, GRAINS)
            frame.particles.position = np.stack([x, y, z], axis=-1)
            frame.particles.velocity = np.pad(seen.velocities[k], ((0, 0), (0, 1)))
            frame.particles.diameter = seen.diameters
            file.append(frame)


WRITERS = {
    "discs.csv": write_csv,
    "discs.txt": write_spaces,
    "fields.h5": write_fields,
    "datasets.hdf5": write_datasets,
    "dump.lammpstrj": write_dump,
    "scaled.dump": lambda path, seen: write_dump(path, seen, scaled=True),
    "hoomd.gsd": write_gsd,
}


FITTED = {"discs.csv", "hoomd.gsd"}  # with missing discs, and in single precision; the others have the same numbers


@pytest.mark.parametrize("name", WRITERS)
def test_tracks_are_the_same_from_every_file(name: str, tmp_path: Path) -> None:
    seen = tracks() if name.endswith("gsd") else noisy(tracks(), 0.0, 0.0, missing=0.1)
    WRITERS[name](tmp_path / name, seen)
    read = read_tracks(tmp_path / name, interval=INTERVAL)
    rounding = 1e-5 if name.endswith("gsd") else 1e-8
    np.testing.assert_allclose(read.time - read.time[0], seen.time - seen.time[0], rtol=1e-9)
    np.testing.assert_allclose(read.diameters, seen.diameters, rtol=rounding)
    np.testing.assert_allclose(read.velocities, seen.velocities, rtol=0, atol=10 * rounding)
    apart = np.diff(read.positions, axis=1) - np.diff(seen.positions, axis=1)
    apart = nearest_image(apart, read.cell[:, None])
    np.testing.assert_allclose(apart, np.where(np.isnan(apart), np.nan, 0), rtol=0, atol=10 * rounding)
    if np.isfinite(read.cell).all():
        np.testing.assert_allclose(read.cell, seen.cell, rtol=0, atol=rounding)
        assert read.shear_rate == pytest.approx(1.0, rel=1e-4)
    if name in FITTED:
        fit = fit_restitution(read)  # which finds out how masses go with diameters
        assert abs(fit.restitution - RESTITUTION) < max(4 * fit.stderr, 1e-4) and fit.collisions > 15


def same_tracks(path: Path, rows: pd.DataFrame, **options) -> None:
    rows[["frame", "id", "x", "y", "diameter"]].to_csv(path.with_name("plain.csv"), index=False)
    plain, read = read_tracks(path.with_name("plain.csv")), read_tracks(path, **options)
    for name in ("time", "diameters", "masses", "positions"):
        np.testing.assert_array_equal(getattr(read, name), getattr(plain, name))


UNITS = {"x": "x [mm]", "y": "Y (mm)"}
SPREADSHEETS = {
    "decimal commas": lambda rows, path: rows.to_csv(path, index=False, sep=";", decimal=","),
    "units": lambda rows, path: rows.rename(columns=UNITS).to_csv(path, index=False),
    "both": lambda rows, path: rows.rename(columns=UNITS).to_csv(path, index=False, sep=";", decimal=","),
}


@pytest.mark.parametrize("kind", SPREADSHEETS)
def test_spreadsheets_with_decimal_commas_or_units_behind_the_names_are_read(kind: str, tmp_path: Path) -> None:
    rows = rows_of(tracks()).drop(columns=["vx", "vy"])
    SPREADSHEETS[kind](rows, tmp_path / "discs.csv")
    same_tracks(tmp_path / "discs.csv", rows)


def test_the_brightness_that_trackpy_calls_mass_is_no_mass(tmp_path: Path) -> None:
    """Its columns, of which mass, size, ecc, signal, raw_mass and ep say how a disc looks."""
    rows = rows_of(tracks()).rename(columns={"id": "particle"})
    brightness = np.random.default_rng(0).uniform(100, 900, len(rows))
    looks = {"mass": brightness, "size": 2.1, "ecc": 0.1, "signal": 9.0, "raw_mass": 2 * brightness, "ep": 0.01}
    rows[["y", "x", "frame", "particle", "diameter"]].assign(**looks).to_csv(tmp_path / "discs.csv")
    same_tracks(tmp_path / "discs.csv", rows.rename(columns={"particle": "id"}))
    rows.assign(mass=rows.diameter**2).to_csv(tmp_path / "weighed.csv")
    np.testing.assert_allclose(read_tracks(tmp_path / "weighed.csv").masses, tracks().diameters ** 2)


def test_frames_are_left_out(tmp_path: Path) -> None:
    write_dump(tmp_path / "flow.dump", tracks())
    every, third = read_tracks(tmp_path / "flow.dump"), read_tracks(tmp_path / "flow.dump", stride=3)
    np.testing.assert_array_equal(third.positions, every.positions[::3])
    np.testing.assert_array_equal(third.time, every.time[::3])
    with pytest.raises(InputError, match=r"stride must be less than .*, 60 in 'flow\.dump', not 60"):
        read_tracks(tmp_path / "flow.dump", stride=60)


def test_time_between_frames_is_that_of_the_displacements(tmp_path: Path) -> None:
    """Those of discs that do not collide in between, so that the time of exact tracks is exact."""
    for seen, precision in ((tracks(), 1e-6), (noisy(tracks(), 1e-5, 0.01), 2e-3)):
        write_dump(tmp_path / "flow.dump", seen)
        read = read_tracks(tmp_path / "flow.dump")
        np.testing.assert_allclose(np.diff(read.time), INTERVAL, rtol=precision)
        assert read.shear_rate == pytest.approx(1.0, rel=2 * precision)


def test_peculiar_velocities_are_those_of_the_laboratory_without_the_shear(tmp_path: Path) -> None:
    write_dump(tmp_path / "flow.dump", peculiar(tracks()))
    read = read_tracks(tmp_path / "flow.dump", peculiar=True, shear_rate=1.0, interval=INTERVAL)
    np.testing.assert_allclose(read.velocities, tracks().velocities, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ["discs.csv", "hoomd.gsd"])
def test_velocities_without_the_shear_are_taken_as_peculiar_with_a_word_about_it(name: str, tmp_path: Path) -> None:
    """At the rate of the tilting cell, or at that by which the displacements exceed the velocities."""
    WRITERS[name](tmp_path / name, peculiar(tracks()))
    with pytest.warns(UserWarning, match="lack the shear of the displacements, of rate .* taken as peculiar"):
        read = read_tracks(tmp_path / name, interval=INTERVAL)
    assert read.shear_rate == pytest.approx(1.0, rel=1e-3)
    fit = fit_restitution(read)
    assert abs(fit.restitution - RESTITUTION) < 1e-3
    with pytest.raises(InputError, match=r"shear of rate .*, and its shear rate is 2: "):
        read_tracks(tmp_path / name, interval=INTERVAL, shear_rate=2.0)


def test_recorded_strain_is_the_clock_of_positions_alone(tmp_path: Path) -> None:
    """A file may hold a strain without the states and parameters of jaxgran; frames may be missing."""
    seen = tracks()
    unobserved = replace(seen, velocities=np.full_like(seen.velocities, np.nan))
    write_gsd(tmp_path / "hoomd.gsd", unobserved)
    with gsd.hoomd.open(tmp_path / "hoomd.gsd") as file, gsd.hoomd.open(tmp_path / "strain.gsd", "w") as strained:
        for time, frame in zip(seen.time, file, strict=True):
            frame.log = {"jaxgran/strain": np.array([time])}
            strained.append(frame)
    read, without_clock = (read_tracks(tmp_path / name) for name in ("strain.gsd", "hoomd.gsd"))
    np.testing.assert_allclose(read.time, seen.time)
    assert np.isnan(read.velocities).all() and read.shear_rate == pytest.approx(1.0, rel=1e-3)
    assert fit_restitution(read).restitution == pytest.approx(fit_restitution(without_clock).restitution, abs=1e-6)
    outcome = jaxgran(tmp_path, "fit", "strain.gsd")
    assert outcome.status == 0 and "recorded" not in outcome.out


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_states_are_tracks_and_so_is_their_file(dtype: type, tmp_path: Path) -> None:
    """In single precision too, which a fit in double precision once refused."""
    seen = peculiar(tracks())
    grains = Grains(*(jnp.asarray(x, dtype) for x in (seen.diameters / 2, seen.masses)))
    flow = ShearFlow(GRAINS, RESTITUTION, 0.5, 1e-4)
    side = cell_side(grains.radii, 0.5)
    parts = (seen.positions, seen.velocities, np.full(FRAMES, side), seen.cell[:, 2] / seen.cell[:, 0])
    frames = jax.tree.map(lambda x: jnp.broadcast_to(x, (FRAMES, *x.shape)), grains)
    states = State(frames, *(jnp.asarray(x, dtype) for x in parts))
    found = tracks_of_states(seen.time, states)
    np.testing.assert_allclose(found.velocities, tracks().velocities, rtol=0, atol=1e-4)
    fit = fit_restitution(found)
    assert abs(fit.restitution - RESTITUTION) < 1e-3
    write_trajectory(tmp_path / "flow.gsd", flow, states, np.round(seen.time, 4))
    read = read_tracks(tmp_path / "flow.gsd")
    np.testing.assert_array_equal(read.positions, found.positions)
    with pytest.raises(InputError, match="contains its time, shear rate and diameters"):
        read_tracks(tmp_path / "flow.gsd", interval=1.0)


def changed(column: str, value) -> str:
    rows = rows_of(tracks()).head(400)
    rows[column] = value(rows[column]) if callable(value) else value
    return rows.to_csv(index=False)


def without(column: str) -> str:
    return rows_of(tracks()).head(400).drop(columns=column).to_csv(index=False)


def doubled_rows(path: Path) -> None:
    rows = rows_of(tracks())
    pd.concat([rows, rows.head(1)]).to_csv(path, index=False)


def other_numbers_of_discs(path: Path) -> None:
    with gsd.hoomd.open(path, "w") as file:
        for count in (5, 6):
            frame = gsd.hoomd.Frame()
            frame.configuration.box = [9, 9, 0, 0, 0, 0]
            frame.particles.N, frame.particles.position = count, np.zeros((count, 3))
            file.append(frame)


def table_of_pandas(path: Path) -> None:
    """As ``to_hdf`` writes it where the columns are not to be searched."""
    blocks = np.dtype([("index", "i8"), ("values_block_0", "f8", (3,)), ("values_block_1", "i8", (2,))])
    with h5py.File(path, "w") as file:
        file["tracks/table"] = np.zeros(4, blocks)
        file["tracks/_i_table/index/bounds"] = np.zeros(2)


def text(content: str | Callable[[], str]) -> Callable[[Path], None]:
    return lambda path: path.write_text(content if isinstance(content, str) else content()) and None


def cut(write: Callable, size: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        write(path, tracks())
        path.write_bytes(path.read_bytes()[:size])

    return make


def dump(old: str, new: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        write_dump(path, tracks())
        path.write_text(path.read_text().replace(old, new, 1))

    return make


ONE_FRAME = "frame,id,x,y,d\n1,1,0,0,1\n1,2,2,2,1\n"


HEIGHTS = "frame,id,x,y,z,d\n1,1,0,0,0,1\n1,2,2,2,1,1\n2,1,0,0,0,1\n"

BROKEN: dict[str, Callable[[Path], object]] = {
    "no_rows.csv": text("frame,id,x,y,diameter\n"),
    "no_frames.csv": text(lambda: without("frame")),
    "words.csv": text(lambda: changed("x", "left")),
    "one_frame.csv": text(ONE_FRAME),
    "an_id_twice.csv": doubled_rows,
    "no_size.csv": text(lambda: changed("diameter", 0)),
    "three_dimensions.csv": text(HEIGHTS),
    "other_units.csv": text(lambda: changed("vx", lambda x: 1e3 * x)),
    "cut.h5": cut(write_fields, 3000),
    "one_step_twice.dump": dump("TIMESTEP\n500\n", "TIMESTEP\n0\n"),
    "cut.gsd": cut(write_gsd, 2000),
    "discs_come_and_go.gsd": other_numbers_of_discs,
    "diameters_in_metres.csv": text(lambda: changed("diameter", lambda x: 1e-3 * x)),
    "pandas.h5": table_of_pandas,
    "no_box.dump": dump("ITEM: BOX BOUNDS xy xz yz pp pp pp\n", ""),
    "another_ending.xyz": text("2\n\nA 0 0 0\n"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_or_foreign_file_is_one_sentence_and_status_2(name: str, tmp_path: Path) -> None:
    BROKEN[name](tmp_path / name)
    outcome = jaxgran(tmp_path, "fit", name)
    assert_one_sentence(outcome)


@pytest.mark.parametrize("options", ["--frame-time 0", "--frame-strain 0.1 --shear-rate 0", "--peculiar"])
def test_options_that_cannot_be_are_one_sentence(options: str, tmp_path: Path) -> None:
    write_csv(tmp_path / "discs.csv", tracks())
    outcome = jaxgran(tmp_path, "fit", "discs.csv", *options.split())
    assert_one_sentence(outcome)
