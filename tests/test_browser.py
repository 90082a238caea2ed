"""Pages in a real browser: nothing fails, nothing is asked of a network, and what is clicked is
what is shown.
"""

import json
import shlex
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from command_line import jaxgran
from pages import MARKUP, browser, open_page, page_map

import jaxgran as jg
from jaxgran.maps.automatic import chosen_settings
from jaxgran.model.display import with_error

pytestmark = pytest.mark.environment


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def page(chromium, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """A browser with the page of a made-up map, and the file of the page."""
    file = tmp_path_factory.mktemp("page") / "map.html"
    jg.explore(page_map(), file)
    open_page(chromium, file)
    return chromium, file


@pytest.fixture
def map_page(page) -> Any:
    """The page as it is when it is opened."""
    chromium, _ = page
    chromium.execute_script(
        "Object.assign(chosen, {observable: names.indexOf('force_ratio'), timestep: 0, row: 0, "
        "column: 1});"
        "Object.assign(chosen, {log: false, quotient: false}); draw()"
    )
    return chromium


def choose(chromium, **choices: int) -> None:
    """Choose the entry of a number in some lists of the page, one after the other."""
    for name, number in choices.items():
        set_control(chromium, name, number)


def set_control(chromium, name: str, value: int) -> None:
    """Give a list or a slider of the page a value, as a reader does."""
    chromium.execute_script(
        "const control = element(`choose-${arguments[0]}`); control.value = arguments[1];"
        "for (const kind of ['input', 'change']) control.dispatchEvent(new Event(kind))",
        name,
        value,
    )


def names(chromium) -> list[str]:
    return chromium.execute_script("return observables.map((one) => one.name)")


def table(chromium, name: str = "numbers") -> dict[str, list[str]]:
    """The cells of a table, by the name of the row."""
    rows = chromium.execute_script(
        "const rows = [...element(arguments[0]).tBodies[0].rows];"
        "return rows.map((row) => [...row.cells].map((cell) => cell.textContent))",
        name,
    )
    return {first: others for first, *others in rows}


def trace(chromium, chart: str, name: str) -> dict[str, Any]:
    """A trace of a chart as Plotly has it."""
    return chromium.execute_script(
        "const one = element(arguments[0]).data.find((trace) => trace.name === arguments[1]);"
        "return one && JSON.parse(JSON.stringify(one))",
        chart,
        name,
    )


def click_on(chromium, chart: str, x: float, y: float) -> None:
    """Click on a place of a chart, in its own units, as a mouse does."""
    from selenium.webdriver.common.action_chains import ActionChains

    div = chromium.find_element("id", chart)
    chromium.execute_script("arguments[0].scrollIntoView({block: 'center'})", div)
    across, down = chromium.execute_script(
        "const {_fullLayout: layout} = element(arguments[0]), box = "
        "element(arguments[0]).getBoundingClientRect();"
        "return [layout.xaxis._offset + layout.xaxis.d2p(arguments[1]) - box.width / 2,"
        " layout.yaxis._offset + layout.yaxis.d2p(arguments[2]) - box.height / 2]",
        chart,
        x,
        y,
    )
    ActionChains(chromium, 50).move_to_element_with_offset(div, across, down).click().perform()


def wait_for(condition, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the page did not change"
        time.sleep(0.02)


def assert_quiet(chromium) -> None:
    """No message in the console, and no request but for the file of the page."""
    assert [entry["message"] for entry in chromium.get_log("browser")] == []
    events = [json.loads(entry["message"])["message"] for entry in chromium.get_log("performance")]
    sent = [
        event["params"]["request"]["url"]
        for event in events
        if event["method"] == "Network.requestWillBeSent"
    ]
    asked = {
        url for url in sent if not url.startswith(("data:", "about:"))
    }  # pictures that Plotly makes are data
    assert len(asked) == 1 and asked.pop().startswith("file:///")


def here(chromium) -> dict[str, float]:
    """The point of the map that is chosen."""
    chosen = chromium.execute_script(
        "return [timesteps[chosen.timestep], fractions[chosen.row], restitutions[chosen.column]]"
    )
    return dict(zip(("timestep", "packing_fraction", "restitution"), chosen, strict=True))


def assert_table_is_that_of_the_dataset(chromium, **point: float) -> None:
    at, shown = page_map().sel(point), table(chromium)
    for name in ("force_ratio", "pressure", "granular_temperature"):
        text, _, theory, *_ = shown[name.replace("_", " ")]
        assert text == with_error(float(at[name]), float(at[f"{name}_stderr"]))
        if f"theory_{name}" in at:
            assert float(theory) == pytest.approx(float(at[f"theory_{name}"]), rel=5e-6)


def test_map_opens_without_a_network_and_draws_every_point(page) -> None:
    chromium, _ = page
    assert_quiet(chromium)
    drawn = chromium.execute_script(
        "return document.querySelectorAll('#plane .scatterlayer path.point').length"
    )
    assert (
        drawn == 6 + 1 + 1 + 1
    )  # points, one of a bad status, one without a value, and the chosen one
    points = trace(chromium, "plane", "points")
    expected = [(round(1 - a, 12), nu) for nu in (0.5, 0.6) for a in (0.5, 0.7, 0.9)]
    assert list(zip(points["x"], points["y"], strict=True)) == expected


def test_names_and_attributes_stand_on_the_page_as_text(map_page) -> None:
    assert map_page.find_element("id", "title").text == " ".join(MARKUP.split())
    assert map_page.execute_script("return window.hacked") is None
    own = names(map_page).index("own <u>name</u>")
    choose(map_page, observable=own)
    assert (
        map_page.execute_script(
            "return document.querySelectorAll('body u, body img, body b').length"
        )
        == 0
    )
    label = map_page.execute_script(
        "return element('plane').querySelector('.cbtitle, .cbtitle-unsupported')?.textContent"
    )
    assert label is None or "<u>name</u>" in label
    assert map_page.execute_script("return window.hacked") is None
    assert table(map_page)["own <u>name</u>"][1] == "<i>σ</i>"


def test_click_on_a_point_shows_the_values_of_the_dataset(map_page) -> None:
    click_on(map_page, "plane", 0.5, 0.6)
    wait_for(lambda: here(map_page)["restitution"] == 0.5)
    assert here(map_page) == {"timestep": 5e-4, "packing_fraction": 0.6, "restitution": 0.5}
    assert_table_is_that_of_the_dataset(map_page, **here(map_page))
    assert map_page.find_element("id", "which").text == "α = 0.5, ν = 0.6, N = 64, dt = 5e-4/γ̇"
    click_on(
        map_page,
        "against-nu",
        0.5,
        float(page_map().force_ratio.sel(here(map_page) | {"packing_fraction": 0.5})),
    )
    wait_for(lambda: here(map_page)["packing_fraction"] == 0.5)
    assert_table_is_that_of_the_dataset(map_page, **here(map_page))


def test_curves_have_the_values_errors_and_theory_of_the_dataset(map_page) -> None:
    choose(map_page, observable=names(map_page).index("pressure"), timestep=1, row=1, column=0)
    at = page_map().sel(timestep=1e-3)
    for chart, line in (
        ("against-nu", at.sel(restitution=0.5)),
        ("against-alpha", at.sel(packing_fraction=0.6)),
    ):
        measured, theory = (
            trace(map_page, chart, "measured"),
            trace(map_page, chart, "kinetic theory"),
        )
        np.testing.assert_allclose(measured["y"], line.pressure, rtol=5e-7)
        np.testing.assert_allclose(measured["error_y"]["array"], line.pressure_stderr, rtol=5e-7)
        np.testing.assert_allclose(theory["y"], line["theory/pressure"], rtol=5e-7)


def test_controls_do_what_they_say(map_page) -> None:
    pressure = names(map_page).index("pressure")
    choose(map_page, observable=pressure, timestep=1)
    at = page_map().sel(timestep=1e-3)
    quotient = at.pressure / at["theory/pressure"]

    def shown() -> Any:
        return trace(map_page, "plane", "observable")["z"]

    np.testing.assert_allclose(shown(), at.pressure, rtol=5e-7)
    map_page.find_element("id", "choose-quotient").click()
    np.testing.assert_allclose(shown(), quotient, rtol=2e-6)
    map_page.find_element("id", "choose-log").click()
    np.testing.assert_allclose(shown(), np.log10(quotient), rtol=1e-5, atol=1e-6)
    for there in (False, True):
        map_page.find_element("id", "choose-excess").click()
        assert (trace(map_page, "plane", "excess 0.05") is not None) == there
    choose(map_page, observable=names(map_page).index("coordination_number"))
    assert not map_page.find_element("id", "choose-quotient").is_enabled()  # nothing predicts it


def test_address_keeps_the_view(page, map_page) -> None:
    chromium, file = page
    choose(map_page, observable=names(map_page).index("shear_stress"), timestep=1, row=1, column=2)
    map_page.find_element("id", "choose-log").click()
    address = map_page.execute_script("return location.hash")
    shown = map_page.find_element("id", "which").text, table(map_page)
    choose(map_page, observable=0, timestep=0, row=0, column=0)
    open_page(chromium, file, address)
    assert (map_page.find_element("id", "which").text, table(map_page)) == shown
    assert map_page.find_element("id", "choose-log").is_selected()
    assert map_page.execute_script("return location.hash") == address
    assert_quiet(chromium)


def test_copied_are_the_table_and_a_command_that_runs(
    map_page, tmp_path: Path, monkeypatch
) -> None:
    map_page.execute_script(
        "navigator.clipboard.writeText = async (text) => { window.copied = text; }"
    )
    for button in ("copy-numbers", "copy-command"):
        map_page.find_element("id", button).click()
        wait_for(lambda button=button: map_page.find_element("id", button).text == "Copied")
        text = map_page.execute_script("return window.copied")
        if button == "copy-numbers":
            rows = [line.split("\t") for line in text.split("\n")]
            assert {row[0]: row[1:] for row in rows[1:]} == table(map_page)
    command = shlex.split(text)
    assert command[:2] == ["jaxgran", "map"] and "--strain" in command
    assert float(command[command.index("--strain") + 1]) == pytest.approx(
        4 * float(page_map()["sums/strain"].sel(here(map_page)).mean()), rel=0.01
    )
    measured = Mock(side_effect=SystemExit(0))
    monkeypatch.setattr("jaxgran.maps.ratio_map.ratio_map", measured)
    assert jaxgran(tmp_path, *command[1:]).status == 0
    settings, point = chosen_settings(measured.call_args.kwargs)[0], here(map_page)
    (flow,) = settings.flows()
    assert {name: getattr(flow, name) for name in point} == point
    assert (settings.grains, settings.seeds, settings.activation) == (64, 2, "midpoint")
