"""The engine for CUDA devices, on a processor: against that of processors, for races, acted."""

import ctypes
import json
import os
import shutil
import subprocess
import sys
from functools import cache
from importlib.util import find_spec
from itertools import count, pairwise
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import team_on_processor
from synthetic import refused

import jaxgran as jg
from jaxgran import environment
from jaxgran.dynamics import engine
from jaxgran.dynamics.numba_engine import call, ffi, layout
from jaxgran.dynamics.numba_engine.call import call_numba, first_row
from jaxgran.dynamics.numba_engine.team import handler, linking, memory
from jaxgran.dynamics.tally import NUMBERS, place_of

SOLVER = jg.BarzilaiBorwein(tolerance=1e-10)
STEPS = np.array([30, 0, 50])
TARGETS = count()  # a name cannot be registered twice
# What follows from the way of a solver and from its tolerance; and counts, of which one may be
# of grains that just touch
OTHER = [place_of(name) for name in ("iterations", "complementarity", "worst_residual")]
COUNTS = [
    place_of(name)
    for name in ("contacts", "loaded_contacts", "collisions", "deep_contacts", "solves")
]


@cache
def flow_and_state(
    alpha: float, nu: float, grains: int = 64, seed: int = 0
) -> tuple[jg.ShearFlow, jg.State]:
    flow = jg.ShearFlow(grains, alpha, nu, 1e-3)
    return flow, jg.prepare(flow, jax.random.key(seed), equilibrate=2.0)


def by_team(flow: jg.ShearFlow, state: jg.State, solver=SOLVER, lanes: int = 1, steps=STEPS):
    return team_on_processor.advance(flow, solver, state, steps, first_row(flow, state), lanes)


def by_numba(flow: jg.ShearFlow, state: jg.State, solver=SOLVER, steps=STEPS) -> call.NumbaCall:
    return call_numba(flow, solver, state, jnp.asarray(steps), first_row(flow, state))


@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
@pytest.mark.parametrize(("alpha", "nu"), [(0.9, 0.3), (0.5, 0.7), (0.2, 0.8)])
def test_one_lane_agrees_with_the_engine_numba_the_better_the_smaller_the_tolerance(
    alpha: float, nu: float, tolerance: float
) -> None:
    """States, sums of every block, status and tilt; impulses differ within the tolerance."""
    flow, state = flow_and_state(alpha, nu)
    solver = jg.BarzilaiBorwein(tolerance=tolerance)
    positions, velocities, blocks = by_team(flow, state, solver)
    expected = by_numba(flow, state, solver)
    speed = np.sqrt(np.mean(np.square(state.velocities)))
    bound = 1000 * tolerance  # a few collisions amplify what a solve leaves
    np.testing.assert_allclose(velocities, expected.velocities, rtol=0, atol=bound * speed)
    np.testing.assert_allclose(positions, expected.positions, rtol=0, atol=bound)
    rows = np.asarray(expected.blocks)
    kept = np.delete(np.arange(NUMBERS), OTHER)
    allowed = bound * np.maximum(np.abs(rows).max(axis=0), 1e-9)
    allowed[COUNTS] = 1 if tolerance > 1e-8 else 0
    assert (np.abs(blocks - rows)[:, kept] <= allowed[kept]).all()
    assert (blocks[:, layout.STATUS] == rows[:, layout.STATUS]).all()
    np.testing.assert_allclose(blocks[-1, layout.TILT], rows[-1, layout.TILT], atol=1e-14)
    for column in (layout.KINETIC, layout.DRIFT):
        np.testing.assert_allclose(blocks[:-1, column], rows[:-1, column], rtol=0, atol=bound)


def test_many_lanes_agree_with_one_to_rounding_and_repeat_to_the_bit() -> None:
    """32 threads with real barriers; sums over lanes are added in their order."""
    flow, state = flow_and_state(0.5, 0.75)
    one, many, again = (by_team(flow, state, lanes=lanes) for lanes in (1, 32, 32))
    for x, y in zip(many, again, strict=True):
        assert np.array_equal(x, y)
    np.testing.assert_allclose(many[0], one[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(many[1], one[1], rtol=0, atol=1e-7)
    assert (many[2][:, place_of("collisions")] == one[2][:, place_of("collisions")]).all()
    assert many[2][:, place_of("collisions")].sum() > 20


def test_no_lane_touches_what_another_one_writes_and_every_barrier_is_needed(
    tmp_path: Path,
) -> None:
    """Four lanes, uncompiled. Leaving out any barrier is found in one of the runs at least: with a
    grid of cells, a narrowed skin and the method that follows the sweeps; without a grid; and with
    fewer colours than a grain has contacts.
    """
    scenes: list[tuple[int, dict]] = [
        (24, {"PAIRS_PER_GRAIN": 2, "SWEEPS": 3}),
        (16, {}),
        (24, {"_LAST_COLOUR": 4}),
    ]
    script, plain = Path(__file__).with_name("team_races.py"), {"NUMBA_DISABLE_JIT": "1"}
    runs, expected = [], []
    for n, (grains, numbers) in enumerate(scenes):
        flow, state = flow_and_state(0.5, 0.75, grains=grains)
        inputs = [state.side, flow.restitution, flow.timestep, 1.0, 1e-10, flow.activation, 1000]
        arrays = {name: getattr(state, name) for name in ("positions", "velocities")}
        arrays |= {name: getattr(state.grains, name) for name in ("radii", "masses")}
        arrays |= {"steps": np.array([15.0, 15.0]), "inputs": np.array(inputs, float)}
        file = tmp_path / f"{n}.npz"
        np.savez(file, **arrays, begin=first_row(flow, state))
        command = [sys.executable, str(script), str(file), "4", json.dumps(numbers)]
        runs.append(subprocess.Popen(command, env=os.environ | plain, stdout=subprocess.PIPE))
        expected.append(by_numba(flow, state, steps=np.array([15, 15])).positions)
    places, found = set(), set()
    for run, positions in zip(runs, expected, strict=True):
        result = json.loads(run.communicate(timeout=300)[0])
        assert result["wrong"] == [] and result["barriers"] > 10
        assert result["room"] == [5, 0, 1, 2]
        np.testing.assert_allclose(result["positions"], positions, rtol=0, atol=1e-8)
        here, needless = (set(map(tuple, result[x])) for x in ("places", "needless"))
        places |= here
        found |= here - needless
    assert len(places) > 15
    assert places == found


def test_more_contacts_of_a_grain_than_colours_are_relaxed_in_turn() -> None:
    """A large disc that is hit by 65 small ones at once; one lane finds all near pairs."""
    angles = 2 * np.pi * np.arange(65) / 65
    outside = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    diameters = np.array([20.0] + [1.0] * 65)
    grains = jg.own_grains(diameters)
    mean = diameters.mean()
    side = 60 / mean
    positions = np.concatenate([[[0, 0]], (10.5 - 1e-5) * outside]) / mean + side / 2
    velocities = np.concatenate([[[0, 0]], -10 * outside * (1 + 0.1 * np.cos(3 * angles))[:, None]])
    fraction = float(np.pi / 4 * np.sum((diameters / mean) ** 2) / side**2)
    flow = jg.ShearFlow(66, 0.5, fraction, 1e-4)
    tilt = jnp.zeros(())
    state = jg.State(
        grains, jnp.asarray(positions), jnp.asarray(velocities), jnp.asarray(side), tilt
    )
    steps = np.array([3])
    positions, velocities, blocks = by_team(flow, state, lanes=32, steps=steps)
    expected = by_numba(flow, state, steps=steps)
    assert blocks[0, layout.STATUS] == 0
    assert blocks[0, place_of("collisions")] >= 65
    np.testing.assert_allclose(velocities, expected.velocities, rtol=0, atol=1e-7)


def test_a_number_that_is_not_finite_is_a_status() -> None:
    flow, state = flow_and_state(0.9, 0.3)
    velocities = state.velocities.at[3, 0].set(np.nan)
    *_, blocks = by_team(
        flow,
        jg.State(*(state.grains, state.positions, velocities, state.side, state.tilt)),
        lanes=4,
    )
    assert (blocks[:, layout.STATUS] == layout.NONFINITE).all()


@pytest.mark.parametrize(("grains", "lanes"), [(2, 32), (255, 1), (1000, 32)])
def test_the_memory_of_a_team_holds_its_arrays_one_behind_the_other(
    monkeypatch, grains: int, lanes: int
) -> None:
    places: list[tuple[int, int]] = []

    def array(address: int, shape, dtype) -> np.ndarray:
        made = np.empty(shape, dtype)
        places.append((address, made.nbytes))
        return made

    monkeypatch.setattr(memory, "_array", array)
    monkeypatch.setattr(memory, "array_at", memory.array_at.py_func)
    made, end = memory.memory_at.py_func(4096, grains, lanes)
    for (first, size), (second, _) in pairwise([*places, (end, 0)]):
        assert first + size <= second < first + size + 8
    arrays = [*made.grains, *made.pairs, *made.network, *made.clusters, made.sums]
    assert made.clusters.dv is made.network.impulses
    assert len(places) == len({id(x) for x in arrays}) == len(arrays) - 1
    assert made.pairs.starts.size == max(9, 2 * grains) + 1
    assert end - 4096 <= 8 * memory.words_needed(grains, lanes) < end - 4096 + 512


def test_the_kernel_needs_nothing_but_the_device() -> None:
    """PTX without calls of other functions; where there is an assembler, it takes it."""
    code = linking.ptx()
    assert f".visible .entry {layout.KERNEL}" in code and code.count("bar.warp.sync") > 20
    assert code.count("shfl.sync.idx.b32") > 20 and "vote.sync.ballot.b32" in code
    assert ".extern" not in code and "call" not in code.replace("call_", "")
    assert "add.rn.f64" in code  # of sums over lanes, which may not be contracted
    package = find_spec("nvidia")
    folders = [] if package is None else package.submodule_search_locations or []
    assemblers = [file for folder in folders for file in Path(folder).glob("*/bin/ptxas")]
    for assembler in filter(None, [shutil.which("ptxas"), *assemblers]):
        run = subprocess.run([assembler, "-arch=sm_90", "-", "-o", os.devnull], input=code.encode())
        assert run.returncode == 0


@pytest.fixture
def device(monkeypatch):
    """A processor that counts as a CUDA device, with the acted driver; what is asked of it."""
    flow_and_state(0.5, 0.6, grains=32)  # prepared as on a processor
    asked: list = []

    class Driver:
        error = 0

        def __getattr__(self, name: str):
            def function(*arguments):
                asked.append(name)
                if name == "cuLibraryLoadData":
                    _, code, options, values, count, *_ = arguments
                    assert code == b"code\0" and count == 1
                    assert (options[0], values[0]) == (0, 128)
                if name == "cuLaunchKernel":
                    _, *grid, stream, pointers, extra = arguments
                    assert grid[1:3] == [1, 1] and grid[3:] == [32, 1, 1, 0] and extra is None
                    assert stream.value == 0x51
                    grains, blocks, *buffers, _, size = (
                        ctypes.c_int64.from_address(pointers[n]).value for n in range(14)
                    )
                    assert size == 8 * memory.words_needed(grains, 32)
                    team_on_processor.advance_replicas(grid[0], grains, blocks, buffers)
                return self.error

            return function

    def call_xla(api: int, function: int, *fields: int) -> tuple[int, int | None]:
        return (0x51, None) if function == handler._STREAM_GET else original(api, function, *fields)

    original, driver = handler.call_xla, Driver()
    monkeypatch.setattr(handler, "driver", lambda: driver)
    monkeypatch.setattr(handler, "kept_ptx", lambda: "code")
    handler.kernel.cache_clear()
    monkeypatch.setattr(handler, "call_xla", call_xla)
    monkeypatch.setattr(environment, "default_device", lambda: SimpleNamespace(platform="gpu"))
    monkeypatch.setattr(call, "register", lambda: None)
    monkeypatch.setattr(ffi, "TARGET", f"jaxgran_acted_{next(TARGETS)}")
    handler.register_handler(ffi.TARGET, "cpu", handler.launch_on_stream)
    yield SimpleNamespace(asked=asked, driver=driver)
    handler.kernel.cache_clear()


def test_a_batch_is_one_launch_with_the_bits_of_each_replica_alone(device) -> None:
    flow, state = flow_and_state(0.5, 0.6, grains=32)
    states = jax.tree.map(lambda x: jnp.stack([x] * 3), state)
    steps = jnp.array([10, 20, 30])

    def called(state: jg.State, steps) -> call.NumbaCall:
        return call_numba(flow, SOLVER, state, steps[None], first_row(flow, state))

    batch = jax.block_until_ready(jax.jit(jax.vmap(called))(states, steps))
    assert device.asked.count("cuLaunchKernel") == 1
    for n in range(3):
        alone = jax.jit(called)(state, steps[n])
        for name in ("positions", "velocities", "blocks"):
            assert np.array_equal(getattr(batch, name)[n], getattr(alone, name))
    _, tally = jg.advance(flow, state, steps[2], engine=jg.Numba())
    assert tally.impulse == batch.blocks[2, 0, place_of("impulse")]


def test_an_error_of_the_driver_is_an_error_of_jax(device) -> None:
    flow, state = flow_and_state(0.5, 0.6, grains=32)
    device.driver.error = 700
    with pytest.raises(Exception, match="CUDA driver returned the error 700"):
        jax.block_until_ready(jg.advance(flow, state, jnp.int32(5), engine=jg.Numba()))


def test_on_a_device_the_engine_numba_must_be_asked_for(device) -> None:
    flow, state = flow_and_state(0.5, 0.6, grains=32)
    assert engine.select_engine(engine.DEFAULT_NUMERICS, state) == jg.Jax()
    assert engine.select_engine(engine.Numerics(engine=jg.Numba()), state) == jg.Numba()
    with refused("observes on a processor only"):
        jg.advance(flow, state, jnp.int32(5), engine=jg.Numba(), observe=lambda now: now.state.side)
