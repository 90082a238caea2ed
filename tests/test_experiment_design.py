"""The error of a restitution is known before the tracks are measured."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from observed import FRAMES, STRAIN, noisy, tracks
from synthetic import refused

import jaxgran as jg

FLOW = jg.ShearFlow(64, 0.6, 0.5, 1e-3)
FRAME_STRAIN = STRAIN / (FRAMES - 1)  # of the tracks of ``observed``
POSITION, VELOCITY = 1e-3, 0.05  # the latter of a typical velocity
RUNS = 4


@cache
def seen(run: int) -> jg.Tracks:
    """The first 24 frames."""
    whole = noisy(tracks(seed=run), POSITION, VELOCITY, seed=run)
    parts = {name: getattr(whole, name)[:24] for name in ("time", "positions", "velocities", "cell")}
    return replace(whole, **parts)


@cache
def velocity_noise() -> float:
    return float(np.mean([np.std(seen(run).velocities - tracks(seed=run).velocities[:24]) for run in range(RUNS)]))


@cache
def expected(frames: int = 24, larger: float = 1.0, **options) -> jg.FisherInformation:
    noise = jg.TrackNoise(larger * POSITION, larger * velocity_noise())
    return jg.fisher_information(FLOW, frames, noise, frame_strain=FRAME_STRAIN, **options)


def test_error_of_fits_is_predicted() -> None:
    """Tracks of the event-driven reference; both the errors that fits state and how far they are off."""
    fits = [jg.fit_restitution(seen(run)) for run in range(RUNS)]
    predicted = expected()
    information = np.array([fit.stderr**-2 for fit in fits])
    error = np.hypot(
        information.std(ddof=1) / np.sqrt(RUNS) / information.mean(), 2 * predicted.stderr_error / predicted.stderr
    )
    assert error < 0.3
    assert abs(information.mean() / predicted.information - 1) < 3 * error
    off = np.array([fit.restitution - 0.6 for fit in fits]) / predicted.stderr
    assert 0.3 < np.sum(off**2) < 15  # χ² of four: 1 % of trials are below, 0.5 % above
    assert predicted.collisions == pytest.approx(np.mean([fit.collisions for fit in fits]), rel=0.3)
    assert 0.5 < predicted.usable <= 1


def test_error_falls_as_one_over_the_root_of_frames_and_grains() -> None:
    """From 60 frames on, apart from the first and the last ones; a part of these is simulated."""
    few, many = expected(FRAMES), expected(100 * FRAMES)
    assert 10 * many.stderr == pytest.approx(few.stderr, rel=0.12)
    assert 10 * many.stderr < few.stderr  # flights are cut off at both ends
    noise = jg.TrackNoise(POSITION, velocity_noise())
    large = jg.fisher_information(jg.ShearFlow(6400, 0.6, 0.5, 1e-3), FRAMES, noise, frame_strain=FRAME_STRAIN)
    assert 10 * large.stderr == pytest.approx(few.stderr, rel=1e-9)
    assert large.collisions == pytest.approx(100 * few.collisions, rel=1e-9)


def test_error_grows_with_noise_and_with_what_is_not_seen() -> None:
    assert expected(larger=2.0).stderr == pytest.approx(2 * expected().stderr, rel=0.2)  # some are lost in the noise
    assert expected(larger=2.0).stderr > expected().stderr
    assert expected(missing=0.2).stderr > expected().stderr


def test_shares_are_the_derivatives_by_the_noise() -> None:
    better = jg.fisher_information(FLOW, 24, jg.TrackNoise(POSITION, 0.9 * velocity_noise()), frame_strain=FRAME_STRAIN)
    found = expected()
    assert np.log(better.stderr / found.stderr) == pytest.approx(np.log(0.9) * found.velocity_share, abs=0.03)


def test_shares_say_what_better_measurements_would_help() -> None:
    """The variance is of first degree in those of the noise, so that its logarithmic derivatives add up to one."""
    found = expected()
    assert found.position_share + found.velocity_share + found.diameter_share == pytest.approx(1, abs=1e-3)
    assert min(found.position_share, found.velocity_share) > 0
    assert found.diameter_share == pytest.approx(0, abs=1e-3)


NOISE = jg.TrackNoise(1e-3)
MISTAKES = {
    "flow must be a ShearFlow": {"flow": 3},
    "shear_rate must be above 0": {"flow": jg.ShearFlow(64, 0.6, 0.5, 1e-3, shear_rate=0.0)},
    "noise must be a TrackNoise": {"noise": 1e-3},
    "missing must be at least 0 and below 1": {"missing": 1.0},
    "nothing will be learnt at a frame_strain of 1, .* take about 0.0": {"frame_strain": 1.0},
    "nothing will be learnt from 0 collisions, .* more frames, or less noise": {"frames": 2},
}


@pytest.mark.parametrize("words", MISTAKES)
def test_mistakes_and_where_nothing_will_be_learnt(words: str) -> None:
    given = {"flow": FLOW, "frames": 24, "noise": NOISE} | MISTAKES[words]
    with refused(f"^{words}"):
        jg.fisher_information(**given)
