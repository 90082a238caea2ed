"""The sizes of the grains of a map: measured, kept in the file, and repeated from it."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from synthetic import refused

import jaxgran as jg
from jaxgran.maps.ratio_map import ratio_map
from jaxgran.maps.start import combined
from jaxgran.theory.assumptions import ASSUMPTIONS
from jaxgran.theory.gaussian_moments import gaussian_moments, mixture_moments

MAP: dict[str, Any] = {
    "restitution": [0.9],
    "packing_fraction": [0.6],
    "grains": 32,
    "seeds": 1,
    "equilibrate": 0.5,
    "strain": 1.6,
}
RATIO = 1.4
pytestmark = pytest.mark.filterwarnings("ignore::jaxgran.maps.status_report.BadPoints")


@pytest.fixture(scope="module")
def bidisperse(tmp_path_factory: pytest.TempPathFactory) -> xr.DataTree:
    """A map of two sizes, read from its file."""
    output = tmp_path_factory.mktemp("sizes") / "map.nc"
    ratio_map(**MAP, diameters=[1.0, RATIO], snapshots=True, output=output)
    data = jg.open_map(output)
    data.attrs["file"] = str(output)
    return data


def test_the_grains_are_those_that_are_given_at_the_packing_fraction(
    bidisperse: xr.DataTree,
) -> None:
    seen = bidisperse["states"]
    sizes = 2 * np.sort(seen.radii.values.ravel())
    np.testing.assert_allclose(sizes, np.repeat([1.0, RATIO], 16) / (1 + RATIO) * 2, rtol=1e-3)
    assert (np.pi / 4 * (sizes**2).sum() / seen.side.item() ** 2) == pytest.approx(0.6, rel=1e-3)


def test_theory_is_that_of_the_mixture(bidisperse: xr.DataTree) -> None:
    small, large = np.array([1.0, RATIO]) * 2 / (1 + RATIO)
    diameters = np.array([small, large])
    theory = mixture_moments(0.9, 0.6, 1.0, diameters, diameters**2, np.array([0.5, 0.5]))
    there = bidisperse["theory"]
    for name in ("granular_temperature", "pressure", "shear_stress", "collision_rate"):
        np.testing.assert_allclose(there[name].item(), getattr(theory, name), rtol=1e-6)
    factors = [there[f"enskog_factor_pressure_{factor}"].item() for factor in ASSUMPTIONS]
    contact = np.trace(bidisperse["stresses/contact_stress"].values.reshape(2, 2)) / 2
    assert np.prod(factors) * there["enskog_pressure"].item() == pytest.approx(contact, rel=1e-9)


def test_a_map_is_repeated_from_its_file_to_the_bit(bidisperse: xr.DataTree) -> None:
    again = ratio_map(from_map=bidisperse.attrs["file"])
    assert again.equals(bidisperse)
    assert again.attrs["diameters"] == [1.0, RATIO] and "polydispersity" not in again.attrs
    uniform = ratio_map(from_map=bidisperse.attrs["file"], polydispersity=0.26, snapshots=False)
    assert uniform.force_ratio.equals(ratio_map(**MAP).force_ratio)


def test_the_width_of_the_uniform_distribution_is_a_setting_of_a_map(
    bidisperse: xr.DataTree,
) -> None:
    wide = ratio_map(**MAP, polydispersity=0.5, snapshots=True)
    assert wide["states"].radii.max().item() == pytest.approx(0.75 * (1 - 1 / 96), rel=1e-3)
    assert wide.attrs["polydispersity"] == 0.5
    theory = gaussian_moments(0.9, 0.6, 1.0, 0.5)
    assert wide["theory/pressure"].item() == pytest.approx(float(theory.pressure), rel=1e-6)


def test_other_sizes_are_another_map(bidisperse: xr.DataTree) -> None:
    output = bidisperse.attrs["file"]
    for other, words in (([1.0, 2.0], r".1\.0, 2\.0."), (None, "None")):
        with refused(rf"has a map with diameters .1\.0, 1\.4. and not {words}"):
            ratio_map(**MAP, diameters=other, snapshots=True, output=output)


def test_a_polydispersity_of_a_file_is_replaced_by_diameters() -> None:
    diameters = {"diameters": (1.0, RATIO)}
    assert combined({"polydispersity": 0.1}, diameters) == diameters
