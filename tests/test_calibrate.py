"""The restitution of a made-up observation is found again, with an error that is true to its name."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import one_sentence

from jaxgran.dynamics import plain
from jaxgran.dynamics.snapshots import snapshot_series
from jaxgran.inference.restitution import fit_restitution
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.sampling.packing import pack

GRAINS, FRAMES, STRAIN, NOISE = 64, 100, 0.5, 0.01
TIMES = STRAIN * np.arange(1, FRAMES + 1) / FRAMES

compiled_pack = jax.jit(pack)


@pytest.fixture(autouse=True, scope="module")
def one_buffer() -> Iterator[None]:
    """One size of the contact buffer: each is compiled with its derivatives, which takes longer than all fits."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain, "_FEW_BUFFERS", 1)
        yield


@cache
def trajectory(restitution: float, timestep: float) -> State:
    """Frames of a flow after a strain of one."""
    flow = ShearFlow(GRAINS, restitution, 0.6, timestep, tolerance=1e-9, max_iterations=20_000)
    state, _ = compiled_pack(flow, jax.random.key(1))
    rng = np.random.default_rng(1)
    state = replace(state, velocities=jnp.asarray(rng.normal(size=(GRAINS, 2)) / np.sqrt(state.grains.masses)[:, None]))
    series = snapshot_series(flow, state, 3 * STRAIN, 3 * FRAMES)[1]
    return jax.tree.map(lambda x: x[-FRAMES:], series.state)


def noisy(states: State, seed: int, noise: float = NOISE) -> State:
    """The same with noise on every component of the velocities, in units of their root mean square."""
    scale = noise * np.sqrt(np.mean(np.square(states.velocities)))
    error = scale * np.random.default_rng(seed).normal(size=states.velocities.shape)
    return replace(states, velocities=states.velocities + error)


QUICK = [(0.3, 1e-3), (0.6, 1e-4), (0.9, 1e-3)]
REPEATS = [(0.3, 1e-4), (0.6, 1e-3), (0.9, 1e-4)]


@pytest.mark.parametrize(
    ("restitution", "timestep"), QUICK + [pytest.param(*flow, marks=pytest.mark.slow) for flow in REPEATS]
)
def test_restitution_of_a_noisy_trajectory_is_found_again(restitution: float, timestep: float) -> None:
    """Whatever the time step that it was made with: the runs of the fit have another one."""
    states = trajectory(restitution, timestep)
    fit = fit_restitution(TIMES, noisy(states, 0))
    assert abs(fit.restitution - restitution) < min(0.02, 5 * fit.stderr)
    assert 1e-4 < fit.stderr < 2e-3
    speed = np.sqrt(np.mean(np.square(states.velocities)))
    assert fit.noise / speed == pytest.approx(NOISE, rel=0.15)  # collisions add to it
    assert fit.windows == FRAMES - 1 and fit.collisions > 50 and fit.outliers < 0.1


def test_exact_trajectory_gives_the_restitution_exactly() -> None:
    fit = fit_restitution(TIMES, trajectory(0.6, 1e-4), timestep=1e-4)
    assert abs(fit.restitution - 0.6) < 1e-6


@pytest.mark.slow
def test_standard_error_is_the_scatter_over_repeated_noise() -> None:
    """Over 24 observations; the ratio of the two has a standard error of 1/√46, and noise in the frames that a window
    starts with adds a little to either."""
    fits = [fit_restitution(TIMES, noisy(trajectory(0.6, 1e-3), seed)) for seed in range(24)]
    scatter = np.std([fit.restitution for fit in fits], ddof=1)
    assert abs(scatter / np.mean([fit.stderr for fit in fits]) - 1) < 3 / np.sqrt(46)


def test_unit_of_time_does_not_matter() -> None:
    """Velocities are those of the shear rate that is given."""
    states = noisy(trajectory(0.6, 1e-4), 3)
    slow = replace(states, velocities=states.velocities / 50)
    one, other = fit_restitution(TIMES, states), fit_restitution(TIMES, slow, shear_rate=0.02)
    assert other.restitution == pytest.approx(one.restitution, abs=1e-6)
    assert other.noise * 50 == pytest.approx(one.noise, rel=1e-6)


def frames(states: State, part: slice) -> State:
    return jax.tree.map(lambda x: x[part], states)


MISTAKES = {
    "one frame": lambda t, s: (t[:1], frames(s, slice(1))),
    "one state": lambda t, s: (t, frames(s, slice(0, 1)).velocities[0]),
    "other lengths": lambda t, s: (t[:-1], s),
    "out of order": lambda t, s: (t[::-1], s),
    "not finite": lambda t, s: (t, replace(s, velocities=s.velocities.at[3].set(jnp.nan))),
    "no collisions": lambda t, s: (t * 1e-4, jax.tree.map(lambda x: x[:1].repeat(len(t), axis=0), s)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_cannot_be_fitted_is_one_sentence(mistake: str) -> None:
    times, states = MISTAKES[mistake](TIMES, trajectory(0.6, 1e-4))
    with pytest.raises(InputError) as refused:
        fit_restitution(times, states)
    assert one_sentence(str(refused.value))


@pytest.mark.parametrize("timestep", [0.0, -1.0, np.nan, 1.0, "fast"])
def test_time_step_that_cannot_be_is_one_sentence(timestep) -> None:
    with pytest.raises(InputError, match="timestep must be") as refused:
        fit_restitution(TIMES, trajectory(0.6, 1e-4), timestep=timestep)
    assert one_sentence(str(refused.value))
