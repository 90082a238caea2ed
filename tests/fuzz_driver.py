"""A program that advances states and flows of any numbers by the engine that it is given, so that a
fault of the compiled code ends this process and not that of the tests.
"""

import sys
from dataclasses import replace

import conftest  # noqa: F401  # caches, double precision
import jax
import jax.numpy as jnp
import numpy as np
from flows import GRAINS, flow_of
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgran.dynamics.advance import advance_replica
from jaxgran.dynamics.engine import Numerics, engine_named
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status

ROW, STEPS = 6, 30
RNG = np.random.default_rng(0)
GIVEN = {
    "positions": 1.1 * np.stack(np.divmod(np.arange(GRAINS), ROW), axis=-1) + 0.5,
    "velocities": RNG.normal(size=(GRAINS, 2)),
    "radii": RNG.uniform(0.4, 0.6, GRAINS),
    "masses": RNG.uniform(0.5, 2, GRAINS),
    "side": 1.1 * ROW,
    "tilt": 0.2,
    "restitution": 0.5,
    "timestep": 1e-3,
    "shear_rate": 1.0,
    "activation": 0.5,
}
FINITE = st.floats(-300, 308).map(lambda x: 10**x)
ANY = st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -1.0]) | FINITE | st.floats()
CHANGES = st.lists(
    st.tuples(st.sampled_from([*GIVEN]), st.booleans(), st.integers(0, GRAINS - 1), ANY), max_size=2
)


def of_numbers(numbers: dict) -> tuple[ShearFlow, State]:
    """The flow and the state of numbers by the names of ``GIVEN``."""
    state = State(
        Grains(numbers["radii"], numbers["masses"]),
        *(numbers[name] for name in ("positions", "velocities", "side", "tilt")),
    )
    names = "restitution", "timestep", "shear_rate", "activation"
    nu = jnp.pi * jnp.sum(numbers["radii"] ** 2) / numbers["side"] ** 2
    changes = {"packing_fraction": nu, **{name: numbers[name] for name in names}}
    return replace(flow_of(), **changes), state


@jax.jit
def advanced(numbers: dict) -> tuple:
    flow, state = of_numbers(numbers)
    numerics = Numerics(engine=engine_named(sys.argv[1]))
    return advance_replica(flow, state, jnp.asarray([STEPS // 3] * 3, jnp.int32), numerics)


@given(speed=FINITE, timestep=st.sampled_from([1e-6, 1e-3, 0.1]), changes=CHANGES)
def finite_or_flagged(speed, timestep, changes) -> None:
    numbers = {name: np.array(values, float) for name, values in GIVEN.items()}
    numbers["velocities"] *= speed
    numbers["timestep"] *= timestep / 1e-3
    for name, everywhere, place, value in changes:
        numbers[name][(...) if everywhere or numbers[name].ndim == 0 else place] = value
    state, tally = jax.tree.map(np.asarray, advanced(numbers))
    if tally.status.max() < Status.nonfinite:
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((state, tally)))


if __name__ == "__main__":
    # Out of its array an index of machine code reads anything, and one of JAX is clamped
    examples = 500 if sys.argv[1] == "numba" else 100
    settings(max_examples=examples, database=None)(finite_or_flagged)()
