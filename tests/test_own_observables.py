"""A user's observables in a map are averaged like the built-in ones and survive an interruption."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from synthetic import refused

from jaxgran.maps import blocks
from jaxgran.maps.attributes import from_attrs
from jaxgran.maps.own_observables import identity_of
from jaxgran.maps.ratio_map import ratio_map
from jaxgran.maps.results import open_map
from jaxgran.maps.settings import MapSettings

GRAINS = 32
MAP: dict[str, Any] = {
    "restitution": (0.5, 0.9),
    "packing_fraction": (0.7,),
    "grains": GRAINS,
    "seeds": 2,
    "equilibrate": 0.5,
    # blocks of 100 time steps: more steps with contacts than the numba engine records in a call
    "strain": 3.2,
}
pytestmark = pytest.mark.filterwarnings("ignore::jaxgran.maps.status_report.BadPoints")


def observe(seen) -> dict:
    pushes, n = seen.impulses > 0, seen.contacts.normals
    forces = seen.impulses / seen.timestep
    return {
        "contacts_per_grain": 2 * jnp.sum(pushes) / GRAINS,
        "own_stress": jnp.einsum("c,ca,cb->ab", forces * seen.contacts.distances, n, n)
        / seen.state.side**2,
    }


@pytest.fixture(scope="module")
def observed() -> xr.DataTree:
    return ratio_map(**MAP, observe=observe)


def assert_same_variables(data: xr.DataTree, other: xr.DataTree) -> None:
    """All variables of ``other`` are in ``data``, bit for bit."""
    for node in other.subtree:
        for name, variable in node.data_vars.items():
            there = data[node.path][name]
            if name == "tally":  # the sums of the user's observables are behind the others
                there = there.isel(quantity=slice(variable.sizes["quantity"]))
            np.testing.assert_array_equal(there, variable, err_msg=f"{node.path} {name}")


def test_what_repeats_a_built_in_average_has_its_values_and_errors(observed) -> None:
    for end in ("", "_stderr"):
        own, built_in = observed[f"contacts_per_grain{end}"], observed[f"coordination_number{end}"]
        np.testing.assert_allclose(own, built_in, rtol=1e-9)
        own, built_in = observed[f"own_stress{end}"], observed[f"stresses/contact_stress{end}"]
        np.testing.assert_allclose(own, built_in, rtol=1e-9)
    assert observed.own_stress.dims[2:] == ("own_stress_dim_0", "own_stress_dim_1")
    assert "units" not in observed.own_stress.attrs


def test_an_unfinished_map_goes_on_to_the_same_bits_with_the_same_function_only(
    observed, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(blocks, "SECONDS", 0.0)
    folder, output = tmp_path / "map.nc.unfinished", tmp_path / "map.nc"
    calls = 0

    def cut_off(_: float) -> None:  # in the sample of the second batch
        nonlocal calls
        calls += any(folder.glob("replica-*"))
        if calls > 20:
            raise RuntimeError("cut off")

    with pytest.raises(RuntimeError, match="cut off"):
        ratio_map(**MAP, observe=observe, output=output, progress=cut_off, workers=1)
    assert list(folder.glob("replica-*")) and list(folder.glob("blocks-*"))

    def other_function(seen) -> dict:
        return observe(seen) | {"contacts_per_grain": jnp.sum(seen.impulses > 0) / GRAINS}

    for other in (None, other_function):
        with refused(r"has observe 'contacts_per_grain, own_stress: \w{16}', not "):
            ratio_map(**MAP, observe=other, output=output, resume=True)
    steps: list[float] = []
    same = {"observe": lambda seen: observe(seen), "output": output, "resume": True}
    data = ratio_map(**MAP, **same, progress=steps.append)
    sample_and_before = 2 * 4 * (3.2 + 0.5) / 1e-3
    assert sum(steps) < 0.4 * sample_and_before
    for again in (data, open_map(output), ratio_map(**MAP, **same)):
        assert_same_variables(again, observed)
    with refused("has a map with observe 'contacts_per_grain, own_stress: .*' and not None"):
        ratio_map(**MAP, output=output, resume=True)
    with refused("must be a function that is passed to `ratio_map`"):
        MapSettings(**from_attrs(data))


def test_what_a_function_computes_counts_and_not_its_place() -> None:
    def of(function) -> str | None:
        return identity_of(MapSettings(**MAP, observe=function))

    constant = np.arange(3.0)
    assert of(observe) == of(lambda seen: observe(seen)) != None  # noqa: E711
    assert of(lambda _: {"a": constant}) != of(lambda _: {"a": constant + 1})
    assert of(lambda _: {"a": constant}) != of(lambda _: {"b": constant})
    assert identity_of(MapSettings(**MAP)) is None


CALLS = {
    "jit": jax.jit,
    "jit in jit": lambda f: jax.jit(jax.jit(f)),
    "branch": lambda f: lambda: jax.lax.cond(True, f, f),
    "loop": lambda f: lambda: jax.lax.fori_loop(0, 2, lambda _, x: x + f(), jnp.zeros(2000)),
}


@pytest.mark.parametrize("where", CALLS)
def test_constants_of_what_a_function_calls_count(where: str) -> None:
    def of(constant) -> str | None:
        table = jnp.asarray(constant)
        inner = CALLS[where](lambda: 2 * table)
        return identity_of(MapSettings(**MAP, observe=lambda _: {"a": inner()}))

    constant = np.random.default_rng(0).normal(size=2000)  # longer than what is printed
    changed = constant.copy()
    changed[1000] += 1
    assert of(constant) == of(constant.copy()) != of(changed)
