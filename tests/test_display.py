"""Objects show themselves in one line: short for any batch, whole, and without a failure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic import random_tally

from jaxgran.model.display import value_text, with_error
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.sample import BLOCKS, Sample

GRAINS, REPLICAS = 64, 1000


def flow(replicas: int | None = None) -> ShearFlow:
    alpha = 0.5 if replicas is None else np.linspace(0.1, 0.9, replicas)
    return ShearFlow(GRAINS, alpha, 0.6, 1e-4)


def state(replicas: int | None = None) -> State:
    random, axes = np.random.default_rng(0), () if replicas is None else (replicas,)
    radii = random.uniform(0.4, 0.6, (*axes, GRAINS))
    positions, velocities = random.uniform(0, 9, (2, *axes, GRAINS, 2))
    return State(Grains(radii, 4 * radii**2), positions, velocities, np.full(axes, 9.0), np.full(axes, 0.25))


def sample(replicas: int | None = None, status: int = Status.ok) -> Sample:
    axes = () if replicas is None else (replicas,)
    tally = random_tally(np.random.default_rng(0), *axes, BLOCKS, status=status)
    return Sample(tally, np.full(axes, 81.0)[()], np.ones(axes)[()], GRAINS)


MADE = {"ShearFlow": flow, "State": state, "Sample": sample}


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("replicas", [None, REPLICAS])
def test_the_line_is_short_and_whole(name: str, replicas: int | None) -> None:
    line = repr(jax.tree.map(jnp.asarray, MADE[name](replicas)))
    assert line.startswith(f"{name}(") and line.endswith(")")
    assert "\n" not in line and len(line) < 700


def test_one_flow_is_shown_as_it_is_written() -> None:
    one = flow()
    assert eval(repr(one)) == one


def test_batch_is_shown_by_its_number_and_range() -> None:
    assert f"restitution=<{REPLICAS} values, 0.1 to 0.9>" in repr(flow(REPLICAS))
    assert f"replicas={REPLICAS}" in repr(state(REPLICAS))


def test_state_tells_what_a_picture_of_it_would() -> None:
    one = state()
    temperature = np.sum(one.grains.masses[:, None] * one.velocities**2) / (2 * GRAINS)
    area = np.pi * np.sum(one.grains.radii**2)
    assert f"packing_fraction={float(f'{area / 81:.6g}')}, granular_temperature={float(f'{temperature:.6g}')}" in repr(
        one
    )
    assert "precision='float64'" in repr(one)


def test_sample_shows_its_averages_with_their_errors_and_its_status() -> None:
    one = sample(status=Status.deep_overlap)
    errors = one.errors()
    for name in ("force_ratio", "pressure", "granular_temperature"):
        expected = with_error(float(one.averages[name]), float(errors[name]))
        assert f"{name}={expected}" in repr(one)
    assert "deep_overlap" in repr(one)


def test_statuses_of_a_batch_are_counted() -> None:
    batch = sample(5)
    batch.tally.status[3, 7] = Status.not_steady
    assert "ok (4), not_steady (1)" in repr(batch)


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("leaf", [None, jax.ShapeDtypeStruct((3,), float)], ids=["None", "shape"])
def test_whatever_stands_in_the_place_of_a_number_is_shown(name: str, leaf) -> None:
    """JAX fills its trees with axes, shapes and placeholders."""
    odd = jax.tree.map(lambda _: leaf, MADE[name]())
    assert repr(odd).startswith(f"{name}(")


@pytest.mark.parametrize("name", MADE)
def test_traced_values_are_shown_by_their_type(name: str) -> None:
    seen = []
    jax.jit(lambda thing: seen.append(repr(thing)))(MADE[name](3))
    assert "Tracer" in seen[0]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.25, "0.25"),
        (jnp.float64(1e-4), "0.0001"),
        ("midpoint", "'midpoint'"),
        (np.zeros((2, 3)), "<2×3 values, 0>"),
        (np.array([1.0, np.nan, 3.0]), "<3 values, 1 to 3, 1 not finite>"),
        (np.zeros(0), "<0 values>"),
        (np.nan, "nan"),
    ],
)
def test_value_takes_a_few_letters(value, text: str) -> None:
    assert value_text(value) == text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (58.724, 6.04, "59 ± 6"),
        (1.0, 0.00019, "1.00000 ± 0.00019"),  # the excess over one is the result
        (3.4, 0.0997, "3.40 ± 0.10"),
        (0.5, 20.0, "0 ± 20"),
        (12345.0, 121.0, "12340 ± 120"),
        (1.23e7, 2e5, "(1.230 ± 0.020)e+07"),
        (-7.98e-7, 1e-6, "(-0.8 ± 1.0)e-06"),
        (np.nan, np.nan, "nan ± nan"),
    ],
)
def test_a_value_has_the_digits_that_its_error_leaves(value: float, error: float, text: str) -> None:
    assert with_error(value, error) == text


@given(st.floats(1e-12, 1e12), st.floats(1e-12, 1e12), st.sampled_from([-1, 1]))
def test_rounding_moves_a_value_by_less_than_its_error_and_the_error_by_a_seventh(value, error, sign) -> None:
    digits, _, power = with_error(sign * value, error).strip("(").partition(")e")
    shown, rounded_error = (float(x) * 10.0 ** int(power or 0) for x in digits.split(" ± "))
    assert rounded_error == pytest.approx(error, rel=1 / 7)
    assert abs(shown - sign * value) <= 0.51 * error + 5.1e-7 * value
