"""A restitution is found from both ends of short windows, and longer windows are refused."""

from contextlib import suppress
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS
from synthetic import refused

import jaxgran as jg
from jaxgran.analysis.fit import TrajectoryFit
from jaxgran.model.cell import displacement

TRUTH, GUESS, WINDOWS, STEPS = 0.73, 0.5, 3, 500
POSITION, VELOCITY = 1e-3, 1e-2  # standard deviations of the noise
FLOW = jg.ShearFlow(GRAINS, TRUTH, 0.6, 1e-4)


@cache
def starts() -> jg.State:
    """States of four sets of windows."""
    keys = jax.random.split(jax.random.key(0), 4 * WINDOWS)
    return jg.prepare(replace(FLOW, timestep=1e-3), keys, equilibrate=2.0)


def noisy(state: jg.State, seed: int) -> jg.State:
    rng, shape = np.random.default_rng(seed), state.positions.shape
    positions = state.positions + POSITION * rng.normal(size=shape)
    velocities = VELOCITY * rng.normal(size=shape)
    return replace(state, positions=positions, velocities=state.velocities + velocities)


@cache
def fit(seed: int, steps: int = STEPS, **options) -> tuple[TrajectoryFit, jg.State]:
    start = starts()[seed * WINDOWS : (seed + 1) * WINDOWS]
    end, _ = jax.jit(jg.advance)(FLOW, start, jnp.int32(steps))
    seen = noisy(start, 10 + seed) if "velocities" in options else start
    options = {"events": 60, **options}  # compiled for all seeds
    flow = replace(FLOW, restitution=GUESS)
    return jg.fit_trajectory(
        flow, seen, noisy(end, seed), steps, POSITION, VELOCITY, **options
    ), start


def test_restitution_is_found_within_its_error_bar() -> None:
    fits = [fit(seed)[0] for seed in range(4)]
    pulls = [(result.restitution - TRUTH) / result.stderr for result in fits]
    assert np.sum(np.abs(pulls) < 2) >= 3 and np.max(np.abs(pulls)) < 4, pulls
    for result in fits:
        assert 1e-4 < result.stderr < 0.02
        assert result.misfit[0] > 5 * result.misfit[-1] and result.misfit[-1] == pytest.approx(
            1, abs=0.5
        )
        assert result.velocities is None and result.positions is None


def test_error_of_a_restitution_is_that_of_the_slopes_of_what_is_seen() -> None:
    """By finite differences: 1/stderr² is the sum of the squared slopes over those of the noise."""
    result, start = fit(0)
    run, width = jax.jit(jg.advance), 0.01
    low, high = (
        run(replace(FLOW, restitution=result.restitution + x), start, jnp.int32(STEPS))[0]
        for x in (-width, width)
    )
    sides, tilts = (jnp.asarray(x)[:, None] for x in (start.side, low.tilt))
    moved = displacement(high.positions, low.positions, sides, tilts)
    slopes = moved / POSITION, (high.velocities - low.velocities) / VELOCITY
    information = sum(np.sum((np.asarray(x) / (2 * width)) ** 2) for x in slopes)
    assert result.stderr * np.sqrt(information) == pytest.approx(1, rel=0.1)


def test_states_at_the_start_are_found_better_than_they_were_seen_or_the_fit_is_refused() -> None:
    """Noise may lead to other collisions, where the misfit stays above what noise explains."""
    fits = {}
    for seed in range(4):
        with suppress(jg.InputError):
            fits[seed] = fit(seed, velocities=True, positions=True)
    assert len(fits) >= 2
    for seed, (result, start) in fits.items():
        assert abs(result.restitution - TRUTH) < 4 * result.stderr
        assert result.stderr > fit(seed)[0].stderr  # what is not known costs precision
        assert result.velocities is not None and result.positions is not None
        assert np.std(result.velocities - start.velocities) < 0.9 * VELOCITY
        assert np.std(result.positions - start.positions) < 0.9 * POSITION


def test_windows_beyond_the_horizon_are_refused() -> None:
    with refused("steps must be fewer"):
        fit(0, 12_000, events=900)


def test_a_window_with_more_contacts_than_events_is_refused() -> None:
    with refused("events must be a whole number of"):
        fit(0, events=2)


def test_windows_that_no_restitution_explains_are_refused() -> None:
    start = starts()[:WINDOWS]
    flow = replace(FLOW, restitution=GUESS)
    with refused("must follow from one restitution"):
        jg.fit_trajectory(flow, start, noisy(start, 0), STEPS, POSITION, VELOCITY, events=60)
