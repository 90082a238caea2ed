"""The page of a map in a real browser, without a network."""

import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pages import MARKUP, page_map

import jaxgran as jg

pytestmark = pytest.mark.environment
OPTIONS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
)
OFFLINE = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}


@pytest.fixture
def chromium() -> Iterator[Any]:
    """Chromium without a network; the test is skipped where Selenium or Chromium is missing."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="Selenium is not installed")
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("Chromium is not installed: apt-get install chromium chromium-driver")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = binary
        for option in (*OPTIONS.split(), f"--user-data-dir={profile}"):
            options.add_argument(option)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
        try:
            browser.execute_cdp_cmd("Network.enable", {})
            browser.execute_cdp_cmd("Network.emulateNetworkConditions", OFFLINE)
            browser.get("about:blank")
            browser.get_log("performance")  # the browser loads pages of its own when it starts
            yield browser
        finally:
            browser.quit()


def test_a_page_opens_offline_draws_its_map_and_shows_markup_as_text(
    chromium: Any, tmp_path: Path
) -> None:
    from selenium.webdriver.support.wait import WebDriverWait

    page = tmp_path / "map.html"
    jg.explore(page_map(), page)
    chromium.get(page.as_uri())
    WebDriverWait(chromium, 30, 0.05).until(
        lambda _: chromium.execute_script("return document.body?.dataset.ready")
    )
    assert [entry["message"] for entry in chromium.get_log("browser")] == []
    events = [json.loads(entry["message"])["message"] for entry in chromium.get_log("performance")]
    urls = {x["params"]["request"]["url"] for x in events if "request" in x.get("params", {})}
    assert {url for url in urls if not url.startswith(("data:", "about:"))} == {page.as_uri()}

    curves = chromium.execute_script(
        "return element('against-nu').data.filter((trace) => trace.name === 'measured')"
        ".map((trace) => [Array.from(trace.y), Array.from(trace.error_y.array)])"
    )
    shown = chromium.find_element("id", "which").text
    assert shown.startswith("α = 0.7, ") and shown.endswith("dt = 5e-4/γ̇")
    line = page_map().sel(timestep=5e-4, restitution=0.7)
    np.testing.assert_allclose(curves, [[line.force_ratio, line.force_ratio_stderr]], rtol=5e-7)

    assert chromium.find_element("id", "title").text == " ".join(MARKUP.split())
    assert chromium.execute_script("return !window.hacked")
    assert (
        chromium.execute_script("return document.querySelectorAll('body u, body img').length") == 0
    )
