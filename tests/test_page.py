"""A page has every number of its map, and what stands in a file is text to it."""

import base64
import html
import json
import math
import re
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
from jaxgran.model.display import with_error
from jaxgran.page.document import Page
from jaxgran.page.grain_data import grain_data, scale_of
from jaxgran.page.map_data import MOST_POINTS, map_data
from jaxgran.reference.table import MEASURED, Table, shipped_table
from jaxgran.sampling.observables import OBSERVABLES


@pytest.fixture(scope="module")
def found() -> dict:
    return map_data(page_map())


def written(page: Page) -> dict:
    """The data in the text of a page."""
    text = re.search(r'<script id="data" type="application/json">(.*?)</script>', page.text)
    assert text is not None
    return json.loads(text[1])


def assert_same_numbers(shown: list, expected: np.ndarray) -> None:
    """To six digits; None where there is no number."""
    numbers = np.array([math.nan if x is None else x for x in shown])
    np.testing.assert_allclose(numbers, np.ravel(expected), rtol=5e-7, atol=0)


def texts(values: xr.DataArray, errors: xr.DataArray | None, dims: tuple[str, ...]) -> list[str]:
    """What the command line prints of each point."""
    numbers = [np.ravel(x.transpose(*dims)) for x in (values, errors) if x is not None]
    return [
        (with_error(*map(float, some)) if len(some) == 2 else f"{some[0]:.6g}")
        if np.isfinite(some[0])
        else "–"
        for some in zip(*numbers, strict=True)
    ]


def test_every_number_of_a_map_is_on_its_page_to_six_digits(found) -> None:
    data, by_name = (
        flattened(page_map()).sortby("timestep"),
        {one["name"]: one for one in found["observables"]},
    )
    dims = ("timestep", "packing_fraction", "restitution")
    strain = data["sums/strain"].sum("seed")
    for name, observable in OBSERVABLES.items():
        if observable.tensor:
            for a, b in np.ndindex(2, 2):
                assert_same_numbers(
                    by_name[f"{name}_{'xy'[a]}{'xy'[b]}"]["value"],
                    data[path_of(name)].values[..., a, b],
                )
            continue
        one = by_name[name]
        assert one["meaning"] == observable.meaning and (observable.unit == "1") == (
            one["unit"] == ""
        )
        assert_same_numbers(one["value"], data[path_of(name)].transpose(*dims).values)
        if observable.group != "diagnostics":
            assert_same_numbers(
                one["error"], data[f"{path_of(name)}_stderr"].transpose(*dims).values
            )
        assert ("theory" in one) == (f"theory/{name}" in data)
        large = f"{name}_large_system"
        assert ("large" in one) == (large in data)
        if "theory" in one:
            assert_same_numbers(one["theory"], data[f"theory/{name}"].values)
        values, errors = data[path_of(name)], data.get(f"{path_of(name)}_stderr")
        if "large" in one:
            half_width = data[f"{large}_ci95"].sel(error_source="total")
            assert one["large"] == texts(data[large], half_width, dims)
        assert one["text"] == texts(values, errors, dims)
        if not observable.extreme:
            correlated = data["diagnostics/correlation_strain"].sel(observable=name)
            assert_same_numbers(one["samples"], (strain / correlated).values)
    ratio = data.force_ratio.transpose(*dims).values
    assert_same_numbers(by_name["excess"]["value"], ratio - 1)
    assert [axis["values"] for axis in found["axes"]] == [
        [64],
        [5e-4, 1e-3],
        [0.5, 0.6],
        [0.5, 0.7, 0.9],
    ]
    assert not [
        name for name in by_name if re.search("_stderr|_seed|large_system|snapshot|status", name)
    ]


def test_points_without_a_number_and_with_a_bad_status_are_told_apart(found) -> None:
    """Point 8 of the settings was not run; the shorter time step comes first on a page."""
    assert found["status"] == ["ok", "deep_overlap", "not_run", *["ok"] * 9]
    assert [one is None for one in found["observables"][0]["value"]] == [k == 2 for k in range(12)]
    assert [one is None for one in found["instants"]] == [k == 2 for k in range(12)]
    assert {"deep_overlap", "not_run"} <= set(found["meanings"])


def test_instant_is_packed_without_visible_loss() -> None:
    one = random_instant(1, grains=50, pairs=9)
    scale = scale_of(one.speed, one.force)
    packed = grain_data(**one._asdict(), scale=scale)
    raw = base64.b64decode(packed["data"])
    n, p = packed["grains"], packed["pairs"]
    x, y, i, j = np.split(np.frombuffer(raw[: 4 * (n + p)], "<u2"), [n, 2 * n, 2 * n + p])
    radius, speed, force, clustered = np.split(
        np.frombuffer(raw[4 * (n + p) :], np.uint8), [n, 2 * n, 2 * n + p]
    )
    cell = (
        np.stack(
            [one.positions[:, 0] - one.tilt * one.positions[:, 1], one.positions[:, 1]], axis=-1
        )
        / one.side
    )
    assert np.all(np.abs((np.stack([x, y], axis=-1) / 65536 - cell + 0.5) % 1 - 0.5) <= 1 / 65536)
    np.testing.assert_array_equal(np.stack([i, j], axis=-1), one.pairs)
    np.testing.assert_array_equal(clustered, one.clustered)
    np.testing.assert_allclose(
        radius / 255 * packed["radius"], one.radii, atol=one.radii.max() / 500
    )
    np.testing.assert_allclose(speed / 255, np.minimum(one.speed / scale.speed, 1), atol=1 / 500)
    np.testing.assert_allclose(force / 255, np.minimum(one.force / scale.force, 1), atol=1 / 500)


def test_numbers_of_grains_are_an_axis_or_stand_at_their_points() -> None:
    data = ratio_dataset(2, 2)
    assert map_data(with_grains(data, 64, 256))["axes"][0]["values"] == [64, 256]
    page = map_data(data.assign(point_grains=(data.force_ratio.dims, [[64, 90], [128, 256]])))
    assert page["grains"] == [64, 90, 128, 256]


def test_million_points_are_thinned_with_a_word_about_it() -> None:
    page = map_data(ratio_dataset(1000, 1000))
    axes = [axis["values"] for axis in page["axes"][2:]]
    assert 0.9 * MOST_POINTS < len(axes[0]) * len(axes[1]) == len(page["status"]) <= MOST_POINTS
    assert (axes[0][0], axes[0][-1], axes[1][0], axes[1][-1]) == (0.3, 0.8, 0.1, 0.9)
    (note,) = page["notes"]
    assert one_sentence(note.replace("points. This", "points: this")) and "1000000 points" in note
    assert len(map_data(ratio_dataset(1, 100_000))["status"]) == MOST_POINTS


def test_names_and_attributes_cannot_leave_the_data_of_a_page() -> None:
    page = jg.explore(page_map())
    assert (
        "hacked = 1</script>" not in page.text
        and "<img" not in page.text
        and "<u>name" not in page.text
    )
    assert written(page)["title"] == MARKUP
    assert "own <u>name</u>" in [one["name"] for one in written(page)["observables"]]
    assert f"<title>{html.escape(MARKUP)}</title>" in page.text
    assert page.text.count("<script") == page.text.count("</script>") == 3


def test_page_forbids_itself_every_request() -> None:
    template = files("jaxgran.page").joinpath("map.html").read_text(encoding="utf-8")
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', template)
    assert policy is not None and policy[1].startswith("default-src 'none';")
    assert "http:" not in template and "https:" not in template and "connect-src" not in policy[1]


@pytest.mark.parametrize("name", ["activation", "solver_requested", "tolerance", "seeds"])
def test_attribute_that_is_no_option_gives_no_command_to_paste(name: str) -> None:
    data = page_map()
    again = map_data(data)["again"]
    assert again["options"] == "--solver barzilai-borwein --activation midpoint --tolerance 0.0001"
    assert_same_numbers(
        again["strain"], flattened(data)["sums/strain"].mean("seed").sortby("timestep").values
    )
    jammed = flattened(data).assign(
        force_ratio=data.force_ratio.where(data.restitution > data.restitution.min())
    )
    assert sum(strain is None for strain in map_data(jammed)["again"]["strain"]) > again[
        "strain"
    ].count(None)
    assert map_data(flattened(data).assign_attrs({name: "midpoint; rm -rf ~"}))["again"] is None


def test_explore_writes_a_page_that_a_notebook_shows(tmp_path: Path) -> None:
    page = jg.explore(ratio_dataset(), tmp_path / "map.html")
    assert (tmp_path / "map.html").read_text(encoding="utf-8") == page.text
    frame = page._repr_html_()
    assert frame.startswith("<iframe") and html.escape(page.text) in frame
    assert "MB" in repr(page)


def test_a_page_has_the_verdict_on_every_flow_in_the_range_of_the_reference_map() -> None:
    table = shipped_table()
    low, high = table.range("packing_fraction")
    nus, alphas = np.array([low - 0.01, 0.5, high]), np.array([0.5, 0.9])
    said = map_data(ratio_dataset(2, 3).assign_coords(packing_fraction=nus, restitution=alphas))[
        "reference"
    ]
    assert said["flows"][:2] == [None, None] and f"{low:g} to {high:g}" in said["outside"]
    for flow, (nu, alpha) in zip(
        said["flows"][2:], [(nu, alpha) for nu in nus[1:] for alpha in alphas], strict=True
    ):
        found = jg.validity(alpha, nu)
        assert flow["verdict"] == found.verdict()
        assert [row[0] for row in flow["rows"]] == [
            name.replace("_", " ") for name in found.measured
        ]
        assert all(len(row) == len(said["columns"]) for row in flow["rows"])


def test_a_page_without_a_map_is_the_reference_map_with_every_point_of_its_table() -> None:
    table, page = shipped_table(), written(jg.explore())
    by_name = {one["name"]: one for one in page["observables"]}
    nus, alphas = (page["axes"][k]["values"] for k in (2, 3))
    places = [nus.index(nu) * len(alphas) + alphas.index(alpha) for alpha, nu in flows_of(table)]
    for name in (*MEASURED, "force_ratio"):
        assert_same_numbers([by_name[name]["value"][k] for k in places], table.columns[name])
        assert_same_numbers(
            [by_name[name]["error"][k] for k in places], table.columns[f"{name}_stderr"]
        )
    assert all(page["reference"]["flows"])
    assert page["title"].endswith(table.made_with)


def test_explore_without_a_file_writes_the_reference_map(tmp_path: Path) -> None:
    outcome = jaxgran(tmp_path, "explore")
    assert outcome.status == 0
    assert (tmp_path / "reference_map.html").read_text(encoding="utf-8") == jg.explore().text


def flows_of(table: Table) -> list[tuple[float, float]]:
    return list(zip(table.columns["restitution"], table.columns["packing_fraction"], strict=True))


def test_a_page_without_plotly_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "plotly.offline", None)
    with pytest.raises(jg.InputError, match="pip install 'jaxgran\\[explore\\]'"):
        jg.explore(ratio_dataset())
