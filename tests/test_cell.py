"""The sheared cell: displacements, wrapping, its tilt, and the velocity jump between image rows."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import nearest_image

from jaxgran.model.cell import cell_side, displacement, relative_velocity, remap_tilt, wrap

EPS = np.finfo(float).eps
POINTS = 64

measured = jax.jit(displacement)
wrapped = jax.jit(wrap)
remapped_tilt = jax.jit(remap_tilt)
side_of_cell = jax.jit(cell_side)
relative = jax.jit(relative_velocity)

cells = given(st.integers(0, 2**32 - 1), st.floats(2, 50), st.floats(-0.5, 0.5, exclude_max=True))
modest = settings(max_examples=30)


def points(seed: int, side: float) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, side, (2, POINTS, 2))


def lattice_coordinates(vectors, side, tilt) -> np.ndarray:
    """Coordinates along the lattice vectors: whole numbers for a vector of the lattice."""
    x, y = np.moveaxis(np.asarray(vectors), -1, 0)
    return np.stack([(x - tilt * y) / side, y / side], axis=-1)


def assert_whole(numbers, scale: float = 1.0):
    np.testing.assert_allclose(numbers, np.round(numbers), rtol=0, atol=64 * EPS * scale)


@modest
@cells
def test_displacement_is_the_shortest_image(seed, side, tilt):
    to, origin = points(seed, side)
    displacements = np.asarray(measured(to, origin, side, tilt))
    shortest = nearest_image(to - origin, side, tilt)
    assert_whole(lattice_coordinates(displacements - (to - origin), side, tilt))
    short = np.linalg.norm(shortest, axis=-1) < side / 2 * (1 - 4 * EPS)
    np.testing.assert_allclose(displacements[short], shortest[short], rtol=0, atol=8 * EPS * side)
    assert np.all(np.linalg.norm(displacements[~short], axis=-1) >= side / 2 * (1 - 8 * EPS))


@modest
@cells
def test_wrap_gives_the_image_in_the_cell(seed, side, tilt):
    positions = points(seed, side)[0] * 8 - 3 * side
    positions[:4] = [[0, side], [side, 0], [-1e-18 * side, -1e-18 * side], [0, -2 * side]]
    inside = np.asarray(wrapped(positions, side, tilt))
    assert np.all((inside >= 0) & (inside < side))
    assert_whole(lattice_coordinates(inside - positions, side, tilt), 8)


@modest
@given(st.floats(-1e3, 1e3))
def test_tilt_is_remapped_by_a_whole_number(tilt):
    remapped = float(remapped_tilt(tilt))
    assert -0.5 <= remapped < 0.5
    assert_whole(tilt - remapped, 1e3)


@modest
@cells
def test_remapped_tilt_is_the_same_lattice(seed, side, tilt):
    to, origin = points(seed, side)
    short = np.linalg.norm(nearest_image(to - origin, side, tilt), axis=-1) < 0.49 * side
    here, there = (np.asarray(measured(to, origin, side, other)) for other in (tilt, tilt + 1))
    np.testing.assert_allclose(here[short], there[short], rtol=0, atol=16 * EPS * side)


@modest
@cells
def test_separations_of_images_change_at_the_relative_velocity(seed, side, tilt):
    """Grains fly straight in the laboratory, image rows slide: so separations change linearly."""
    rng = np.random.default_rng(seed)
    positions = points(seed, side)[0]
    velocities = rng.normal(size=(POINTS, 2))
    shear_rate = 1.3
    time = 1e-3
    i, j = np.arange(POINTS), np.roll(np.arange(POINTS), 1)
    before = np.asarray(measured(positions[i], positions[j], side, tilt))
    laboratory = velocities + shear_rate * positions[:, 1:] * [1, 0]
    later = positions + time * laboratory
    after = np.asarray(measured(later[i], later[j], side, tilt + shear_rate * time))
    u = np.asarray(relative(velocities, i, j, before, shear_rate))
    short = np.linalg.norm(before, axis=-1) < 0.5 * side - 2 * time * np.linalg.norm(u, axis=-1)
    assert np.sum(short) > POINTS / 4
    jumps = np.abs(positions[i] - positions[j] - before)[:, 1] > side / 2
    assert np.any(short & jumps)
    np.testing.assert_allclose(
        (after - before)[short], (time * u)[short], rtol=0, atol=32 * EPS * side
    )


@modest
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.83))
def test_cell_has_the_packing_fraction(seed, packing_fraction):
    radii = np.random.default_rng(seed).uniform(0.3, 0.7, POINTS)
    side = float(side_of_cell(radii, packing_fraction))
    assert np.sum(np.pi * radii**2) / side**2 == pytest.approx(packing_fraction, rel=POINTS * EPS)
