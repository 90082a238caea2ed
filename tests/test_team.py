"""The engine for CUDA devices, on a processor: against that of processors, for races, acted."""

import ctypes
import os
import subprocess
import sys
from functools import cache
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numba
import numpy as np
import pytest
import team_on_processor
from synthetic import refused

import jaxgran as jg
from jaxgran import environment
from jaxgran.dynamics import engine
from jaxgran.dynamics.numba_engine import call, ffi, layout
from jaxgran.dynamics.numba_engine.call import call_numba, first_row
from jaxgran.dynamics.numba_engine.team import handler, linking
from jaxgran.dynamics.numba_engine.team.memory import memory_at, words_needed
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


def found_by_races(tmp_path: Path, grains: int = 24, without: str = "") -> tuple:
    flow, state = flow_and_state(0.5, 0.75, grains=grains)
    file = tmp_path / "state.npz"
    inputs = [state.side, flow.restitution, flow.timestep, 1.0, 1e-10, flow.activation, 1000]
    arrays = {name: getattr(state, name) for name in ("positions", "velocities")}
    arrays |= {name: getattr(state.grains, name) for name in ("radii", "masses")}
    arrays |= {"steps": np.array([15.0, 15.0]), "inputs": np.array(inputs, float)}
    np.savez(file, **arrays, begin=first_row(flow, state))
    script, plain = Path(__file__).with_name("team_races.py"), {"NUMBA_DISABLE_JIT": "1"}
    command = [sys.executable, str(script), str(file), "4", without]
    run = subprocess.run(
        command, env=os.environ | plain, capture_output=True, text=True, timeout=300
    )
    barriers, *wrong = run.stdout.splitlines()
    expected = by_numba(flow, state, steps=np.array([15, 15])).positions
    end = np.load(tmp_path / "state_end.npz")["positions"]
    return int(barriers), wrong, np.abs(end - expected).max()


@pytest.mark.parametrize("grains", [16, 24])  # too few for a grid of cells, and enough
def test_no_lane_touches_what_another_one_writes_between_two_barriers(
    tmp_path: Path, grains: int
) -> None:
    barriers, wrong, difference = found_by_races(tmp_path, grains)
    assert barriers > 20 and not wrong
    assert difference < 1e-8


@pytest.mark.parametrize(
    ("without", "grains"),
    [(name, 24) for name in ("_predict", "_colour", "_sort_into_cells", "_solve", "_go_on")]
    + [("_bring_into_cell", 16)],
)
def test_a_barrier_that_is_left_out_is_found(tmp_path: Path, without: str, grains: int) -> None:
    assert found_by_races(tmp_path, grains, without)[1]


def test_more_contacts_of_a_grain_than_colours_are_relaxed_in_turn() -> None:
    """A large disc that is hit by forty small ones at once."""
    angles = 2 * np.pi * np.arange(40) / 40
    outside = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    diameters = np.array([20.0] + [1.0] * 40)
    grains = jg.own_grains(diameters)
    mean = diameters.mean()
    side = 60 / mean
    positions = np.concatenate([[[0, 0]], (10.5 - 1e-5) * outside]) / mean + side / 2
    velocities = np.concatenate([[[0, 0]], -10 * outside * (1 + 0.1 * np.cos(3 * angles))[:, None]])
    fraction = float(np.pi / 4 * np.sum((diameters / mean) ** 2) / side**2)
    flow = jg.ShearFlow(41, 0.5, fraction, 1e-4)
    tilt = jnp.zeros(())
    state = jg.State(
        grains, jnp.asarray(positions), jnp.asarray(velocities), jnp.asarray(side), tilt
    )
    steps = np.array([3])
    positions, velocities, blocks = by_team(flow, state, lanes=4, steps=steps)
    expected = by_numba(flow, state, steps=steps)
    assert blocks[0, layout.STATUS] == 0
    assert blocks[0, place_of("collisions")] >= 40
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
def test_the_memory_of_a_team_holds_its_arrays(grains: int, lanes: int) -> None:
    end = numba.njit(lambda at, count, lanes: memory_at(at, count, lanes)[1])(0, grains, lanes)
    assert end <= 8 * words_needed(grains, lanes) < end + 512


def test_the_kernel_needs_nothing_but_the_device() -> None:
    """PTX without calls of other functions; where there is an assembler, it takes it."""
    code = linking.ptx()
    assert f".visible .entry {layout.KERNEL}" in code and code.count("bar.warp.sync") > 20
    assert code.count("shfl.sync.idx.b32") > 20 and "vote.sync.ballot.b32" in code
    assert ".extern" not in code and "call" not in code.replace("call_", "")
    from importlib.util import find_spec

    if (package := find_spec("nvidia")) is None:
        return
    for place in package.submodule_search_locations or ():
        for assembler in Path(place).glob("*/bin/ptxas"):
            run = subprocess.run(
                [assembler, "-arch=sm_90", "-", "-o", os.devnull], input=code.encode()
            )
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
                    assert size == 8 * words_needed(grains, 32)
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
