"""A logarithmic axis of any range has a few round numbers, and none overprints another."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxgran.plotting.drawing import TICK_SIZE, empty_figure
from jaxgran.plotting.log_axis import log_numbers, number_log_axis


@given(st.floats(-8, 4), st.floats(0.01, 9), st.sampled_from([5, 7]))
def test_any_range_has_a_few_numbers_within_it(power: float, decades: float, most: int) -> None:
    low, high = 10.0**power, 10.0 ** (power + decades)
    numbers = log_numbers(low, high, most)
    assert 2 <= len(numbers) <= 7
    assert (np.diff(numbers) > 0).all()
    assert numbers[0] >= low * (1 - 1e-8) and numbers[-1] <= high * (1 + 1e-8)


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (0.9, 20.5, "1 2 5 10 20"),
        (0.08, 0.4, "0.08 0.1 0.15 0.2 0.3 0.4"),
        (0.31, 0.38, "0.32 0.34 0.36 0.38"),
        (6e-6, 10, r"$10^{-5}$ $10^{-4}$ $10^{-3}$ $10^{-2}$ $10^{-1}$ $10^{0}$ $10^{1}$"),
        (1.1e-4, 9e-4, r"$2\times10^{-4}$ $5\times10^{-4}$"),
        (1e-9, 1, r"$10^{-9}$ $10^{-7}$ $10^{-5}$ $10^{-3}$ $10^{-1}$"),
    ],
)
def test_numbers_of_an_axis_are_round_and_do_not_overlap(low: float, high: float, labels: str) -> None:
    figure = empty_figure(3.0, 1.5)
    axes = figure.subplots()
    axes.tick_params(labelsize=TICK_SIZE)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    number_log_axis(axes.xaxis, low, high)
    figure.canvas.draw()
    shown = [label for label in axes.get_xticklabels(which="both") if label.get_text()]
    assert " ".join(label.get_text().replace(" ", "") for label in shown) == labels
    boxes = [label.get_window_extent() for label in shown]
    assert not any(box.overlaps(other) for k, box in enumerate(boxes) for other in boxes[:k])
