"""The figure of errors shows the whole error of every point, and its largest part."""

import numpy as np
import pytest
from made_up_maps import ratio_dataset

from jaxgran.maps.schema import ERROR_SOURCES
from jaxgran.model.checks import InputError
from jaxgran.plotting.errors import dominating_errors

PARTS = ("timestep", "size", "tolerance")


def with_budget(largest: str | None):
    """A map whose largest part of the error is the named one, or sampling."""
    data = ratio_dataset(4, 3)
    dims, value = data.force_ratio.dims, data.force_ratio.values
    for name in ("force_ratio", "pressure", "granular_temperature"):
        stderr = (0.001 if largest else 0.1) * value
        parts = {"total": 0.2 * value, "sampling": 1.96 * stderr}
        parts |= {part: (0.19 if part == largest else 0.001) * value for part in PARTS}
        ci95 = np.stack([parts[source] for source in ERROR_SOURCES], axis=-1)
        data = data.assign(
            {name: (dims, value), f"{name}_stderr": (dims, stderr), f"{name}_ci95": ((*dims, "error_source"), ci95)}
        )
    return data.assign_coords(error_source=list(ERROR_SOURCES))


@pytest.mark.parametrize("largest", [None, *PARTS])
def test_each_point_has_the_mark_of_its_largest_part_and_its_whole_error(largest: str | None) -> None:
    figure = dominating_errors(with_budget(largest))
    shown = (None, *PARTS).index(largest)
    for axes in figure.axes:
        counts = [len(marks.get_offsets()) for marks in axes.collections]
        assert counts == [12 if k == shown else 0 for k in range(4)]
        places = np.concatenate([marks.get_offsets() for marks in axes.collections])
        assert set(places[:, 0]) == set(1 - with_budget(largest).restitution.values)
        assert {text.get_text() for text in axes.texts} == {"20"}


def test_a_point_without_a_value_has_no_mark() -> None:
    data = with_budget("size")
    data.pressure[0, 1] = np.nan
    marks = dominating_errors(data).axes[1].collections
    assert sum(len(one.get_offsets()) for one in marks) == 11


def test_a_map_without_a_budget_is_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="it has no pressure, granular_temperature, force_ratio_ci95"):
        dominating_errors(ratio_dataset())
