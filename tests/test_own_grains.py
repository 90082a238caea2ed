"""Any sizes and masses: packed without overlap, no contact missed, heated as theory says."""

import re
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS
from oracles import build, gaps_of, listed_pairs, pairs_within
from scipy.special import ndtri
from synthetic import refused

from jaxgran.contact.near_pairs import widest_skin
from jaxgran.model.cell import cell_side
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains, own_grains, polydisperse
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.heated import heated
from jaxgran.sampling.packing import pack, require_room
from jaxgran.sampling.prediction import size_classes
from jaxgran.sampling.sampler import sample
from jaxgran.sampling.steady_state import prepare
from jaxgran.theory.gaussian_moments import gaussian_moments, mixture_moments

EVEN = np.arange(GRAINS) % 2 == 0
LAWS = {
    "1 to 3": np.where(EVEN, 1.0, 3.0),
    "1 to 5": np.where(EVEN, 1.0, 5.0),
    "one of 2.5": np.where(np.arange(GRAINS) == 7, 2.5, 1.0),
    "lognormal": np.exp(0.5 * ndtri((np.arange(GRAINS) + 0.5) / GRAINS)),
}


def flow_of(packing_fraction: float = 0.7, **change) -> ShearFlow:
    return replace(ShearFlow(GRAINS, 0.6, packing_fraction, 1e-3), **change)


@pytest.fixture(scope="module")
def packed_own():
    """``packed_own(law, packing_fraction)``: a packing at rest, by ``packed_own.compiled``."""
    compiled = jax.jit(pack)

    @cache
    def packing(law: str, packing_fraction: float) -> State:
        state, found = compiled(flow_of(packing_fraction), jax.random.key(0), own_grains(LAWS[law]))
        assert found
        return state

    packing.compiled = compiled
    return packing


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("packing_fraction", [0.2, 0.8])
def test_packing_has_the_grains_no_overlap_and_the_packing_fraction(
    packed_own, law, packing_fraction
):
    state = packed_own(law, packing_fraction)
    side, radii = float(state.side), np.asarray(state.grains.radii)
    np.testing.assert_allclose(2 * radii, LAWS[law] / LAWS[law].mean(), rtol=1e-14)
    assert np.min(gaps_of(state.positions, radii, side, 0.0)) >= 0
    assert np.sum(np.pi * radii**2) / side**2 == pytest.approx(packing_fraction, rel=1e-13)


@pytest.mark.parametrize("law", ["1 to 5", "lognormal"])
def test_a_flow_stays_apart_conserves_momentum_and_balances_its_energy(packed_own, run, law):
    state, rng = packed_own(law, 0.8), np.random.default_rng(0)
    masses = np.where(EVEN, 3.0, 0.05)  # small and heavy, large and hollow
    velocities = rng.normal(size=(GRAINS, 2)) / np.sqrt(masses)[:, None]
    velocities -= masses @ velocities / masses.sum()
    grains = Grains(state.grains.radii, jnp.asarray(masses))
    start = replace(state, grains=grains, velocities=jnp.asarray(velocities))
    end, tally = run(flow_of(0.8, timestep=1e-4), start, 2000)
    gaps = gaps_of(end.positions, end.grains.radii, float(end.side), float(end.tilt))
    assert np.min(gaps) > -1e-2 and tally.collisions > 100
    assert tally.status in (Status.ok, Status.iteration_limit)
    assert tally.momentum_drift < 1e-12
    work = -tally.contact_moment[0, 1] - tally.kinetic_moment[0, 1]
    assert work - tally.dissipation == pytest.approx(
        float(tally.energy_change), abs=1e-9 * float(tally.dissipation)
    )


def test_evenly_spaced_diameters_are_no_polydispersity() -> None:
    """The flow has the default one, which grains of one's own do not use."""
    flow, grains = flow_of(), own_grains(np.linspace(0.74, 1.26, GRAINS))
    state = prepare(flow, jax.random.key(0), equilibrate=0.1, grains=grains)
    assert sample(flow, state, 0.1)[1].pressure > 0


def test_masses_are_a_unit(packed_own, run):
    """Twice the masses: the same motion to the bit, and twice the impulses."""
    state = packed_own("1 to 3", 0.8)
    state = replace(
        state, velocities=jnp.asarray(np.random.default_rng(2).normal(size=(GRAINS, 2)))
    )
    heavy = replace(state, grains=Grains(state.grains.radii, 2 * state.grains.masses))
    (end, tally), (heavy_end, heavy_tally) = (run(flow_of(0.8), one, 500) for one in (state, heavy))
    np.testing.assert_array_equal(heavy_end.positions, end.positions)
    np.testing.assert_array_equal(heavy_end.velocities, end.velocities)
    np.testing.assert_array_equal(heavy_tally.contact_moment, 2 * tally.contact_moment)
    assert tally.solves > 50


def test_a_small_heavy_disc_throws_a_large_hollow_one(run, scene):
    before = scene([[5.0, 4.0], [6.0 + 5e-4, 4.0]], [[2.0, 0.0], [0.0, 0.0]], radii=[0.25, 0.75])
    masses = np.ones(GRAINS)
    masses[:2] = 3.0, 0.5
    before = replace(before, grains=Grains(before.grains.radii, jnp.asarray(masses)))
    after, tally = run(flow_of(0.02), before, 1)
    laboratory = np.asarray(after.velocities)[:2, 0] + 4.0
    centre = 6.0 / 3.5  # u⁺ = −α u⁻ about the centre of mass
    np.testing.assert_allclose(
        laboratory, [centre - 0.6 * 0.5 / 3.5 * 2, centre + 0.6 * 3.0 / 3.5 * 2], rtol=1e-12
    )
    assert tally.collisions == 1


def test_start_and_prepare_keep_the_grains_and_heat_them_alike():
    grains = own_grains(LAWS["1 to 3"], np.where(EVEN, 3.0, 0.05))
    flow = flow_of(timestep=1e-3)
    state = heated(flow, jax.random.key(1), 0.25, grains)
    masses, velocities = np.asarray(grains.masses)[:, None], np.asarray(state.velocities)
    assert np.sum(masses * velocities**2) / (2 * GRAINS) == pytest.approx(0.25, rel=1e-12)
    np.testing.assert_allclose(np.sum(masses * velocities, axis=0), 0, atol=1e-12)
    prepared = prepare(flow, jax.random.key(1), equilibrate=0.05, grains=grains)
    keys = jax.random.split(jax.random.key(1), 2)
    both = prepare(flow, keys, equilibrate=0.05, grains=grains)
    alone = prepare(flow, keys[1], equilibrate=0.05, grains=grains)
    jax.tree.map(np.testing.assert_array_equal, both[1], alone)
    for one in (state, prepared, alone):
        np.testing.assert_array_equal(one.grains.radii, grains.radii)
        np.testing.assert_array_equal(one.grains.masses, grains.masses)
    assert prepared.tilt != 0 and np.all(np.isfinite(prepared.velocities))


def test_theory_of_given_grains_is_that_of_their_law():
    """Eight classes of diameters stand for the law as its quadrature does; masses are a unit."""
    grains = polydisperse(256, 0.26, jax.random.key(0))
    diameters, masses, fractions = size_classes(grains)
    given = mixture_moments(0.8, 0.6, 1.0, diameters, masses, fractions)
    law = gaussian_moments(0.8, 0.6, 1.0, 0.26)
    doubled = mixture_moments(0.8, 0.6, 1.0, diameters, 2 * masses, fractions)
    for name in ("granular_temperature", "pressure", "shear_stress", "collision_rate"):
        assert getattr(given, name) == pytest.approx(float(getattr(law, name)), rel=1e-2)
        unit = 1 if name == "collision_rate" else 2
        assert getattr(doubled, name) == pytest.approx(unit * float(getattr(given, name)), rel=1e-6)


@pytest.mark.parametrize(
    ("sizes", "error"),
    [([1] * 15 + [3], 1e-9), ([1, 1, 1, 2, 2, 4], 1e-9), (np.geomspace(0.3, 3, 20), 5e-3)],
)
def test_theory_of_few_species_is_that_of_each_and_of_wide_distributions_nearly(sizes, error):
    """Against a class for every single grain; a heavier half of the grains are species too."""
    diameters = np.repeat(np.asarray(sizes, float) / np.mean(sizes), 2)
    masses = diameters**2 * (np.tile([1.0, 3.0], len(sizes)) if error < 1e-8 else 1.0)
    grains = Grains(jnp.asarray(diameters / 2), jnp.asarray(masses))
    each = np.full(diameters.size, 1 / diameters.size)
    classes = mixture_moments(0.5, 0.7, 1.0, *size_classes(grains))
    whole = mixture_moments(0.5, 0.7, 1.0, diameters, masses, each)
    for name in ("granular_temperature", "pressure", "shear_stress", "collision_rate"):
        assert getattr(classes, name) == pytest.approx(float(getattr(whole, name)), rel=2 * error)


@pytest.mark.parametrize("heavy", [100.0, 1e4])
@pytest.mark.parametrize("nu", [0.2, 0.8])
def test_theory_of_one_heavy_disc_among_many_is_found(heavy, nu):
    discs = own_grains(np.ones(128), np.append(np.ones(127), heavy))
    theory = mixture_moments(0.5, nu, 1.0, *size_classes(discs))
    assert all(np.isfinite(x) for x in jax.tree.leaves(theory))
    power = theory.shear_stress  # at a shear rate of one
    assert theory.dissipation_rate == pytest.approx(float(power), rel=1e-6)


def test_cell_lists_of_unlike_grains_are_complete_or_flagged():
    """Six hundred grains at random places, found through cells, against brute force."""
    grains = own_grains(np.where(np.arange(600) % 2, 1.0, 5.0))
    radii = np.asarray(grains.radii)
    for packing_fraction in (0.1, 0.8):
        side = np.sqrt(np.pi * np.sum(radii**2) / packing_fraction)
        positions = np.random.default_rng(0).uniform(0, side, (600, 2))
        hood = build(jnp.asarray(positions), grains, jnp.asarray(side), jnp.asarray(0.3))
        for listed in (hood.outer, hood.near):
            assert not listed.overflow and listed.skin > 0.05
            assert pairs_within(
                float(listed.skin) - 1e-12, positions, radii, side, 0.3
            ) == listed_pairs(listed)


def test_a_packing_of_grains_too_large_for_the_cell_is_not_found_where_they_are_traced(packed_own):
    _, found = packed_own.compiled(
        flow_of(0.8), jax.random.key(0), own_grains(np.where(np.arange(GRAINS) == 7, 5.0, 1.0))
    )
    assert not found


@pytest.mark.parametrize("count", [256, 1000])
def test_a_grain_too_large_for_the_lists_is_refused_and_the_limit_stated_is_one_that_is_accepted(
    count,
):
    def with_one(diameter: float) -> Grains:
        return own_grains(np.append(np.ones(count - 1), diameter))

    def relative(grains: Grains) -> float:
        radii = np.asarray(grains.radii)
        return float(np.max(radii) / np.sqrt(np.mean(radii**2)))

    flow = ShearFlow(count, 0.5, 0.8, 1e-3)
    with refused("the largest diameter must be at most") as caught:
        require_room(flow, with_one(30.0))
    limit = float(re.search(r"at most ([\d.]+) times", str(caught.value))[1])
    below = max(
        (with_one(d) for d in np.arange(1.0, 30.0, 0.1) if relative(with_one(d)) < 0.95 * limit),
        key=relative,
    )
    require_room(flow, below)
    assert relative(below) > 0.8 * limit
    side = cell_side(below.radii, flow.packing_fraction)
    assert float(widest_skin(below, side)) >= 0.2
