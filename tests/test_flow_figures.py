"""Pictures of a flow show its grains, its forces and its cell; movies are whole, and their frames
differ.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib import animation
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Polygon
from PIL import Image, ImageSequence
from synthetic import snapshot_of

from jaxgran.analysis.force_chains import pair_forces
from jaxgran.plotting import flow, movie
from jaxgran.plotting.flow import Scale, common_scale, draw_scene, flow_figure, scene_of
from jaxgran.plotting.movie import Frames, check_movie, write_movie
from jaxgran.plotting.style import empty_figure

SIDE, GRAINS = 8.0, 40


def seen(
    tilt: float = 0.0,
    times: int = 1,
    contacts=((0, 1, 2.0), (1, 2, 1.0), (3, 4, 0.5)),
    seed: int = 0,
    **more,
):
    """A snapshot: a cluster of three, and a binary collision."""
    random = np.random.default_rng(seed)
    positions = random.uniform(0, SIDE, (1, GRAINS, 2)).repeat(times, axis=0)
    velocities = random.normal(size=(1, GRAINS, 2)).repeat(times, axis=0)
    return snapshot_of(
        positions, [list(contacts)] * times, velocities, side=SIDE, tilt=tilt, **more
    )


def drawn(scene, scale: Scale | None = None):
    axes = empty_figure(4, 4).subplots()
    draw_scene(axes, scene, "speed", scale or common_scale([scene], "speed"))
    (grains,) = (artist for artist in axes.collections if isinstance(artist, EllipseCollection))
    clusters, binaries = (
        artist for artist in axes.collections if isinstance(artist, LineCollection)
    )
    (cell,) = (artist for artist in axes.patches if isinstance(artist, Polygon))
    return grains, clusters, binaries, cell


def area_within(grains: EllipseCollection, cell: Polygon, points: int = 400) -> float:
    """Share of the cell that is covered, where grains do not overlap the sum over them of the area
    inside.
    """
    corners = cell.get_xy()[:-1]
    u = (np.arange(points) + 0.5) / points
    mesh = (
        corners[0]
        + u[:, None, None] * (corners[1] - corners[0])
        + u[:, None] * (corners[3] - corners[0])
    )
    centres, radii = grains.get_offsets(), grains.get_widths() / 2
    inside = [
        np.sum((mesh - centre) ** 2, axis=-1) < radius**2
        for centre, radius in zip(centres, radii, strict=True)
    ]
    return float(np.mean(np.sum(inside, axis=0)))


@pytest.mark.parametrize("tilt", [-0.5, 0.0, 0.2])
def test_grains_cut_at_the_edges_and_their_images_make_whole_grains(tilt: float) -> None:
    """The parts of the images within the cell sum up to the area of all grains: none is missing,
    none twice there.
    """
    scene = scene_of(seen(tilt))
    grains, *_, cell = drawn(scene)
    assert area_within(grains, cell) == pytest.approx(GRAINS * np.pi / 4 / SIDE**2, rel=2e-3)


def test_lines_join_the_centres_of_grains_that_push_in_widths_by_their_forces() -> None:
    scene = scene_of(seen(0.2))
    _, clusters, binaries, _ = drawn(scene, Scale(1.0, 2.0))
    widths = {*clusters.get_linewidths(), *binaries.get_linewidths()}
    assert max(widths) == flow.WIDEST_LINE
    np.testing.assert_allclose(sorted(widths), flow.WIDEST_LINE * np.array([0.25, 0.5, 1.0]))
    start, end = (scene.instant.positions[k] for k in (4, 3))
    (middle,) = (
        line for line in binaries.get_segments() if np.allclose(line[0], start)
    )  # the image not shifted
    lattice = np.linalg.solve(np.array([[SIDE, 0.2 * SIDE], [0, SIDE]]), middle[1] - end)
    np.testing.assert_allclose(lattice, np.round(lattice), atol=1e-9)
    assert np.linalg.norm(middle[1] - middle[0]) < SIDE


def test_colours_are_the_speed_and_the_pressure_of_the_contacts() -> None:
    one = seen()
    scene = scene_of(one)
    np.testing.assert_allclose(scene.speed, np.linalg.norm(one.state.velocities[0], axis=-1))
    pushed = np.zeros(GRAINS)
    pushed[:5] = 2.0, 3.0, 1.0, 0.5, 0.5
    np.testing.assert_allclose(scene.pressure, pushed * 0.5 / (2 * np.pi * 0.25))
    grains = drawn(scene)[0]
    assert set(grains.get_array()) == set(scene.speed)


def test_pressures_of_grains_of_one_size_sum_up_to_the_contact_stress() -> None:
    """Σ A p of the grains is tr/2 of Σ r F over the contacts where grains touch."""
    positions = np.zeros((1, GRAINS, 2))
    positions[0, :, 0] = np.arange(GRAINS) % 8 * 1.0
    positions[0, :, 1] = np.arange(GRAINS) // 8 * 1.5
    scene = scene_of(snapshot_of(positions, [[(0, 1, 2.0), (2, 1, 3.0)]], side=SIDE))
    assert np.sum(np.pi * scene.instant.radii**2 * scene.pressure) == pytest.approx(
        (2.0 + 3.0) * 1.0 / 2
    )


def test_forces_of_a_series_are_means_over_its_times() -> None:
    """A pair counts to the clusters where most of its force acts within them."""
    contacts = [[(0, 1, 3.0)], [(1, 0, 1.0), (2, 1, 4.0)], [(5, 6, 2.0)], []]
    positions = np.random.default_rng(0).uniform(0, SIDE, (1, GRAINS, 2)).repeat(4, axis=0)
    series = snapshot_of(positions, contacts, side=SIDE)
    found = pair_forces(series)
    np.testing.assert_array_equal(np.stack([found.i, found.j], axis=-1), [[0, 1], [1, 2], [5, 6]])
    np.testing.assert_allclose(found.force, [1.0, 1.0, 0.5])
    np.testing.assert_allclose(found.cluster_share, [0.25, 1.0, 0.0])
    np.testing.assert_array_equal(scene_of(series).instant.clustered, [False, True, False])


def test_picture_is_the_same_in_any_unit_of_time() -> None:
    """Velocities go with the shear rate, forces with its square, time steps with its inverse."""
    one, other = seen(times=3), seen(times=3)
    one.shear_rate[:], other.shear_rate[:] = 1.0, 2.0
    other = replace(
        other,
        timestep=other.timestep / 2,
        impulses=other.impulses * 2,
        state=replace(other.state, velocities=other.state.velocities * 2),
    )
    jax.tree.map(np.testing.assert_array_equal, scene_of(one), scene_of(other))


@pytest.mark.parametrize("contacts", [(), ((0, 1, 0.0),)], ids=["no contacts", "no forces"])
def test_flow_without_forces_or_motion_is_drawn(contacts, tmp_path: Path) -> None:
    still = seen(contacts=contacts)
    still.state.velocities[:] = 0
    for colour in ("speed", "pressure"):
        flow_figure(still, colour).savefig(tmp_path / "still.png")


# Movies


def kept(count: int) -> Frames:
    frames = Frames()
    for k in range(count):
        frames.keep(seen_once(k), k)
    return frames


def seen_once(k: int):
    """A snapshot without an axis of times, at a tilt that begins anew."""
    return jax.tree.map(lambda x: np.asarray(x[0]), seen(tilt=(0.1 * k + 0.5) % 1 - 0.5, seed=k))


def test_gif_has_all_frames_and_they_differ(tmp_path: Path) -> None:
    path = tmp_path / "flow.gif"
    path.write_bytes(b"old")
    write_movie(path, kept(6))
    assert [file.name for file in tmp_path.iterdir()] == ["flow.gif"]
    with Image.open(path) as film:
        assert film.n_frames == 6 and film.info["duration"] == 50 and film.info.get("loop") == 0
        pictures = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    assert {picture.shape for picture in pictures} == {pictures[0].shape}
    for one, other in pairwise(pictures):
        assert np.mean(one != other) > 0.02


def test_too_many_frames_are_thinned_evenly(monkeypatch) -> None:
    monkeypatch.setattr(movie, "MOST_DRAWN", 8)
    frames = Frames()
    one = seen_once(0)
    for step in range(50):
        frames.keep(one, step)
    assert 4 <= len(frames.strains) <= 8
    assert len(set(np.diff(frames.strains))) == 1 and frames.strains[0] == 0
    frames.keep(one, 0)
    assert frames.strains == [0.0]


def test_a_movie_that_is_interrupted_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "flow.gif"
    path.write_bytes(b"old")

    def interrupts(items):
        yield items[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_movie(path, kept(3), follow=interrupts)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["flow.gif"]


@pytest.mark.skipif(not animation.FFMpegWriter.isAvailable(), reason="ffmpeg is not installed")
def test_mp4_is_written_where_there_is_ffmpeg(tmp_path: Path) -> None:
    check_movie(tmp_path / "flow.mp4")
    write_movie(tmp_path / "flow.mp4", kept(4))
    content = (tmp_path / "flow.mp4").read_bytes()
    assert content[4:8] == b"ftyp" and len(content) > 2000
