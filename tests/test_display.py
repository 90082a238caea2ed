"""Objects show themselves in one line: short for any batch, and without a failure."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic import random_tally, sample_of_tally, snapshot_of

import jaxgran as jg
from jaxgran.model.display import with_error
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.sample import BLOCKS

TALLIES = random_tally(np.random.default_rng(0), 1000, BLOCKS)
VALUES = [ShearFlow(64, 0.5, 0.6, 1e-4), ShearFlow(64, np.linspace(0.1, 0.9, 1000), 0.6, 1e-4)]
VALUES += [sample_of_tally(TALLIES, jg.ShearFlow(64, 0.5, 0.6, 1e-3))]
SERIES = snapshot_of(np.random.default_rng(0).uniform(0, 40, (9, 64, 2)), 9 * [[(0, 1, 2.0)]])
VALUES += [SERIES, SERIES[0], SERIES.state]


@pytest.mark.parametrize(
    "value", VALUES, ids=["flow", "batch", "samples", "series", "snapshot", "states"]
)
def test_the_line_is_short_whatever_stands_in_the_place_of_a_number(value) -> None:
    """JAX fills its trees with tracers, axes, shapes and placeholders."""
    seen = [value]
    jax.jit(seen.append)(value)
    seen += [
        jax.tree.map(lambda _, leaf=leaf: leaf, value)
        for leaf in (None, jax.ShapeDtypeStruct((3,), float))
    ]
    assert all(repr(one).startswith(type(value).__name__) and "\n" not in repr(one) for one in seen)
    assert len(repr(value)) < 700


def test_a_number_that_has_diverged_is_short() -> None:
    assert with_error(-3e75, 2.5e74) == "(-3.00 ± 0.25)e+75"
    assert with_error(3e74, 2.5e75) == "(0.3 ± 2.5)e+75"


def test_answers_of_the_reference_map_are_shown_in_one_line() -> None:
    law, verdict = jg.constitutive_law(), jg.validity(0.6, [0.5, 0.65])
    answer = law(0.6, 0.65)
    assert f"pressure={with_error(*answer.pressure)}, " in repr(answer)
    for value in (law, answer, law(0.6, [0.5, 0.65]), verdict, verdict.at(0)):
        assert repr(value).startswith(type(value).__name__) and "ci95" not in repr(value)
        assert len(repr(value)) < 400 and "\n" not in repr(value)


@given(st.floats(1e-12, 1e12), st.floats(1e-12, 1e12), st.sampled_from([-1, 1]))
def test_rounding_moves_a_value_by_less_than_its_error_and_the_error_by_a_seventh(
    value, error, sign
) -> None:
    digits, _, power = with_error(sign * value, error).strip("(").partition(")e")
    shown, rounded_error = (float(x) * 10.0 ** int(power or 0) for x in digits.split(" ± "))
    assert rounded_error == pytest.approx(error, rel=1 / 7)
    assert abs(shown - sign * value) <= 0.51 * error + 5.1e-7 * value
