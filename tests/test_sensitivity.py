"""Growth of the derivatives of a flow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import EXACT, GRAINS

from jaxgran.analysis.sensitivity import growth, lyapunov_exponent
from jaxgran.model.cell import displacement
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow


def flow_of(restitution) -> ShearFlow:
    return ShearFlow(GRAINS, restitution, 0.6, 1e-3)


def test_growth_is_that_of_two_neighbouring_runs(flowing, run) -> None:
    """At fixed time steps, over a strain in which no contact changes its step."""
    state, steps, change = flowing(0.6), 60, 1e-9
    grown = growth(flow_of(0.6), state, 0.06, 3, moving_contacts=False, solver=EXACT)
    high, low = (run(flow_of(0.6 + sign * change), state, steps)[0] for sign in (1, -1))
    moved = displacement(high.positions, low.positions, high.side, high.tilt)
    squares = np.sum(np.square(moved) + np.square(high.velocities - low.velocities), axis=1)
    assert grown.derivative[-1] == pytest.approx(np.sqrt(np.mean(squares)) / (2 * change), rel=1e-4)
    np.testing.assert_allclose(grown.strain, [0.02, 0.04, 0.06])
    assert np.all(grown.status <= 3) and np.all(np.isfinite(grown.derivative))


def test_exponent_of_exponential_growth_is_found_within_its_error() -> None:
    rng, strain = np.random.default_rng(0), np.linspace(0.1, 4, 40)
    walks = np.cumsum(rng.normal(0, 0.3, (16, 40)), axis=1)
    rate, error = lyapunov_exponent(strain, np.exp(3 * strain + walks))
    assert abs(rate - 3) < 3 * error < 1


def test_mistakes_are_sentences(flowing) -> None:
    with pytest.raises(InputError, match="count must be"):
        growth(flow_of(0.6), flowing(0.6), 0.06, 0)
    with pytest.raises(InputError, match="strain must be"):
        growth(flow_of(0.6), flowing(0.6), 1e-4, 3)
    with pytest.raises(InputError, match="state must be"):
        growth(flow_of(0.6), jax.tree.map(lambda x: jnp.stack([x, x]), flowing(0.6)), 0.06, 3)
