"""Made-up maps and flows for pages, and a browser that opens them."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
import xarray as xr
from synthetic import random_instant, random_replica, random_tally, snapshot_of

from jaxgran.dynamics.engine import DEFAULT_NUMERICS
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.settings import MapSettings
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status
from jaxgran.page.film import Film

MARKUP = '<script>window.hacked = 1</script><img src=x onerror="window.hacked = 2">&amp; <b>bold</b>'
"""An attribute that would run as a script, if it were markup."""

_OPTIONS = (
    "--headless=new --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --hide-scrollbars --window-size=1400,1400 --force-device-scale-factor=1"
)


@cache
def page_map() -> xr.DataTree:
    """A map of 2 time steps × 2 × 3 points: one is bad, one was not run, and names and attributes hold markup."""
    settings = MapSettings(
        (0.5, 0.7, 0.9), (0.5, 0.6), grains=64, seeds=2, timestep=(1e-3, 5e-4), strain=2.0, snapshots=True
    )
    rng, flows = np.random.default_rng(0), settings.flows()
    results = {}
    for point in range(len(flows)):
        status = Status.deep_overlap if point == 7 else Status.ok
        if point != 8:
            instant = random_instant(point, 64, 12)._replace(force=np.geomspace(1, 100, 12))
            results[point, 0] = random_replica(rng, settings, status)._replace(instant=instant)
            results[point, 1] = random_replica(rng, settings, status)
    data = map_dataset(settings, results, {"title": MARKUP})
    own = data.force_ratio.assign_attrs(long_name=MARKUP, units="<i>σ</i>") ** 2
    data["own <u>name</u>"] = own.assign_attrs(long_name=MARKUP, units="<i>σ</i>")
    return data


def made_up_film(frames: int = 5) -> Film:
    """A film of a few grains that stay where they are, with the sums of random steps between its frames."""
    rng, film, steps = np.random.default_rng(0), Film(), iter(range(frames))
    flow = jax.tree.map(lambda x: np.array([x]), ShearFlow(16, 0.1, 0.8, 1e-3))
    seen = snapshot_of(rng.uniform(0, 5, (1, 16, 2)), [[(0, 1, 2.0), (1, 2, 1.0), (5, 6, 1.0)]], side=5.0)
    frame = jax.tree.map(lambda x: x[0], seen)
    state: Any = SimpleNamespace(side=np.array([5.0]))
    recorder: Any = SimpleNamespace(recording=lambda advance: advance)
    advance = film.recording(recorder)(lambda flow, numerics, state, steps: (state, random_tally(rng, 1)))
    for step in steps:
        if step:
            advance(flow, DEFAULT_NUMERICS, state, np.array([1]))
        film.frames.keep(frame, 10 * step)
    return film


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium by Selenium, without a network; a test that needs it is skipped where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="browser tests need Selenium: pip install selenium.")
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
            offline = {"offline": True, "latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
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
    WebDriverWait(chromium, 30, 0.05).until(lambda _: chromium.execute_script("return document.body?.dataset.ready"))
