"""The page of a map in a real browser, without a network: what is chosen is what is shown."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import MARKUP, browser, open_page, page_map
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

import jaxgran as jg
from jaxgran.maps.results import open_map
from jaxgran.model.display import with_error

pytestmark = pytest.mark.environment
PAPER = Path(__file__).parents[1] / "benchmarks" / "results" / "paper.nc"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The files of the pages of a made-up map, of the paper's map and of the reference map."""
    folder, maps = tmp_path_factory.mktemp("pages"), {"made_up": page_map(), "reference": None}
    for name, data in (maps | {"paper": open_map(PAPER)}).items():
        jg.explore(data, folder / f"{name}.html")
    return {file.stem: file for file in folder.iterdir()}


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture
def page(chromium, pages) -> Any:
    """The page of the made-up map as it is when it is opened with an address."""
    show(chromium, pages["made_up"])
    choose(chromium, observable="force ratio", restitution="0.7", packing_fraction="0.5")
    return chromium


def show(chromium, file: Path, address: str = "", width: int = 1400, scheme: str = "light") -> None:
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    preferred = [{"name": "prefers-color-scheme", "value": scheme}]
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": preferred})
    open_page(chromium, file, address)


def choose(chromium, **texts: str) -> None:
    """Choose entries of the lists of the page by their texts."""
    for name, text in texts.items():
        Select(chromium.find_element("id", f"choose-{name}")).select_by_visible_text(text)


def heading(chromium) -> str:
    return chromium.find_element("id", "which").text


def row_of(chromium, label: str) -> list[str]:
    """The cells of a row of the table of the chosen point."""
    rows = chromium.execute_script(
        "return [...element('numbers').tBodies[0].rows].map((row) => "
        "[...row.cells].map((cell) => cell.textContent))"
    )
    return next(others for first, *others in rows if first == label)


def trace(chromium, chart: str, name: str) -> dict[str, Any]:
    """A trace of a chart as Plotly has it, None if there is none."""
    return chromium.execute_script(
        "const found = element(arguments[0]).data.find((trace) => trace.name === arguments[1]);"
        "return found && JSON.parse(JSON.stringify(found))",
        chart,
        name,
    )


def chosen_point(chromium) -> tuple[float, float]:
    place = trace(chromium, "plane", "chosen point")
    return place["x"][0], place["y"][0]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["made_up", "paper", "reference"])
def test_nothing_is_asked_of_a_network_nor_fails_nor_leaves_a_narrow_window(
    chromium, pages, name: str, scheme: str
) -> None:
    assert pages[name].stat().st_size < 4e6
    chromium.get_log("browser"), chromium.get_log("performance")
    show(chromium, pages[name], width=400, scheme=scheme)
    assert [entry["message"] for entry in chromium.get_log("browser")] == []
    events = [json.loads(entry["message"])["message"] for entry in chromium.get_log("performance")]
    sent = [x["params"]["request"]["url"] for x in events if "request" in x.get("params", {})]
    asked = {url for url in sent if not url.startswith(("data:", "about:"))}
    assert asked == {pages[name].as_uri()}
    overflow = """
      const parts = [...document.querySelectorAll("body *")].filter((x) => !x.closest(".scroll"));
      const ends = parts.map((part) => part.getBoundingClientRect().right);
      return [document.documentElement.scrollWidth, ...ends];
    """
    assert max(chromium.execute_script(overflow)) <= 400
    shades = chromium.execute_script(
        "const {backgroundColor, color} = getComputedStyle(document.body);"
        "return [backgroundColor, color].map((text) => Number(text.match(/[0-9]+/)[0]))"
    )
    assert (shades[0] < 60 and shades[1] > 200) == (scheme == "dark")
    assert trace(chromium, "plane", "chosen point") is not None


def test_names_and_attributes_stand_on_the_page_as_text(page) -> None:
    assert page.find_element("id", "title").text == " ".join(MARKUP.split())
    choose(page, observable="own <u>name</u> (<i>σ</i>)")
    marked = "return document.querySelectorAll('body u, body img, body b').length"
    assert page.execute_script(marked) == 0 and page.execute_script("return !window.hacked")


def test_table_and_curves_have_the_numbers_of_the_file(page) -> None:
    choose(page, observable="pressure (m/t²)", packing_fraction="0.6", timestep="0.001")
    assert heading(page) == "α = 0.7, ν = 0.6, N = 64, dt = 0.001/γ̇"
    at = page_map().sel(timestep=1e-3, restitution=0.7)
    point = at.sel(packing_fraction=0.6)
    text, theory, *_ = row_of(page, "pressure (m/t²)")
    assert text == with_error(float(point.pressure), float(point.pressure_stderr))
    assert float(theory) == pytest.approx(float(point["theory/pressure"]), rel=5e-4)
    measured = trace(page, "against-nu", "measured")
    np.testing.assert_allclose(measured["y"], at.pressure, rtol=5e-7)
    np.testing.assert_allclose(measured["error_y"]["array"], at.pressure_stderr, rtol=5e-7)
    drawn = trace(page, "against-nu", "kinetic theory")
    np.testing.assert_allclose(drawn["y"], at["theory/pressure"], rtol=5e-7)
    page.find_element("id", "choose-quotient").click()
    quotient = trace(page, "against-nu", "measured")["y"]
    large = at.pressure_large_system / at["theory/pressure"]
    np.testing.assert_allclose(quotient, large, rtol=5e-7)


def test_contours_are_those_of_the_force_ratio_and_of_what_is_chosen(chromium, pages) -> None:
    show(chromium, pages["paper"])
    ratio = open_map(PAPER).force_ratio.sortby("restitution")
    for level in (0.1, 0.25):
        line = trace(chromium, "plane", f"excess {level:g}")
        assert line["contours"]["start"] == line["contours"]["end"] == level
        np.testing.assert_allclose(np.array(line["z"], float), ratio - 1, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(
        trace(chromium, "plane", "observable")["z"], np.log10(ratio), atol=1e-6
    )
    choose(chromium, observable="pressure (m/t²)")
    for switch in ("log", "excess"):
        chromium.find_element("id", f"choose-{switch}").click()
    pressure = open_map(PAPER).pressure.sortby("restitution")
    np.testing.assert_allclose(trace(chromium, "plane", "observable")["z"], pressure, rtol=1e-6)
    assert trace(chromium, "plane", "excess 0.1") is None


def test_arrow_keys_and_clicks_choose_a_point_and_the_address_keeps_it(page, pages) -> None:
    plane = page.find_element("id", "plane")
    assert chosen_point(page) == (0.3, 0.5)
    for key, place in ((Keys.UP, (0.3, 0.6)), (Keys.UP, (0.3, 0.6)), (Keys.RIGHT, (0.5, 0.6))):
        plane.send_keys(key)
        assert chosen_point(page) == place
    assert heading(page).startswith("α = 0.5, ν = 0.6")
    outline = "return getComputedStyle(document.activeElement).outlineStyle"
    assert page.execute_script("return document.activeElement.id") == "plane"
    assert page.execute_script(outline) == "solid"
    address = page.execute_script("return location.hash")
    page.execute_script("element('plane').scrollIntoView({block: 'center'})")
    across, down = page.execute_script(
        "const {xaxis, yaxis} = element('plane')._fullLayout, box = element('plane')"
        ".getBoundingClientRect(); return [xaxis._offset + xaxis.d2p(0.1) - box.width / 2,"
        "yaxis._offset + yaxis.d2p(0.6) - box.height / 2]"
    )
    mouse = ActionChains(page, 50).move_to_element_with_offset(plane, across, down)
    mouse.click().pause(0.5).perform()
    assert chosen_point(page) == (0.1, 0.6)
    show(page, pages["made_up"], address)
    assert chosen_point(page) == (0.5, 0.6)


def test_the_table_is_copied(page) -> None:
    page.execute_script("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
    page.find_element("id", "copy-numbers").click()
    assert page.execute_script("return window.copied").startswith("observable\tvalue")
