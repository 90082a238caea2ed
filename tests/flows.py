"""Flows of ``GRAINS`` grains, the number that tests share, and when two runs are the same."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.tally import INSTANT, TABLE, Tally
from jaxgran.maps import batches
from jaxgran.maps.replica import Key, Replica
from jaxgran.maps.run_replicas import run_replicas
from jaxgran.maps.settings import MapSettings
from jaxgran.model.cell import displacement
from jaxgran.model.flow import ShearFlow

GRAINS = 32
COUNTS = ("steps", "contacts", "loaded_contacts", "collisions", "solves", "status")

OF_INSTANTS = tuple(name for name, row in TABLE.items() if row["kind"] == INSTANT)  # those of the end of an advance

# Not the same where impulses agree to rounding only: what measures how well a network was solved.
OF_THE_SOLVER = ("residual_counts", "worst_residual", "complementarity", "iterations", "momentum_drift", "overlap")


EXACT = BarzilaiBorwein(tolerance=1e-12, max_steps=100_000)  # contacts are solved to rounding


def flow_of(packing_fraction=0.6, **change) -> ShearFlow:
    """A flow of the shared number of grains."""
    numbers = {"restitution": 0.5, "timestep": 1e-3}
    return ShearFlow(GRAINS, packing_fraction=packing_fraction, **{**numbers, **change})


def stacked(trees: list) -> Any:
    """A batch of replicas."""
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *trees)


def replica(batch: Any, k: int) -> Any:
    """One replica of a batch."""
    return jax.tree.map(lambda leaf: leaf[k], batch)


def assert_same_bits(one: Any, other: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_same_state(one, two, atol: float):
    """Velocities and tilts agree, and positions up to a lattice vector."""
    moved = displacement(one.positions, two.positions, one.side, one.tilt)
    np.testing.assert_allclose(moved, 0, atol=atol)
    np.testing.assert_allclose(one.velocities, two.velocities, rtol=0, atol=atol)
    np.testing.assert_allclose(one.tilt, two.tilt, rtol=0, atol=atol)


def assert_same_tally(one: Tally, two: Tally, rtol: float, but: tuple[str, ...] = ()):
    """Counts agree exactly, sums to a share of the sum itself, and moments to a share of their largest component."""
    for name in COUNTS:
        assert getattr(one, name) == getattr(two, name), name
    for name in set(TABLE) - {*COUNTS, *OF_THE_SOLVER, *but}:
        first, second = np.asarray(getattr(one, name)), np.asarray(getattr(two, name))
        np.testing.assert_allclose(first, second, rtol=0, atol=rtol * np.max(np.abs(second)), err_msg=name)


def in_batches(size: int, settings: MapSettings, **options: Any) -> dict[Key, Replica]:
    """The replicas of a map that are run in batches of a given size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "batch_size", lambda *_: size)
        return dict(run_replicas(settings, **options))
