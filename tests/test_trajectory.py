"""Trajectories come back bit for bit; others see in them the cell, grains and contacts."""

import os
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import freud
import gsd.fl
import gsd.hoomd
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from synthetic import refused

from jaxgran.dynamics.batch import stack
from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.snapshots import snapshot
from jaxgran.io import trajectory
from jaxgran.io.trajectory import Trajectory, read_trajectory, write_frame, write_trajectory
from jaxgran.model.cell import displacement
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status
from jaxgran.sampling.recorder import Recorder

TILTS = (-0.4, 0.0, 0.3)


@pytest.fixture(scope="module")
def flow() -> ShearFlow:
    return ShearFlow(GRAINS, 0.3, 0.78, 1e-3)


@pytest.fixture(scope="module")
def seen(flow, flowing, run):
    """Snapshots that carry forces, by tilt: the flow is sheared until its cell is tilted so."""
    by_tilt, one_snapshot, state = {}, jax.jit(partial(snapshot, solver=EXACT)), flowing(0.78)
    for tilt in TILTS:
        state, _ = run(flow, state, round((tilt - state.tilt.item()) % 1 / 1e-3))
        by_tilt[tilt] = one_snapshot(flow, state)
        while np.count_nonzero(by_tilt[tilt].impulses) < 3:
            state, _ = run(flow, state, 1)
            by_tilt[tilt] = one_snapshot(flow, state)
    return by_tilt


@pytest.fixture(scope="module")
def drive(flow, run):
    """A drive of a batch of one by the compiled function that all tests share."""

    def driven(_flow, _numerics, states, steps):
        state = jax.tree.map(lambda x: x[0], states)
        return jax.tree.map(lambda x: x[None], run(flow, state, int(steps[0])))

    return driven


@pytest.fixture(scope="module")
def recorded(flow, flowing, drive, tmp_path_factory):
    """Five frames, ten steps apart, driven in blocks of 25 and 15; and the last state."""
    path = tmp_path_factory.mktemp("trajectory") / "flow.gsd"
    recorder = Recorder(0.0101, partial(write_frame, path))
    end, tallies = driven_in_blocks(recorder.recording(drive), flow, flowing(0.78), (25, 15))
    assert (recorder.frames, recorder.steps) == (5, 40)
    return path, end, tallies


def driven_in_blocks(drive, flow, state, blocks):
    flows, states, tallies = stack([flow]), jax.tree.map(lambda x: x[None], state), []
    numerics = Numerics(EXACT)
    for steps in blocks:
        states, tally = drive(flows, numerics, states, jnp.asarray([steps], jnp.int32))
        tallies.append(tally)
    return jax.tree.map(lambda x: x[0], (states, tallies))


def assert_same_bits(one, other) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def frame_of(trajectory: Trajectory, k: int):
    return jax.tree.map(lambda x: x[k], trajectory.state)


def first_frame(path: Path):
    with gsd.hoomd.open(path) as file:
        return file[0]


# What is written is read


def test_a_state_is_read_back_to_the_bit(seen, tmp_path: Path) -> None:
    write_frame(tmp_path / "flow.gsd", seen[0.3], 0)
    write_frame(tmp_path / "flow.gsd", seen[TILTS[0]], 700)
    read = read_trajectory(tmp_path / "flow.gsd")
    assert_same_bits(frame_of(read, 0), seen[0.3].state)
    assert_same_bits(frame_of(read, 1), seen[TILTS[0]].state)
    np.testing.assert_array_equal(read.step, [0, 700])
    np.testing.assert_allclose(read.strain, [0, 0.7], rtol=1e-15)
    assert (read.timestep, read.shear_rate, read.restitution) == (1e-3, 1.0, 0.3)
    assert read.packing_fraction == pytest.approx(0.78, rel=1e-14)


def test_states_are_written_with_the_forces_between_them(flow, seen, tmp_path: Path) -> None:
    path, states = tmp_path / "flow.gsd", stack([one.state for one in seen.values()])
    strains = 0.5 + states.tilt - states.tilt[0]
    write_trajectory(path, flow, states, strains, solver=EXACT)
    read = read_trajectory(path)
    assert_same_bits(read.state, states)
    np.testing.assert_array_equal(read.step, np.round((strains - 0.5) / 1e-3))
    write_frame(tmp_path / "one.gsd", seen[TILTS[0]], 0)
    for file in (path, tmp_path / "one.gsd"):
        with gsd.hoomd.open(file) as frames:
            forces = frames[0].log["bonds/force"]
        impulses = np.asarray(seen[TILTS[0]].impulses)
        np.testing.assert_allclose(forces, impulses[impulses > 0] / 1e-3, rtol=1e-12)
    for words, wrong in {
        r"path .* already exists": (states, strains, False),
        "strain must increase by at least one time step": (states, [0.5, 0.5001, 0.53], True),
        "states must have one leading axis": (seen[0.0].state, strains, True),
        "strain must be one number for each": (states, "0.5", True),
    }.items():
        with refused(f"^{words}"):
            write_trajectory(path, flow, wrong[0], wrong[1], overwrite=wrong[2])
    assert_same_bits(read_trajectory(path).state, states)


def test_frames_that_contradict_flow_grains_or_strain_are_refused(
    flow, seen, tmp_path: Path
) -> None:
    states = jax.tree.map(jnp.asarray, stack([one.state for one in seen.values()]))
    strains, grains = 0.5 + states.tilt - states.tilt[0], states.grains
    lost = replace(states, velocities=states.velocities.at[1, 0].set(jnp.nan))
    swapped = replace(
        states, grains=replace(grains, radii=grains.radii.at[1].set(grains.radii[1, ::-1]))
    )
    for words, given in {
        "state 1 cannot be written: state must have only finite": (flow, lost, strains),
        "have the same grains, and state 1": (flow, swapped, strains),
        "packing_fraction must be 0.78": (replace(flow, packing_fraction=0.5), states, strains),
        "strain must be that by which the cell is tilted": (flow, states, strains * 1.01),
        "shear_rate must be above 0": (replace(flow, shear_rate=0.0), states, strains),
    }.items():
        with refused(words):
            write_trajectory(tmp_path / "flow.gsd", *given)
    with jax.enable_x64(False), refused("precision in which JAX computes, float32"):
        write_trajectory(tmp_path / "flow.gsd", flow, jax.tree.map(np.asarray, states), strains)
    assert not list(tmp_path.iterdir())


def test_a_frame_whose_forces_were_not_found_says_so(flow, seen, tmp_path: Path) -> None:
    path, few = tmp_path / "flow.gsd", replace(EXACT, max_steps=1)
    states, strains = stack([seen[0.0].state]), [0.0]
    with pytest.warns(UserWarning, match="not converged, status iteration_limit: some contact"):
        write_trajectory(path, flow, states, strains, solver=few)
    assert read_trajectory(path).status.tolist() == [Status.iteration_limit]
    write_trajectory(path, flow, states, strains, solver=EXACT, overwrite=True)
    assert read_trajectory(path).status.tolist() == [Status.ok]


# Recording


def test_frames_are_those_of_the_flow_at_equal_distances(flow, flowing, run, recorded) -> None:
    path, end, _ = recorded
    read, state = read_trajectory(path), flowing(0.78)
    np.testing.assert_array_equal(read.step, [0, 10, 20, 30, 40])
    np.testing.assert_allclose(read.strain, 1e-3 * read.step, rtol=1e-14)
    assert_same_bits(frame_of(read, 0), state)
    assert_same_bits(frame_of(read, 4), end)
    for k in range(1, 5):
        state, _ = run(flow, state, 10)
        frame = frame_of(read, k)
        apart = displacement(frame.positions, state.positions, state.side, state.tilt)
        np.testing.assert_allclose(apart, 0, atol=1e-9)
        np.testing.assert_allclose(frame.velocities, state.velocities, atol=1e-9)
        np.testing.assert_allclose(frame.tilt, state.tilt, atol=1e-12)


@pytest.mark.parametrize("every", [0.01, 0.02], ids=["every block", "every other block"])
def test_frames_at_the_ends_of_blocks_change_no_bit(
    flow, flowing, drive, every: float, tmp_path: Path
) -> None:
    recorder = Recorder(every, partial(write_frame, tmp_path / "flow.gsd"))
    recorded = driven_in_blocks(recorder.recording(drive), flow, flowing(0.78), (10, 10, 10, 10))
    assert_same_bits(recorded, driven_in_blocks(drive, flow, flowing(0.78), (10, 10, 10, 10)))
    assert recorder.frames == 1 + round(0.04 / every)


def test_a_replica_that_is_not_finite_has_no_frames(flow, flowing, drive, tmp_path: Path) -> None:
    """It is the status that tells, and the retry that records."""
    path = tmp_path / "flow.gsd"
    recorder = Recorder(0.01, partial(write_frame, path))
    state = flowing(0.78)
    lost = replace(state, velocities=state.velocities.at[..., 0].set(jnp.nan))
    driven_in_blocks(recorder.recording(drive), flow, lost, (10, 0))
    assert recorder.frames == 0 and not path.exists()


def test_frames_are_at_the_nearest_time_steps_of_any_strain(flow, flowing, drive) -> None:
    def recorded_steps(every: float, blocks: tuple[int, ...], **options) -> list[int]:
        steps: list[int] = []
        recorder = Recorder(every, lambda _, step: steps.append(step), **options)
        driven_in_blocks(recorder.recording(drive), flow, flowing(0.78), blocks)
        assert (recorder.frames, recorder.steps) == (len(steps), sum(blocks))
        return steps

    assert recorded_steps(0.01037, (25, 15, 60)) == [round(10.37 * k) for k in range(10)]
    assert recorded_steps(1e-5, (3, 2)) == [0, 1, 2, 3, 4, 5]
    assert recorded_steps(0.01, (25, 15, 60), most=3) == [0, 10, 20]


def mean_forces(flow, run, state, steps: int) -> dict[tuple[int, int], float]:
    """Mean force of each pair over the time steps that follow a state, pair by pair."""
    one_snapshot, forces = jax.jit(partial(snapshot, solver=EXACT)), {}
    for _ in range(steps):
        seen = jax.tree.map(np.asarray, one_snapshot(flow, state))
        for slot in np.flatnonzero(seen.impulses):
            pair = tuple(sorted((int(seen.contacts.i[slot]), int(seen.contacts.j[slot]))))
            forces[pair] = forces.get(pair, 0.0) + float(seen.impulses[slot]) / 1e-3 / steps
        state, _ = run(flow, state, 1)
    return forces


def test_forces_over_a_strain_are_the_means_over_its_time_steps_and_change_no_bit(
    flow, flowing, drive, run, tmp_path: Path
) -> None:
    path, again, start = tmp_path / "flow.gsd", tmp_path / "again.gsd", flowing(0.78)
    recorder = Recorder(0.02, partial(write_frame, path), force_strain=0.012)
    recorded = driven_in_blocks(recorder.recording(drive), flow, start, (20, 20))
    assert_same_bits(recorded, driven_in_blocks(drive, flow, start, (20, 20)))
    read = read_trajectory(path)
    assert_same_bits(frame_of(read, 0), start)
    states = jax.tree.map(jnp.asarray, read.state)
    write_trajectory(again, flow, states, read.strain, force_strain=0.012, solver=EXACT)
    expected = [
        mean_forces(flow, run, jax.tree.map(lambda x, k=k: x[k], states), 12) for k in range(3)
    ]
    assert sum(map(len, expected)) > 5  # pairs in contact
    for file in (path, again):
        with gsd.hoomd.open(file) as frames:
            for frame, forces in zip(frames, expected, strict=True):
                assert [tuple(pair) for pair in frame.bonds.group.tolist()] == sorted(forces)
                np.testing.assert_allclose(
                    frame.log["bonds/force"], [forces[p] for p in sorted(forces)], rtol=1e-6
                )
                assert frame.log["jaxgran/force_strain"][0] == pytest.approx(0.012)
                total = frame.log["particles/contact_force"].sum()
                np.testing.assert_allclose(total, 2 * sum(forces.values()), rtol=1e-6)
    with refused("^force_strain must be above 0 and at most the strain between frames, 0.02"):
        write_trajectory(again, flow, states, read.strain, force_strain=0.03, overwrite=True)


# What other programs see


@pytest.mark.parametrize("tilt", TILTS[::2])
def test_box_is_the_sheared_cell_and_holds_all_grains(seen, tilt: float, tmp_path: Path) -> None:
    state = seen[tilt].state
    write_frame(tmp_path / "flow.gsd", seen[tilt], 0)
    frame = first_frame(tmp_path / "flow.gsd")
    side, tilt = state.side.item(), state.tilt.item()
    box = freud.box.Box.from_box(frame.configuration.box)
    assert box.is2D and frame.particles.N == GRAINS
    np.testing.assert_allclose(
        box.to_matrix()[:2, :2], [[side, tilt * side], [0, side]], rtol=1e-6, atol=1e-7
    )
    fractions = box.make_fractional(frame.particles.position)[:, :2]
    assert fractions.min() >= -1e-6 and fractions.max() <= 1 + 1e-6
    np.testing.assert_allclose(frame.particles.diameter, 2 * state.grains.radii, rtol=1e-6)
    np.testing.assert_allclose(frame.particles.mass, state.grains.masses, rtol=1e-6)
    np.testing.assert_allclose(
        frame.particles.velocity[:, :2], state.velocities, rtol=1e-6, atol=1e-12
    )


def test_coordination_number_of_the_bonds_is_that_of_the_flow_and_clusters_are_joined_by_them(
    flow, run, seen, tmp_path: Path
) -> None:
    write_frame(tmp_path / "flow.gsd", seen[0.3], 0)
    frame = first_frame(tmp_path / "flow.gsd")
    _, tally = run(flow, seen[0.3].state, 1)
    coordination = np.bincount(frame.bonds.group.ravel(), minlength=GRAINS)
    assert coordination.sum() / GRAINS == 2 * tally.loaded_contacts.item() / GRAINS > 0
    np.testing.assert_allclose(np.sum(frame.log["bonds/force"]) * 1e-3, tally.impulse, rtol=1e-9)
    bonds = coo_array((np.ones(frame.bonds.N), frame.bonds.group.T), shape=(GRAINS, GRAINS))
    _, cluster = connected_components(bonds, directed=False)
    np.testing.assert_array_equal(
        frame.log["particles/cluster_size"], np.bincount(cluster)[cluster]
    )
    for labels in frame.log["particles/cluster"][:, None] == frame.log["particles/cluster"]:
        assert set(np.flatnonzero(labels)) in [
            set(np.flatnonzero(cluster == k)) for k in set(cluster)
        ]


# Files that are no trajectories


def assert_refused(path, words: str) -> None:
    with refused(words):
        read_trajectory(path)


def test_a_torn_file_and_those_of_others_are_refused_in_one_sentence(
    recorded, tmp_path: Path
) -> None:
    content = recorded[0].read_bytes()
    for torn in (b"", b"no trajectory " * 99, content[:-300], content[:256]):
        (tmp_path / "torn.gsd").write_bytes(torn)
        assert_refused(tmp_path / "torn.gsd", "is not a readable GSD file")
    with gsd.fl.open(
        str(tmp_path / "other.gsd"), "w", application="x", schema="rods", schema_version=[1, 0]
    ):
        pass
    assert_refused(tmp_path / "other.gsd", "is not a readable GSD file: .* schema: rods")
    for frames in ([], [gsd.hoomd.Frame()]):
        with gsd.hoomd.open(tmp_path / "foreign.gsd", "w") as file:
            file.extend(frames)
        assert_refused(tmp_path / "foreign.gsd", "has no format_version, and")


# Interruptions


def test_a_file_of_another_format_is_refused_in_a_sentence(
    seen, tmp_path: Path, monkeypatch
) -> None:
    path = tmp_path / "flow.gsd"
    with monkeypatch.context() as patch:
        patch.setattr(trajectory, "FORMAT_VERSION", 7)
        write_frame(path, seen[0.3], 0)
    assert_refused(path, "has format_version 7, and this version of jaxgran reads")


def test_a_file_is_whole_after_every_frame(flow, flowing, drive, tmp_path: Path) -> None:
    path, seen_frames = tmp_path / "flow.gsd", []
    recorder = Recorder(0.002, partial(write_frame, path))

    def watched(*arguments):
        seen_frames.append(len(read_trajectory(path).step))
        return drive(*arguments)

    driven_in_blocks(recorder.recording(watched), flow, flowing(0.78), (8,))
    assert seen_frames == [1, 2, 3, 4]


# Where trajectories are written


@pytest.mark.skipif(os.name != "posix", reason="no limit of the size of a file")
def test_a_full_disk_is_named_and_leaves_the_frames_that_are_whole(seen, tmp_path: Path) -> None:
    import resource

    path, before = tmp_path / "flow.gsd", resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        write_frame(path, seen[TILTS[0]], 0)
        resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, before[1]))
        with pytest.raises(OSError, match="File too large") as failure:
            for step in range(1, 100):
                write_frame(path, seen[TILTS[0]], step)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert failure.value.filename == str(path) and list(tmp_path.iterdir()) == [path]
    assert len(read_trajectory(path).strain) == step
