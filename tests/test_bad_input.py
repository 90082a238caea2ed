"""Bad input ends with one sentence on what is accepted: nothing runs, no file is left behind."""

import inspect
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import xarray as xr
from command_line import (
    POINTS,
    assert_one_sentence,
    files,
    jaxgran,
    made_up_replicas,
    write_few_variables,
)
from drawn import write_without_drawing
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_maps import ratio_dataset, with_timesteps
from synthetic import one_sentence, refused, snapshot_of

import jaxgran as jg
from jaxgran.analysis import fields
from jaxgran.contact.solve_contacts import contact_residual
from jaxgran.dynamics import snapshots
from jaxgran.io.trajectory import check_trajectory
from jaxgran.maps import automatic, settings_checks
from jaxgran.maps import ratio_map as ratio_map_module
from jaxgran.model.checks import InputError
from jaxgran.model.status import Status
from jaxgran.plotting import theory
from jaxgran.plotting.movie import check_movie
from jaxgran.sampling import heated, sampler, steady_state
from jaxgran.sampling.observe import observed_shapes
from jaxgran.theory.corrected_shear import corrected_shear
from jaxgran.theory.enskog import collisional_transfer
from jaxgran.theory.gaussian_moments import gaussian_moments
from jaxgran.theory.navier_stokes import garzo_dufty

GRAINS = 32
FLOW = {"grains": GRAINS, "restitution": 0.5, "packing_fraction": 0.6, "timestep": 1e-3}
MAP = {"restitution": [0.5, 0.9], "packing_fraction": [0.6]}
SECONDS = 1.0  # of a processor, in which bad input is refused, whatever it is


class WouldRun(Exception):
    """The input has been accepted."""


def would_run(*_, **__):
    raise WouldRun


def cold(_: Any, flows: jg.ShearFlow) -> np.ndarray:
    """A temperature in place of the theory's, which is compiled for every number of points."""
    return np.full(np.shape(flows.restitution), 0.1)


@pytest.fixture(autouse=True, scope="module")
def nothing_runs() -> Iterator[None]:
    """Whatever a public function would compile and run raises ``WouldRun``."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (sampler, "_sample"),
            (snapshots, "_snapshot_series"),
            (fields, "_fields_at"),
            (steady_state, "prepare_batch"),
            (heated, "heat_replica"),
            (ratio_map_module, "run_replicas"),
        ):
            patch.setattr(module, name, would_run)
        for module in (automatic, settings_checks):
            patch.setattr(module, "temperature_of", cold)
        yield


def verdict(function: Callable[[Any], Any], value: Any) -> str:
    """The sentence that refuses a value, empty where it is accepted; all else is a failure."""
    start = time.process_time()
    try:
        function(value)
    except WouldRun:
        return ""
    except InputError as mistake:
        assert one_sentence(str(mistake)), mistake
        assert len(str(mistake)) < 500
        assert time.process_time() - start < SECONDS
        return str(mistake)
    return ""


# Python: every argument of the public functions

KEY = jax.random.key(0)
KEYS = jax.random.split(KEY)
SIDE = np.sqrt(GRAINS * np.pi / 4 / 0.6)
PLACES = np.stack(np.divmod(np.arange(GRAINS), 6), axis=-1)[None] * SIDE / 6  # of a lattice
SEEN = jax.tree.map(lambda x: x[0], snapshot_of(PLACES, side=SIDE))
POINT = np.zeros((1, 2))
SWAPPED = jax.tree.map(lambda x: np.asarray(x).astype(">f8"), SEEN.state)
SINGLE = jax.tree.map(lambda x: x.astype(jnp.float32), SEEN.state)
DILUTE = jg.ShearFlow(GRAINS, 0.5, 0.5, 1e-3)
SLOW = jg.ShearFlow(GRAINS, 0.5, 0.6, 1e-3 / 1e-20, shear_rate=1e-20)


def flow() -> jg.ShearFlow:
    return jg.ShearFlow(**FLOW)


def make_flow(name: str, value: Any) -> jg.ShearFlow:
    return jg.ShearFlow(**{**FLOW, name: value})


def make_map(name: str, value: Any) -> xr.Dataset:
    return jg.ratio_map(**{**MAP, name: value})


PARAMETERS = list(inspect.signature(jg.ratio_map).parameters)
NUMBERS: dict[str, Callable[[Any], Any]] = {
    **{f"ShearFlow {name}": partial(make_flow, name) for name in jg.ShearFlow.__dataclass_fields__},
    **{f"ratio_map {name}": partial(make_map, name) for name in PARAMETERS},
    "polydisperse count": lambda x: jg.polydisperse(x, 0.2, "no key"),
    "polydisperse polydispersity": lambda x: jg.polydisperse(4, x, "no key"),
    "prepare equilibrate": lambda x: jg.prepare(flow(), KEY, x),
    "sample strain": lambda x: jg.sample(flow(), SEEN.state, x),
    "sample blocks": lambda x: jg.sample(flow(), SEEN.state, 1.0, x),
    "heated temperature": lambda x: jg.heated(flow(), KEY, x),
    "own_grains diameters": jg.own_grains,
    "own_grains masses": lambda x: jg.own_grains([1.0, 2.0], x),
    "snapshot_series strain": lambda x: jg.snapshot_series(flow(), SEEN.state, x, 4),
    "snapshot_series count": lambda x: jg.snapshot_series(flow(), SEEN.state, 1.0, x),
    "fields_at points": lambda x: jg.fields_at(SEEN, x, 1.0),
    "fields_at width": lambda x: jg.fields_at(SEEN, POINT, x),
}
FIGURES = [
    "ratio_curves",
    "ratio_contours",
    "ratio_against_timestep",
    "theory_errors",
    "cluster_shares",
]
OBJECTS: dict[str, Callable[[Any], Any]] = {
    "polydisperse key": lambda x: jg.polydisperse(4, 0.2, x),
    "pack flow": lambda x: jg.pack(x, KEY),
    "pack key": lambda x: jg.pack(flow(), x),
    "prepare flow": lambda x: jg.prepare(x, KEY),
    "prepare key": lambda x: jg.prepare(flow(), x),
    "prepare grains": lambda x: jg.prepare(flow(), KEY, grains=x),
    "pack grains": lambda x: jg.pack(flow(), KEY, x),
    "heated grains": lambda x: jg.heated(flow(), KEY, grains=x),
    "sample observe": lambda x: jg.sample(flow(), SEEN.state, 1.0, observe=x),
    "sample callback": lambda x: jg.sample(flow(), SEEN.state, 1.0, callback=x),
    "sample flow": lambda x: jg.sample(x, SEEN.state, 1.0),
    "sample state": lambda x: jg.sample(flow(), x, 1.0),
    "advance flow": lambda x: jg.advance(x, SEEN.state, 1),
    "advance state": lambda x: jg.advance(flow(), x, 1),
    "snapshot_series flow": lambda x: jg.snapshot_series(x, SEEN.state, 1.0, 4),
    "snapshot_series state": lambda x: jg.snapshot_series(flow(), x, 1.0, 4),
    "fields_at snapshot": lambda x: jg.fields_at(x, POINT, 1.0),
    "solve_contacts problem": jg.solve_contacts,
    "read_trajectory path": jg.read_trajectory,
    **{f"{name} data": getattr(jg, name) for name in FIGURES},
    "save_figures data": lambda x: jg.save_figures(x, "none/map"),
    "explore data": jg.explore,
}


NEVER: list[Any] = [  # no argument of any function
    10**5000,
    1j,
    {"a": 1},
    object(),
    np.datetime64("2020"),
    np.array([None, 0.5]),
    np.array([]),
    np.zeros((2, 3, 0)),
    np.ma.masked,
    [[0.1], [0.2, 0.3]],
    ["0.5"],
    [float("nan")],
    range(10**12),
    jnp.array([jnp.nan]),
    KEYS,
    SEEN,
    xr.Dataset(),
]


@pytest.mark.parametrize("argument", [*NUMBERS, *OBJECTS])
def test_what_can_be_no_argument_is_refused_in_one_sentence_that_names_it(argument: str) -> None:
    function, name = {**NUMBERS, **OBJECTS}[argument], argument.split()[1]
    for value in NEVER:
        suits = argument == "prepare key" and value is KEYS
        suits |= argument == "ratio_map attributes" and isinstance(value, dict)
        if not suits and not (argument == "fields_at snapshot" and value is SEEN):
            assert re.search(rf"\b{name}\b", verdict(function, value)), value


def test_lists_of_numbers_stand_for_arrays() -> None:
    swapped = jg.ShearFlow(GRAINS, np.array([0, 0.5], ">f8"), np.array(0.6, ">f4"), 1e-3)
    assert swapped == jg.ShearFlow(GRAINS, np.array([0, 0.5]), np.float32(0.6), 1e-3)
    assert all(x.dtype.isnative for x in jax.tree.leaves(swapped))
    flows = jg.ShearFlow(GRAINS, [0, 0.5], (0.5, 0.6), 1e-3)
    assert flows == jg.ShearFlow(GRAINS, np.array([0.0, 0.5]), np.array([0.5, 0.6]), 1e-3)
    row = jg.DelassusProblem([[2, -1.0], [-1, 2]], [-1, 0])
    assert jg.solve_contacts(row, 1.0).impulses.tolist() == pytest.approx([4 / 3, 2 / 3], rel=1e-3)
    pair = jg.ContactNetwork([[0, 1]], [[1.0, 0.0]], [1, 1], [-1])
    assert contact_residual(pair, [0.5]) == 0
    with pytest.raises(WouldRun):
        jg.fields_at(SEEN, [[1.0, 2.0]], 0.25)


@pytest.mark.parametrize(
    "number",
    [
        lambda seen: np.histogram(seen.impulses)[0],
        lambda seen: float(seen.impulses.sum()),
        lambda seen: 1.0 if seen.impulses.sum() > 0 else 0.0,
        lambda seen: jnp.sum(seen.impulses[seen.impulses > 0]),
    ],
    ids=["NumPy", "float", "if", "index"],
)
def test_what_jax_cannot_trace_in_observe_is_refused_with_its_line(number: Callable) -> None:
    refusal = verdict(lambda x: observed_shapes(x, flow()), number)
    assert refusal.startswith("observe must compute with jax.numpy")
    assert f"line {number.__code__.co_firstlineno}, 'lambda seen" in refusal


SEVERAL = jax.tree.map(lambda x: np.stack([x, x]), SEEN)
BATCH = jg.ShearFlow(GRAINS, [0.5, 0.9], 0.6, 1e-3)
EVEN = jg.DelassusProblem(np.eye(2), -np.ones(2))
PAIR = jg.ContactNetwork([[0, 1]], [[1.0, 0.0]], [1, 1], [-1])
RATIOS = ratio_dataset()
LAW = jg.constitutive_law()
LOST = replace(SEEN.state, positions=np.nan * SEEN.state.positions)
HALF, LAST = jnp.full(GRAINS, 0.5), np.append(np.ones(GRAINS - 1), 9.0)


class Counter:
    """A function that is equal to others, so that no program can be known by it."""

    __hash__ = None

    def __call__(self, seen: Any) -> Any:
        return seen.impulses.sum()


def sheared(**changes: Any) -> Any:
    return jg.sample(flow(), replace(SEEN.state, **changes), 1.0)


def map_of(**changes: Any) -> xr.Dataset:
    return jg.ratio_map(**{**MAP, "grains": GRAINS, **changes})


def solving(problem: Any, **changes: Any) -> Any:
    return jg.solve_contacts(replace(problem, **changes))


def observing(number: Callable) -> Any:
    return observed_shapes(number, flow())


def fitting(**changes: Any) -> Any:
    given = {"flow": flow(), "start": SEVERAL.state, "end": SEVERAL.state, "steps": 9}
    return jg.fit_trajectory(**{**given, "position_noise": 1e-3, "velocity_noise": 1e-2, **changes})


# One row for each check: the words of the sentence, and the call that it refuses.
REFUSED: dict[str, Callable[[], Any]] = {
    # a flow
    "grains must be a whole number of at least 16, not 15": lambda: make_flow("grains", 15),
    "at most 10000000, as memory is limited": lambda: make_flow("grains", 10**12),
    "restitution must be between 0 and 1, not 1.1": lambda: make_flow("restitution", 1.1),
    "fraction must be above 0 and at most 0.83": lambda: make_flow("packing_fraction", 0.831),
    "timestep must be a positive number": lambda: make_flow("timestep", 0.0),
    "timestep must be at most 0.1 / shear_rate": lambda: make_flow("timestep", 0.2),
    "shear_rate must be 0 or between": lambda: make_flow("shear_rate", -1e-9),
    "and 1e+100, not 1e+150": lambda: jg.ShearFlow(GRAINS, 0.5, 0.6, 1e-153, shear_rate=1e150),
    "between 1e-100 and 1e+100, not 1e-150": lambda: make_flow("shear_rate", 1e-150),
    "polydispersity must be between 0 and 0.5": lambda: make_flow("polydispersity", 0.51),
    "arrays of one shape": lambda: jg.ShearFlow(GRAINS, np.zeros(2), np.full(3, 0.5), 1e-3),
    # grains
    "diameters must be a list of positive numbers": lambda: jg.own_grains([1.0, -1.0]),
    "as many masses as diameters, and there are 1 and 2": lambda: jg.own_grains([1.0, 2.0], [1.0]),
    "mean diameter must be 1": lambda: jg.pack(flow(), KEY, jg.Grains(0.7 * HALF, HALF)),
    "of shapes": lambda: jg.pack(flow(), KEY, jg.Grains(HALF, jnp.ones(3))),
    # preparation, sample, snapshots
    "one ShearFlow, and this is a batch": lambda: jg.pack(BATCH, KEY),
    "numbers of the flow must be single ones or": lambda: jg.prepare(BATCH, KEY),
    "grains must have the byte order of this": lambda: jg.pack(flow(), KEY, SWAPPED.grains),
    "state must have the byte order of this": lambda: jg.sample(flow(), SWAPPED, 1.0),
    "at least 2.3e-13 in float32, not 1e-20": lambda: jg.sample(SLOW, SINGLE, 1.0),
    "at most 2147483647 time steps": lambda: jg.sample(flow(), SEEN.state, 1e30),
    "one State of 64 grains": lambda: jg.sample(make_flow("grains", 64), SEEN.state, 1.0),
    # a state
    "of velocities (32, 2), not (32, 3)": lambda: sheared(velocities=np.zeros((GRAINS, 3))),
    "only finite velocities": lambda: sheared(velocities=np.full((GRAINS, 2), np.nan)),
    "of tilt (), not (1,)": lambda: sheared(tilt=np.zeros(1)),
    "only finite tilt": lambda: sheared(tilt=np.float64(np.inf)),
    "only positive and finite side": lambda: sheared(side=np.float64(np.nan)),
    "only positive and finite masses": lambda: sheared(grains=jg.Grains(HALF, -HALF)),
    "its numbers are int64": lambda: jg.sample(
        flow(), jax.tree.map(lambda x: np.asarray(x, int), SEEN.state), 1.0
    ),
    "only positive and finite radii": lambda: sheared(grains=jg.Grains(-HALF, HALF)),
    "grains 0 and 1 are 0 diameters apart": lambda: sheared(positions=PLACES[0, ::2].repeat(2, 0)),
    "no total momentum": lambda: sheared(velocities=np.ones((GRAINS, 2))),
    "0.6, which the state has": lambda: jg.sample(DILUTE, SEEN.state, 1.0),
    "its numbers are float32 and float64": lambda: sheared(tilt=np.float32(0)),
    "blocks must be at most 1000000": lambda: jg.sample(flow(), SEEN.state, 1.0, 10**6 + 1),
    "velocities has the type list": lambda: sheared(velocities=PLACES[0].tolist()),
    "steps must be one number": lambda: jg.count_events(flow(), SEEN.state, np.array([5, 5])),
    "at least 1.6e-05 / shear_rate": lambda: jg.snapshot_series(
        make_flow("timestep", 1e-7), SINGLE, 1e-3, 4
    ),
    "a whole number of 0 to 2147483647": lambda: jg.advance(flow(), SEEN.state, 2**31),
    "count must be at most": lambda: jg.snapshot_series(flow(), SEEN.state, 1.0, 10**9),
    "strain must be": lambda: jg.snapshot_series(flow(), SEEN.state, 1e-3, 5),
    "which varies: sum over the contacts": lambda: observing(lambda seen: seen.impulses),
    "observe must return real numbers": lambda: observing(lambda _: 1j),
    "observe must return at least one number, not": lambda: observing(lambda _: {}),
    "observe must be hashable": lambda: jg.sample(flow(), SEEN.state, 1.0, observe=Counter()),
    "observe must return real numbers, not": lambda: observing(lambda _: jax.random.key(0)),
    "restitution must be one first guess": lambda: fitting(flow=make_flow("restitution", 1.0)),
    "position_noise must be above 0": lambda: fitting(position_noise=0.0),
    "iterations must be a whole number of at least 10": lambda: fitting(iterations=1),
    "start and end must be states with the same": lambda: fitting(start=SEEN.state, end=SEEN.state),
    # contact problems
    "at least one contact": lambda: solving(EVEN, approach=jnp.zeros(0)),
    "jax.vmap": lambda: solving(EVEN, approach=np.ones((1, 2))),
    "approach must be finite": lambda: solving(EVEN, approach=np.array([np.nan, 1.0])),
    "symmetric": lambda: solving(EVEN, matrix=np.eye(2) + np.eye(2, k=1)),
    "no negative eigenvalue": lambda: solving(EVEN, matrix=np.array([[1.0, 2.0], [2.0, 1.0]])),
    "must have entries": lambda: solving(EVEN, matrix=scipy.sparse.csr_array((2, 2))),
    "masses must be positive": lambda: solving(PAIR, masses=np.zeros(2)),
    "two walls": lambda: solving(PAIR, masses=np.full(2, np.inf)),
    "numbers of grains, 0 to 0": lambda: solving(PAIR, masses=np.ones(1)),
    "one grain twice": lambda: solving(PAIR, ends=np.ones((1, 2), int)),
    "unit vectors": lambda: solving(PAIR, normals=2 * np.ones((1, 2))),
    "impulses must be an array (2,)": lambda: contact_residual(EVEN, np.zeros(1)),
    # maps
    "a number or a list of numbers, not (True": lambda: make_map("restitution", [True, 0.5]),
    "must be a list without repetition, in any": lambda: make_map("restitution", (0.5, 0.9, 0.5)),
    "at most 1000000 replicas, points times seeds": lambda: make_map("seeds", 600_000),
    "first_seed must be a whole number of at least 0": lambda: make_map("first_seed", -1),
    "to avoid deep overlaps, which is safe for all": lambda: make_map("timestep", 0.09),
    "at least 1e-08 / shear rate": lambda: make_map("timestep", 1e-300),
    "at least 160 time steps": lambda: map_of(strain=0.1, timestep=(1e-4, 1e-3)),
    "error must be between 1e-3 and 0.5": lambda: make_map("error", 0.0),
    "at least 0 and at most 1e+06": lambda: make_map("equilibrate", 1e30),
    "tolerance must be between": lambda: make_map("tolerance", 1.0),
    "`strain` and `error` exclude each other": lambda: map_of(strain=5.0, error=0.02),
    "engine numba cannot run": lambda: map_of(engine=jg.Numba(), solver=jg.Jacobi()),
    "part must be K/N": lambda: make_map("part", "4/3"),
    "length divides the number of grains, 32": lambda: map_of(diameters=[1.0, 1.4, 2.0]),
    "the largest diameter": lambda: map_of(diameters=LAST),
    "polydispersity must be": lambda: map_of(diameters=[1.0, 2.0], polydispersity=0.1),
    "names without spaces and signs": lambda: make_map("observe", lambda _: {"of all": 1.0}),
    "does not have, not 'pressure'": lambda: make_map("observe", lambda _: {"pressure": 1.0}),
    "a dictionary of numbers": lambda: make_map("observe", lambda seen: seen.state.side),
    "names that a map does not have, not 'seeds'": lambda: make_map("attributes", {"seeds": 7}),
    "attributes must be texts or numbers": lambda: make_map("attributes", {"label": None}),
    "numbers of 64 bits, not True": lambda: make_map("attributes", {"final": True}),
    "of 64 bits, not 1180591620717411303424": lambda: make_map("attributes", {"large": 2**70}),
    "begin with a letter and have no slash, not 'a/b'": lambda: make_map("attributes", {"a/b": 1}),
    "begin with a letter and have no slash, not '_Fi": lambda: make_map(
        "attributes", {"_FillValue": 1.0}
    ),
    "a map does not have, not 'CLASS'": lambda: make_map("attributes", {"CLASS": "x"}),
    "output must be": lambda: make_map("output", "map.txt"),
    "resume": lambda: make_map("resume", True),
    # fields, figures, pages, files
    "it has no pressure, shear_stress, stress_ratio": lambda: jg.theory_errors(RATIOS),
    "has 5 and 1": lambda: jg.ratio_contours(ratio_dataset(5, 1)),
    "at least two time steps, and this map has 1": lambda: jg.ratio_against_timestep(RATIOS),
    "at least two numbers of grains, and this": lambda: jg.averages_against_grains(RATIOS),
    "in a folder that can be written to": lambda: jg.save_figures(RATIOS, "none/map"),
    "a name of at most 200 bytes": lambda: jg.save_figures(RATIOS, "é" * 120),
    "format must be": lambda: jg.save_figures(RATIOS, "map", format="gif"),
    "dpi must be": lambda: jg.save_figures(RATIOS, "map", dpi=49),
    "movie must be": lambda: check_movie(Path("flow.avi")),
    "trajectory must be": lambda: check_trajectory(Path("flow.nc")),
    "seen must be a flow of finite": lambda: jg.flow_figure(replace(SEEN, state=LOST)),
    "there is no file": lambda: jg.read_trajectory("none.gsd"),
    # theories and the law
    "packing_fraction must be a number above 0": lambda: gaussian_moments(0.5, 1.2),
    "restitution must be a number between 0 and 1, not 1.5": lambda: garzo_dufty(1.5, 0.6),
    "restitution must be a number between 0 and 1, not -0.5": lambda: corrected_shear(-0.5, 0.6),
    "polydispersity must be a number of at least 0": lambda: gaussian_moments(0.5, 0.6, 1.0, 1.5),
    "temperature must be a tensor (2, 2)": lambda: collisional_transfer(np.ones(4), 0.5, 0.6),
    "shape that broadcasts with those of": lambda: LAW([0.5, 0.6], 0.6, [1.0, 2.0, 3.0]),
    "the reference map, not [0.5, None]": lambda: LAW(np.ma.array([0.5, 1], mask=[0, 1]), 0.6),
    "path must be in a folder that exists": lambda: LAW.to_csv("none/law.csv"),
    "count must be a whole number of at least 1": lambda: jg.grid(1.0, 0),
    "side must be a positive number": lambda: jg.grid(-1.0, 2),
    "shapes that broadcast, not (1, 2) and (3,)": lambda: jg.validity([[0.5, 0.6]], 3 * [0.6]),
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_refusal_says_what_is_accepted(words: str) -> None:
    with refused(re.escape(words)):
        REFUSED[words]()


RUN = ("run", "--restitution", "0.5", "--packing-fraction", "0.6")

# Files


NO_MAPS: dict[str, xr.Dataset] = {
    "no values": RATIOS.drop_vars("force_ratio"),
    "another dimension": RATIOS.expand_dims("seed"),
    "empty": RATIOS.isel(restitution=slice(0)),
    "text": RATIOS.assign(force_ratio=RATIOS.force_ratio.astype(str)),
    "repetition on an axis": ratio_dataset(alphas=2).assign_coords(restitution=[0.5, 0.5]),
    "repeated time steps": with_timesteps(RATIOS, 1e-3, 1e-3),
    "status without meanings": RATIOS.assign(status=RATIOS.status.drop_attrs()),
}


@pytest.mark.parametrize("kind", NO_MAPS)
def test_what_is_no_map_is_refused_as_a_dataset_and_as_a_file(kind: str, tmp_path: Path) -> None:
    data = NO_MAPS[kind]
    with refused("must be a ratio map"):
        jg.ratio_curves(data)
    data.to_netcdf(tmp_path / "no.nc", engine="netcdf4")
    for words in (["plot", "no.nc"], ["map", "--from-map", "no.nc"]):
        outcome = jaxgran(tmp_path, *words)
        assert_one_sentence(outcome)
        assert "'no.nc' is not a ratio map: " in outcome.err
    assert files(tmp_path) == {"no.nc"}


@settings(max_examples=10)
@given(st.floats(0, 1, exclude_max=True))
def test_a_truncated_map_is_refused_wherever_it_ends(share: float) -> None:
    with TemporaryDirectory() as name:
        torn = Path(name) / "torn.nc"
        ratio_dataset(alphas=2, nus=2).to_netcdf(torn, engine="netcdf4")
        torn.write_bytes(torn.read_bytes()[: int(share * torn.stat().st_size)])
        assert_one_sentence(jaxgran(Path(name), "plot", "torn.nc"))
        assert files(Path(name)) == {"torn.nc"}


CHOICES = {
    "restitution": [0.1, 0.9],
    "packing_fraction": [0.3, 0.8],
    "solver_requested": "barzilai-borwein",
    "solver_parameters": '{"tolerance": 1e-4, "max_steps": 5000}',
    "engine_requested": "auto",
    "equilibrate": "until steady",
    "snapshots": 0,
    "first_seed": 0,
}
IMPOSSIBLE = {
    "grains": "many",
    "strain": [1.0, 2.0],
    "solver_requested": "other",
    "engine_requested": "other",
    "activation": "other",
    "equilibrate": "other",
    "solver_parameters": '{"damping": 1.0}',
    "first_seed": None,  # it is missing
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_a_map_with_impossible_choices_cannot_be_repeated(name: str, tmp_path: Path) -> None:
    data = ratio_dataset(alphas=2, nus=2)
    attrs = {**data.attrs, **CHOICES, name: IMPOSSIBLE[name]}
    known = {key: value for key, value in attrs.items() if value is not None}
    data.drop_attrs(deep=False).assign_attrs(known).to_netcdf(tmp_path / "old.nc", engine="netcdf4")
    outcome = jaxgran(tmp_path, "map", "--from-map", "old.nc", "--output", "new.nc")
    assert_one_sentence(outcome)
    assert name.partition("_")[0] in outcome.err
    assert files(tmp_path) == {"old.nc"}


# Where things are written


@pytest.mark.parametrize("name", ["-a'b\"c $d Strömung 流れ.x.nc", "\udcff.nc"])
def test_an_output_of_any_name_is_written_with_its_figures_and_read_again(
    name: str, tmp_path: Path, monkeypatch
) -> None:
    made = made_up_replicas({(0, 0): Status.ok, (1, 0): Status.ok})
    monkeypatch.setattr(ratio_map_module, "run_replicas", made)
    write_few_variables(monkeypatch, *theory.CLUSTERS)
    write_without_drawing(monkeypatch)
    outcome = jaxgran(tmp_path, "map", *POINTS, "--seeds", "1", f"--output={name}")
    assert outcome.status == 0, outcome.err
    stem = name.removesuffix(".nc")
    pictures = {f"{stem}_curves.png", f"{stem}_clusters.png"}
    assert files(tmp_path) == {name, *pictures}
    (tmp_path / f"fig {stem}").mkdir()
    outcome = jaxgran(tmp_path, "plot", f"--output=fig {stem}", "--", name)
    assert outcome.status == 0, outcome.err
    assert files(tmp_path / f"fig {stem}") == pictures


OUTPUTS = {
    ".nc": "ends in .nc",
    "folder.nc": "is a folder",
    "file.txt/map.nc": "a folder that exists",
    "taken.nc": "a file has this name",
    "流" * 90 + ".nc": "at most 200 bytes",
}


@pytest.mark.parametrize("output", OUTPUTS, ids=["no stem", "folder", "in a file", "taken", "long"])
def test_an_output_that_cannot_be_written_is_refused_before_anything_runs(
    output: str, tmp_path: Path
) -> None:
    (tmp_path / "folder.nc").mkdir()
    (tmp_path / "file.txt").write_text("no folder")
    (tmp_path / "taken.nc.unfinished").write_text("no folder")
    before = files(tmp_path)
    for words in (RUN, ["map"]):
        outcome = jaxgran(tmp_path, *words, f"--output={output}")
        assert_one_sentence(outcome)
        assert OUTPUTS[output] in outcome.err
    assert files(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only_is_refused(tmp_path: Path) -> None:
    ratio_dataset(alphas=2, nus=1).to_netcdf(tmp_path / "map.nc", engine="netcdf4")
    tmp_path.chmod(0o500)
    for words in (["plot", "map.nc"], ["map", "--output=new.nc"], [*RUN, "--output=new.nc"]):
        assert_one_sentence(jaxgran(tmp_path, *words))
    assert files(tmp_path) == {"map.nc"}


def test_a_file_system_that_fails_while_figures_are_drawn_is_one_sentence(
    tmp_path: Path, monkeypatch
) -> None:
    ratio_dataset(alphas=2, nus=1).to_netcdf(tmp_path / "map.nc", engine="netcdf4")
    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError(28, "No space left on device")))
    outcome = jaxgran(tmp_path, "plot", "map.nc")
    said = "jaxgran: stopped by the file system, No space left on device: 'map_curves.png'.\n"
    assert (outcome.status, outcome.err) == (1, said)
    assert files(tmp_path) == {"map.nc"}


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a system without a full device")
@pytest.mark.parametrize("words", ["where --restitution 0.5 --packing-fraction 0.6", "--help"])
def test_a_full_disk_under_the_output_is_one_sentence(words: str) -> None:
    command = [sys.executable, "-m", "jaxgran", *words.split()]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    said = "jaxgran: stopped by the file system, No space left on device.\n"
    assert (done.returncode, done.stderr) == (1, said)
