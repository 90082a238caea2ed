"""The restitution of discs is found again from what was seen of them, with an interval that is true to its name."""

from dataclasses import replace

import numpy as np
import pytest
from observed import FRAMES, GRAINS, RESTITUTION, noisy, tracks, without_velocities
from synthetic import one_sentence, refused

from jaxgran.inference.collisions import flights_of
from jaxgran.inference.restitution import fit_restitution
from jaxgran.io.tracks import Tracks, displacements
from jaxgran.model.checks import InputError

SEEN = {
    "exactly": lambda seen: seen,
    "velocities with 5 % of noise": lambda seen: noisy(seen, 1e-3, 0.05),
    "a tenth missing": lambda seen: noisy(seen, 1e-4, 0.01, 0.1),
    "positions alone": lambda seen: without_velocities(noisy(seen, 1e-4, 0.0)),
    "positions alone, noisier": lambda seen: without_velocities(noisy(seen, 1e-3, 0.0)),
}


@pytest.mark.parametrize(
    ("restitution", "how"), list(zip((0.95, 0.3, RESTITUTION, RESTITUTION, 0.3), SEEN, strict=True))
)
def test_restitution_is_found_again(restitution: float, how: str) -> None:
    fit = fit_restitution(SEEN[how](tracks(restitution)))
    assert abs(fit.restitution - restitution) < 4 * fit.stderr < 0.06
    assert fit.low <= fit.restitution <= fit.high
    assert fit.high - fit.low == pytest.approx(3.92 * fit.stderr, rel=0.2) or fit.high == 1
    assert fit.collisions > 20


def test_noise_is_measured() -> None:
    fit = fit_restitution(noisy(tracks(), 1e-3, 0.05))
    velocities = noisy(tracks(), 0.0, 0.05).velocities - tracks().velocities
    assert fit.position_noise == pytest.approx(1e-3, rel=0.1)
    assert fit.velocity_noise == pytest.approx(np.std(velocities), rel=0.1)
    assert fit.misfit < 1.2


@pytest.mark.parametrize("error", [0.0, 0.03])
def test_error_of_the_diameters_is_measured(error: float) -> None:
    """That of a distance at contact has two of these in it, each by half."""
    seen = tracks()
    diameters = seen.diameters + error * np.random.default_rng(0).normal(size=seen.diameters.shape)
    fit = fit_restitution(replace(noisy(seen, 1e-4, 0.01), diameters=diameters))
    assert error / np.sqrt(2) / 1.5 <= fit.diameter_noise <= error / np.sqrt(2) * 1.5 + 1e-3
    assert abs(fit.restitution - RESTITUTION) < 4 * fit.stderr < 0.01


def test_units_do_not_matter() -> None:
    """Lengths in pixels and times in frames."""
    seen = noisy(tracks(), 1e-4, 0.01)
    during = np.diff(seen.time).mean()
    lengths = {name: 37 * getattr(seen, name) for name in ("diameters", "positions", "cell")}
    times = {"time": seen.time / during, "shear_rate": during}
    pixels = replace(seen, masses=5 * seen.masses, velocities=37 * during * seen.velocities, **lengths, **times)
    one, other = fit_restitution(seen), fit_restitution(pixels)
    assert other.restitution == pytest.approx(one.restitution, abs=1e-9)
    assert other.position_noise == pytest.approx(37 * one.position_noise, rel=1e-6)
    assert abs(one.restitution - RESTITUTION) < 4 * one.stderr


def test_a_region_of_the_cell_suffices() -> None:
    """Discs that enter and leave it, and no cell: pairs that meet through its sides are not seen."""
    seen = noisy(tracks(), 1e-4, 0.01)
    inside = np.all((seen.positions > 1) & (seen.positions < seen.cell[0, 0] - 2), axis=-1)[..., None]
    region = replace(
        seen,
        positions=np.where(inside, seen.positions, np.nan),
        velocities=np.where(inside, seen.velocities, np.nan),
        cell=np.tile([np.inf, np.inf, 0.0], (FRAMES, 1)),
        shear_rate=0.0,
    )
    fit, whole = fit_restitution(region), fit_restitution(seen)
    assert abs(fit.restitution - RESTITUTION) < 4 * fit.stderr < 0.01
    assert 10 < fit.collisions < whole.collisions


def test_a_disc_flies_straight_on_through_the_sides_of_a_sheared_cell() -> None:
    """Two discs that never meet, seen in the cell; the second leaves it at the top, and is not seen in one frame."""
    time, side, velocities = np.linspace(0, 3, 31), 5.0, np.array([[0.0, 0.0], [0.8, 2.5]])
    straight = np.array([[1.0, 1.0], [3.0, 4.0]]) + time[:, None, None] * velocities
    rows = np.floor(straight[..., 1] / side)
    columns = np.floor((straight[..., 0] - rows * side * time[:, None]) / side)
    image = np.stack([columns + rows * time[:, None], rows], axis=-1) * side
    moving = velocities - side * np.stack([rows, 0 * rows], axis=-1)
    places, cell = straight - image, np.stack([side + 0 * time, side + 0 * time, side * time], axis=-1)
    places[20, 1], moving[20, 1] = np.nan, np.nan
    flights, length, _ = flights_of(Tracks(time, np.ones(2), np.ones(2), places, moving, cell, 1.0))
    assert rows.max() == 2 and np.isnan(flights.positions[20, 1]).all()
    seen = np.isfinite(places)
    np.testing.assert_allclose(flights.positions[seen], straight[seen], atol=1e-12)
    assert length == 1


def lasting_contacts(seen: Tracks, frames: int) -> Tracks:
    """The same with means over some frames: a collision then takes as long as these."""
    unwrapped = seen.positions[0] + np.concatenate([np.zeros((1, GRAINS, 2)), np.cumsum(displacements(seen), axis=0)])
    mean = [np.mean([x[k : len(x) - frames + k] for k in range(frames)], axis=0) for x in (unwrapped, seen.velocities)]
    whole = np.tile([np.inf, np.inf, 0.0], (len(seen.time) - frames, 1))
    return replace(seen, time=seen.time[frames:], positions=mean[0], velocities=mean[1], cell=whole)


@pytest.mark.parametrize("known", [True, False], ids=["velocities", "positions_alone"])
def test_contacts_that_outlast_a_frame_are_refused(known: bool) -> None:
    """They would be taken for collisions of a small restitution."""
    seen = tracks()
    lasting = lasting_contacts(seen, 4)
    with pytest.raises(InputError, match=r"contacts that are shorter .* read with stride=[3-9]"):
        fit_restitution(lasting if known else without_velocities(lasting))


def test_collisions_outside_of_their_noise_are_refused() -> None:
    """All discs have collided between two frames, so that no track is straight and no noise can be measured."""
    seen = noisy(tracks(seed=1, strain=59 * 0.4), 1e-4, 0.01)
    parts = {name: getattr(seen, name)[:7] for name in ("time", "positions", "velocities", "cell")}
    with refused("more frames in the same time"):
        fit_restitution(replace(seen, **parts))


def test_discs_of_several_restitutions_are_told() -> None:
    """Three flows side by side: whichever restitution is found, most collisions are of another one."""
    flows = [noisy(tracks(alpha), 1e-4, 0.01) for alpha in (0.3, 0.6, 0.95)]
    positions = [seen.positions + np.array([20.0 * k, 0]) for k, seen in enumerate(flows)]
    together = Tracks(
        flows[0].time,
        np.concatenate([seen.diameters for seen in flows]),
        np.concatenate([seen.masses for seen in flows]),
        np.concatenate(positions, axis=1),
        np.concatenate([seen.velocities for seen in flows], axis=1),
        np.tile([np.inf, np.inf, 0.0], (FRAMES, 1)),
        0.0,
    )
    with pytest.warns(UserWarning, match=r"the interval may be too narrow, as .* restitutions differ") as told:
        fit = fit_restitution(together)
    assert fit.rejected >= fit.collisions
    assert one_sentence(str(told[0].message))


def test_mismatched_ids_change_little() -> None:
    """In a tenth of the frames two near discs have each other's id."""
    seen = noisy(tracks(), 1e-4, 0.01)
    positions, velocities = seen.positions.copy(), seen.velocities.copy()
    for k in range(5, FRAMES, 10):
        apart = np.linalg.norm(positions[k, 0] - positions[k, 1:], axis=-1)
        swapped = [0, 1 + int(np.argmin(apart))]
        positions[k, swapped], velocities[k, swapped] = positions[k, swapped[::-1]], velocities[k, swapped[::-1]]
    fit = fit_restitution(replace(seen, positions=positions, velocities=velocities))
    assert abs(fit.restitution - RESTITUTION) < 4 * fit.stderr < 0.01


def at_rest(seen: Tracks) -> Tracks:
    return replace(seen, positions=seen.positions[:1] + np.zeros((FRAMES, 1, 1)), velocities=0 * seen.velocities)


def elsewhere(seen: Tracks) -> Tracks:
    return replace(seen, positions=np.random.default_rng(0).uniform(0, 11, seen.positions.shape))


def twice(seen: Tracks) -> Tracks:
    parts = {name: getattr(seen, name)[:2] for name in ("time", "positions", "velocities", "cell")}
    return without_velocities(replace(seen, **parts))


NOTHING = {"no collisions": at_rest, "frames too far apart": elsewhere, "positions in two frames": twice}


@pytest.mark.parametrize("why", NOTHING)
def test_where_nothing_is_to_be_learnt_a_sentence_says_so(why: str) -> None:
    with refused(r"^tracks must show .* take"):
        fit_restitution(NOTHING[why](tracks()))
