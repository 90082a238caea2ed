"""Made-up maps and flows for pages, and a browser that opens them."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from synthetic import random_replica, random_state

from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.model.status import Status

MARKUP = (
    '<script>window.hacked = 1</script><img src=x onerror="window.hacked = 2">&amp; <b>bold</b>'
)
"""An attribute that would run as a script, if it were markup."""

_OPTIONS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync --hide-scrollbars "
    "--window-size=1400,1400 --force-device-scale-factor=1"
)


@cache
def page_map() -> xr.DataTree:
    """A map of 2 time steps × 2 × 3 points: one is bad, one was not run, and names and attributes
    hold markup.
    """
    settings = MapSettings(
        (0.5, 0.7, 0.9),
        (0.5, 0.6),
        grains=64,
        seeds=2,
        timestep=(1e-3, 5e-4),
        strain=2.0,
        snapshots=True,
    )
    rng, results = np.random.default_rng(0), []
    for point in range(len(settings.points)):
        status = Status.deep_overlap if point == 7 else Status.ok
        if point != 8:
            state = random_state(point, 64)
            first = random_replica(rng, settings, status, point)
            results.append(first._replace(state=state))
            results.append(random_replica(rng, settings, status, point, 1))
    data = map_dataset(settings, results, {"title": MARKUP})
    own = data.force_ratio.assign_attrs(long_name=MARKUP, units="<i>σ</i>") ** 2
    data["own <u>name</u>"] = own.assign_attrs(long_name=MARKUP, units="<i>σ</i>")
    return data


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium by Selenium, without a network; a test that needs it is skipped where there is
    none.
    """
    webdriver = pytest.importorskip(
        "selenium.webdriver", reason="browser tests need Selenium: pip install selenium."
    )
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("browser tests need Chromium: apt-get install chromium chromium-driver.")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = binary
        for option in (*_OPTIONS.split(), f"--user-data-dir={profile}"):
            options.add_argument(option)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        chromium = webdriver.Chrome(options, webdriver.ChromeService(driver))
        try:
            chromium.set_script_timeout(30)
            chromium.execute_cdp_cmd("Network.enable", {})
            offline = {
                "offline": True,
                "latency": 0,
                "downloadThroughput": 0,
                "uploadThroughput": 0,
            }
            chromium.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
            still = {"name": "prefers-reduced-motion", "value": "reduce"}
            chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [still]})
            chromium.get("about:blank")
            chromium.get_log("performance")  # the browser loads pages of its own when it starts
            yield chromium
        finally:
            chromium.quit()


def open_page(chromium: Any, path: Path, address: str = "") -> None:
    """Open a page, and wait until it is drawn."""
    from selenium.webdriver.support.wait import WebDriverWait

    chromium.get("about:blank")  # or another address of the same page would not load it again
    chromium.get(f"{path.as_uri()}{address}")
    WebDriverWait(chromium, 30, 0.05).until(
        lambda _: chromium.execute_script("return document.body?.dataset.ready")
    )
