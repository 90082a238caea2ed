"""A page has every number of its map, and what stands in a file is text to it."""

import base64
import html
import json
import math
import re
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from command_line import jaxgran
from made_up_maps import ratio_dataset, with_grains
from pages import MARKUP, page_map
from synthetic import one_sentence, random_instant

import jaxgran as jg
from jaxgran.maps.schema import flattened, path_of
from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import with_error
from jaxgran.page.grain_data import PARTS, grain_data
from jaxgran.page.map_data import MOST_POINTS, map_data
from jaxgran.plotting.flow import bar_images, common_scale, grain_images
from jaxgran.reference.table import MEASURED, shipped_table
from jaxgran.sampling.observables import OBSERVABLES


@pytest.fixture(scope="module")
def found() -> dict:
    return map_data(page_map())


def written(page: str) -> dict:
    """The data in the text of a page."""
    text = re.search(r'<script id="data" type="application/json">(.*?)</script>', page)
    assert text is not None
    return json.loads(text[1])


def by_name(page: dict) -> dict[str, dict]:
    """The observables of a page by their names, without units."""
    return {x["label"].split(" (")[0].replace(" ", "_"): x for x in page["observables"]}


def values(observable: dict) -> list:
    return observable["views"][0]["value"]


def assert_same_numbers(shown: list, expected: np.ndarray) -> None:
    """To six digits; None where there is no number."""
    numbers = np.array([math.nan if x is None else x for x in shown])
    np.testing.assert_allclose(numbers, np.ravel(expected), rtol=5e-7, atol=1e-15)


def test_every_number_of_a_map_is_on_its_page_to_six_digits(found) -> None:
    data, shown = flattened(page_map()).sortby("timestep"), by_name(found)
    dims = ("timestep", "packing_fraction", "restitution")
    for name, row in OBSERVABLES.items():
        average = data[path_of(name)]
        if row.tensor:
            for a, b in np.ndindex(2, 2):
                component = shown[f"{name}_{'xy'[a]}{'xy'[b]}"]
                assert_same_numbers(values(component), average.values[..., a, b])
            continue
        view, *quotient = shown[name]["views"]
        assert shown[name]["meaning"] == row.meaning
        assert (row.unit == "1") == (shown[name]["label"] == name.replace("_", " "))
        assert_same_numbers(view["value"], average.transpose(*dims))
        assert (shown[name]["texts"][1] is not None) == (f"theory/{name}" in data)
        if row.group != "diagnostics":
            error = data[f"{path_of(name)}_stderr"].transpose(*dims)
            assert_same_numbers(view["error"], error)
            assert shown[name]["texts"][0] == texts(average.transpose(*dims), error)
        if f"theory/{name}" in data:
            theory = data[f"theory/{name}"].transpose(*dims)
            large = data.get(f"{name}_large_system", average).transpose(*dims)
            assert_same_numbers(view["theory"], theory)
            assert_same_numbers(quotient[0]["value"], large / theory)
        if f"theory/{name}" in data and f"{name}_large_system" in data:
            half = data[f"{name}_large_system_ci95"].sel(error_source="total").transpose(*dims)
            assert_same_numbers(quotient[0]["error"], half / HALF_INTERVAL / theory)
    assert (found["x"], found["y"]) == ([0.5, 0.3, 0.1], [0.5, 0.6])
    assert texts_of(found, "grains") == ["64"] and texts_of(found, "timestep") == ["5e-4", "0.001"]
    assert not [name for name in shown if re.search("_stderr|_seed|snapshot|status", name)]


def texts(value: xr.DataArray, error: xr.DataArray) -> list[str]:
    """What the command line prints of each point."""
    pairs = zip(value.values.flat, error.values.flat, strict=True)
    return [with_error(*map(float, pair)) if np.isfinite(pair[0]) else "–" for pair in pairs]


def texts_of(page: dict, choice: str) -> list[str]:
    return next(axis["texts"] for axis in page["choices"] if axis["name"] == choice)


def test_points_without_a_number_and_with_a_bad_status_are_told_apart(found) -> None:
    """Point 8 of the settings was not run; the shorter time step comes first on a page."""
    assert found["bad"] == [False, True, True, *[False] * 9]
    for of_points in (values(found["observables"][0]), found["instants"]):
        assert [value is None for value in of_points] == [k == 2 for k in range(12)]
    assert found["status"][0] == "Status ok."
    assert found["status"][1].startswith("Status deep overlap: ")


def test_instant_is_packed_without_visible_loss() -> None:
    instant = random_instant(1, grains=50, pairs=9)
    packed, unit = grain_data(instant), instant.side / PARTS
    grains, bars = (np.frombuffer(base64.b64decode(packed[x]), "<i2") for x in ("grains", "bars"))
    x, y, radius, colour = grains.reshape(4, -1)
    which, centres = grain_images(instant)
    assert set(which) == set(range(50)) and len(which) > 50
    np.testing.assert_allclose(np.stack([x, y], axis=-1) * unit, centres, atol=unit)
    np.testing.assert_allclose(radius * unit, instant.radii[which], atol=unit)
    scale = common_scale([instant])
    share = np.minimum(instant.speed / scale.speed, 1)
    np.testing.assert_allclose(colour / 63, share[which], atol=1 / 126)
    pairs, middles, along, widths = bar_images(instant, scale.force)
    *lengths, clustered = bars.reshape(6, -1)
    expected = [*middles.T, *along.T, widths]
    np.testing.assert_allclose(np.multiply(lengths, unit), expected, atol=unit)
    np.testing.assert_array_equal(clustered, instant.clustered[pairs])


def test_numbers_of_grains_are_an_axis_or_stand_at_their_points() -> None:
    data = ratio_dataset(2, 2)
    assert texts_of(map_data(with_grains(data, 64, 256)), "grains") == ["64", "256"]
    page = map_data(data.assign(point_grains=(data.force_ratio.dims, [[64, 90], [128, 256]])))
    assert [re.search(r"N = (\d+)", x)[1] for x in page["headings"]] == ["64", "90", "128", "256"]


@pytest.mark.parametrize("shape", [(1000, 1000), (1, 100_000)])
def test_many_points_are_thinned_with_a_word_about_it(shape: tuple[int, int]) -> None:
    page = map_data(ratio_dataset(*shape))
    assert MOST_POINTS / 2 < len(page["x"]) * len(page["y"]) == len(page["status"]) <= MOST_POINTS
    assert one_sentence(page["notes"]) and f"of {max(shape)} values" in page["notes"]
    assert map_data(ratio_dataset(2, 2))["notes"] == ""


def test_names_and_attributes_cannot_leave_the_data_of_a_page() -> None:
    page = jg.explore(page_map())
    for markup in ("hacked = 1</script>", "<img", "<u>name"):
        assert markup not in page.text
    assert written(page.text)["title"] == MARKUP
    assert "own_<u>name</u>" in by_name(written(page.text))
    assert f"<title>{html.escape(MARKUP)}</title>" in page.text
    assert page.text.count("<script") == page.text.count("</script>") == 3


def test_page_forbids_itself_every_request() -> None:
    template = files("jaxgran.page").joinpath("map.html").read_text(encoding="utf-8")
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', template)
    assert policy is not None and policy[1].startswith("default-src 'none';")
    assert "connect-src" not in policy[1] and not re.search("https?:", template)


def test_explore_writes_a_page_that_a_notebook_shows(tmp_path: Path) -> None:
    page = jg.explore(ratio_dataset(), tmp_path / "map.html")
    assert (tmp_path / "map.html").read_text(encoding="utf-8") == page.text
    frame = page._repr_html_()
    assert frame.startswith("<iframe") and html.escape(page.text) in frame


def test_a_page_has_the_verdict_on_every_flow_in_the_range_of_the_reference_map() -> None:
    low, high = shipped_table().range("packing_fraction")
    nus, alphas = np.array([low - 0.01, 0.5, high]), np.array([0.5, 0.9])
    data = ratio_dataset(2, 3).assign_coords(packing_fraction=nus, restitution=alphas)
    reference = map_data(data)["reference"]
    assert reference["flows"][:2] == [None, None]
    assert f"{low:g} to {high:g}" in reference["outside"]
    verdicts = [flow["verdict"] for flow in reference["flows"][2:]]
    assert verdicts == [jg.validity(alpha, nu).verdict() for nu in nus[1:] for alpha in alphas]


def test_a_page_without_a_map_is_the_reference_map_with_every_point_of_its_table(
    tmp_path: Path,
) -> None:
    assert jaxgran(tmp_path, "explore").status == 0
    text = (tmp_path / "reference_map.html").read_text(encoding="utf-8")
    table, page = shipped_table(), written(text)
    shown, nus = by_name(page), page["y"]
    ones = [round(1 - x, 9) for x in page["x"]]
    flows = zip(table.columns["restitution"], table.columns["packing_fraction"], strict=True)
    places = [nus.index(nu) * len(ones) + ones.index(alpha) for alpha, nu in flows]
    for name in (*MEASURED, "force_ratio"):
        assert_same_numbers([values(shown[name])[k] for k in places], table.columns[name])
        errors = [shown[name]["views"][0]["error"][k] for k in places]
        assert_same_numbers(errors, table.columns[f"{name}_stderr"])
    assert all(page["reference"]["flows"])


def test_a_page_without_plotly_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(jg.InputError, match="pip install 'jaxgran\\[explore\\]'"):
        jg.explore(ratio_dataset())
