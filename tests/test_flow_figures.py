"""Pictures of a flow show its grains, forces and cell; movies are whole and move."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib import animation
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, PolyCollection
from PIL import Image, ImageSequence
from synthetic import snapshot_of

import jaxgran as jg
from jaxgran.plotting import flow, movie
from jaxgran.plotting.flow import Scale, common_scale, draw_flow, flow_figure, network_of, title_of
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


def drawn(network, scale: Scale | None = None) -> Axes:
    axes = empty_figure(4, 4).subplots()
    draw_flow(axes, network, scale or common_scale([network]))
    return axes


def area_within(grains: EllipseCollection, axes: Axes, points: int = 400) -> float:
    """Share of the window that is covered: the area inside, where grains do not overlap."""
    u = (np.arange(points) + 0.5) / points
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    mesh = np.stack(np.meshgrid(left + (right - left) * u, low + (high - low) * u), axis=-1)
    centres, radii = grains.get_offsets(), grains.get_widths() / 2
    inside = [
        np.sum((mesh - centre) ** 2, axis=-1) < radius**2
        for centre, radius in zip(centres, radii, strict=True)
    ]
    return float(np.mean(np.sum(inside, axis=0)))


def bars_of(artist: PolyCollection) -> np.ndarray:
    """Return x and y of the middle, half the branch and the width of each bar, (bars, 5)."""
    corners = np.array([path.vertices[:6] for path in artist.get_paths()])
    middle, half = corners.mean(axis=1), (corners[:, 0] + corners[:, 2]) / 2
    width = np.linalg.norm(corners[:, 0] - corners[:, 2], axis=-1)
    return np.column_stack([middle, half - middle, width])


@pytest.mark.parametrize("tilt", [-0.5, 0.0, 0.2])
def test_grains_cut_at_the_edges_and_their_images_make_whole_grains(tilt: float) -> None:
    """Parts of images in the window have the area of all grains: none is missing, none twice."""
    snapshots = seen(tilt)
    axes = drawn(network_of(snapshots))
    grains, *_ = axes.collections
    expected = GRAINS * np.pi / 4 / SIDE**2
    assert area_within(grains, axes) == pytest.approx(expected, rel=2e-3)
    speeds = np.linalg.norm(snapshots.state.velocities[0], axis=-1)
    np.testing.assert_allclose(sorted(set(grains.get_array())), sorted(speeds))


def test_bars_join_the_centres_of_grains_that_push_in_widths_by_their_forces() -> None:
    network = network_of(seen(0.2))
    clusters, binaries = map(bars_of, drawn(network, Scale(1.0, 2.0)).collections[1:])
    widths = flow.WIDEST_BAR * np.array([0.5, 1.0])
    np.testing.assert_allclose(sorted(set(clusters[:, 4].round(9))), widths)
    np.testing.assert_allclose(binaries[:, 4], flow.WIDEST_BAR / 4)
    start, end = (network.positions[k] for k in (4, 3))
    middle = binaries[0]
    ends = middle[:2] - middle[2:4], middle[:2] + middle[2:4]
    cell = np.array([[SIDE, 0.2 * SIDE], [0, SIDE]])
    for found, expected in zip(ends, (start, end), strict=True):
        lattice = np.linalg.solve(cell, found - expected)
        np.testing.assert_allclose(lattice, np.round(lattice), atol=1e-9)
    assert 2 * np.linalg.norm(middle[2:4]) < SIDE


def test_forces_of_a_series_are_means_over_its_times() -> None:
    """A pair counts to the clusters where most of its force acts within them."""
    contacts = [[(0, 1, 3.0)], [(1, 0, 1.0), (2, 1, 4.0)], [(5, 6, 2.0)], []]
    positions = np.random.default_rng(0).uniform(0, SIDE, (1, GRAINS, 2)).repeat(4, axis=0)
    network = network_of(snapshot_of(positions, contacts, side=SIDE))
    np.testing.assert_array_equal(network.pairs, [[0, 1], [1, 2], [5, 6]])
    np.testing.assert_allclose(network.force, [1.0, 1.0, 0.5])
    np.testing.assert_array_equal(network.clustered, [False, True, False])


def test_picture_is_the_same_in_any_unit_of_time() -> None:
    """Velocities go with the shear rate, forces with its square, time steps with its inverse."""
    one = seen(times=3)
    other = replace(
        one,
        shear_rate=one.shear_rate * 2,
        timestep=one.timestep / 2,
        impulses=one.impulses * 2,
        state=replace(one.state, velocities=one.state.velocities * 2),
    )
    jax.tree.map(np.testing.assert_array_equal, network_of(one), network_of(other))
    assert title_of(one) == title_of(other)


def test_snapshots_whole_units_of_strain_and_a_step_apart_are_not_those_of_every_step() -> None:
    flow = jg.ShearFlow(16, 0.5, 0.5, 1e-2)
    state = jg.heated(flow, jax.random.key(0))
    _, each = jg.snapshot_series(flow, state, strain=0.05, count=5)
    assert "5 time steps, a strain of 0.05" in title_of(each)
    _, apart = jg.snapshot_series(flow, state, strain=2.02, count=2)
    assert "2 snapshots" in title_of(apart)


@pytest.mark.parametrize("contacts", [(), ((0, 1, 0.0),)], ids=["no contacts", "no forces"])
def test_flow_without_forces_or_motion_is_drawn(contacts, tmp_path: Path) -> None:
    still = seen(contacts=contacts)
    still.state.velocities[:] = 0
    flow_figure(still).savefig(tmp_path / "still.png")


# Movies


def kept(count: int) -> Frames:
    """Frames of a flow whose tilt begins anew."""
    frames = Frames()
    for k in range(count):
        snapshots = seen(tilt=(0.1 * k + 0.5) % 1 - 0.5, seed=k)
        frames.keep(jax.tree.map(lambda x: np.asarray(x[0]), snapshots), k)
    return frames


@pytest.mark.parametrize("flows", [1, 2])
def test_gif_has_all_frames_and_they_differ(flows: int, tmp_path: Path) -> None:
    path = tmp_path / "flow.gif"
    path.write_bytes(b"old")
    write_movie(path, *[kept(6)] * flows)
    assert [file.name for file in tmp_path.iterdir()] == ["flow.gif"]
    with Image.open(path) as film:
        assert film.n_frames == 6 and film.info["duration"] == 80 and film.info.get("loop") == 0
        pictures = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    (height, width, _) = pictures[0].shape
    assert {picture.shape for picture in pictures} == {pictures[0].shape}
    assert (width > height) == (flows == 2)  # they are beside each other
    for one, other in pairwise(pictures):
        assert np.mean(one != other) > 0.02


def test_too_many_frames_are_thinned_evenly(monkeypatch) -> None:
    monkeypatch.setattr(movie, "MOST_DRAWN", 8)
    strains = [float(title.split("strain ")[1].split("\n")[0]) for _, title in kept(50).frames]
    assert 4 <= len(strains) <= 8 and strains[0] == 0
    assert np.ptp(np.diff(strains)) < 1.5e-3  # three digits


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
