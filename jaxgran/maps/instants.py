"""Instants, stored by a map with ``snapshots``: grains and forces of one replica of each point, after its sample.

The replica is advanced from its last state by a short strain, over which the forces are averaged. The sample is not
affected, so the averages of a map are the same with and without instants.

The stored instant is that of the first good seed of a point. Batches do not communicate, so each batch takes an instant
of the first good replica of each of its points, and the map selects from them.
"""

import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from jaxgran.analysis.instant import Instant, averaged, instant_of
from jaxgran.dynamics.engine import Numerics
from jaxgran.maps.points import PointGrid
from jaxgran.maps.replica import Key, Replica
from jaxgran.model.flow import ShearFlow, steps_of_strain
from jaxgran.model.state import State
from jaxgran.model.status import GIVEN_UP
from jaxgran.sampling.batch import advance_batch
from jaxgran.sampling.recorder import Recorder
from jaxgran.sampling.steady_state import Batch

WINDOW = 0.002
"""Strain over which the forces of an instant are averaged."""

_MOST_STEPS = 1000  # of the window, where the time step is very short
_BITS = 12  # binary digits of a stored number; the zeros after them compress well
_POSITION_BITS = 18  # of positions, which may be 50 times as large as a radius
_PACKED = {"zlib": True, "shuffle": True, "complevel": 4}
_NO_GRAIN = -1
_GRAIN, _PAIR = ("grain",), ("pair",)
_MEANINGS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "x": ("position of a grain along the flow, from the centre of the sheared cell", "sigma", _GRAIN),
    "y": ("position of a grain along the gradient, from the centre of the sheared cell", "sigma", _GRAIN),
    "radius": ("radius of a grain", "sigma", _GRAIN),
    "speed": ("peculiar speed of a grain", "sigma / t", _GRAIN),
    "pair_i": ("first grain of a pair in contact, -1 after the last pair", "1", _PAIR),
    "pair_j": ("second grain of a pair in contact, -1 after the last pair", "1", _PAIR),
    "force": ("mean force between the grains of a pair over the window", "m sigma / t^2", _PAIR),
    "clustered": ("whether most of the force of a pair acts within clusters of three or more grains", "1", _PAIR),
    "side": ("side of the cell", "sigma", ()),
    "tilt": ("offset of the image row above, in sides of the cell", "1", ()),
    "window": ("strain over which forces are averaged", "1", ()),
}


def first_instants(batch: Batch, task: Sequence[Key]) -> list[Instant | None]:
    """The instant of the first good replica of every point of a sampled batch; None for the other replicas."""
    found: list[Instant | None] = [None] * len(task)
    done = set()
    for k, (point, _) in enumerate(task):
        if point not in done and batch.status[k] < GIVEN_UP:
            found[k] = _taken(*jax.tree.map(lambda x, k=k: x[k : k + 1], (batch.flow, batch.numerics, batch.state)))
            done |= {point} if found[k] is not None else set()
    return found


def first_of_points(replicas: Mapping[Key, Replica | None]) -> dict[int, Instant]:
    """The instant of the first good seed of every point that has one."""
    good = {
        key: one.instant
        for key, one in replicas.items()
        if one is not None and one.status < GIVEN_UP and one.instant is not None
    }
    return {point: good[point, seed] for point, seed in sorted(good, reverse=True)}


def _taken(flow: ShearFlow, numerics: Numerics, state: State) -> Instant | None:
    """The instant after the state of a batch of one replica; None if the flow does not stay finite."""
    steps = _steps(flow)
    found: list[Instant] = []
    advance = Recorder(0.0, lambda frame, _: found.append(instant_of(frame))).recording(advance_batch)
    # one step fewer than snapshots: a snapshot has the forces of the step that begins with it
    advance(flow, numerics, state, jnp.array([steps - 1], jnp.int32))
    return averaged(found) if len(found) == steps else None


def _steps(flow: ShearFlow) -> int:
    """The number of time steps of the window."""
    return min(max(1, int(steps_of_strain(flow, WINDOW).item())), _MOST_STEPS)


def instant_variables(grid: PointGrid, instants: Mapping[int, Instant]) -> dict[str, xr.Variable]:
    """The group ``snapshots`` of a map, packed.

    Points have different numbers of pairs, and may have different numbers of grains. Unused elements are −1 for indices
    of grains, and NaN otherwise.

    Args:
      grid: the dimensions of a point.
      instants: instants by the number of the point.
    """
    count = math.prod(grid.shape)
    grains = max((len(one.radii) for one in instants.values()), default=0)
    pairs = max((len(one.force) for one in instants.values()), default=0)
    of_grains, of_pairs = (count, grains), (count, pairs)
    values = {
        "x": np.full(of_grains, np.nan, np.float32),
        "y": np.full(of_grains, np.nan, np.float32),
        "radius": np.full(of_grains, np.nan, np.float32),
        "speed": np.full(of_grains, np.nan, np.float32),
        "pair_i": np.full(of_pairs, _NO_GRAIN, np.int32),
        "pair_j": np.full(of_pairs, _NO_GRAIN, np.int32),
        "force": np.full(of_pairs, np.nan, np.float32),
        "clustered": np.zeros(of_pairs, np.int8),
        "side": np.full(count, np.nan),
        "tilt": np.full(count, np.nan),
        "window": np.full(count, np.nan),
    }
    for point, one in instants.items():
        n, p = len(one.radii), len(one.force)
        values["x"][point, :n], values["y"][point, :n] = _rounded(one.positions.T, _POSITION_BITS)
        values["radius"][point, :n], values["speed"][point, :n] = _rounded(one.radii), _rounded(one.speed)
        values["pair_i"][point, :p], values["pair_j"][point, :p] = one.pairs.T
        values["force"][point, :p], values["clustered"][point, :p] = _rounded(one.force), one.clustered
        for name in ("side", "tilt", "window"):
            values[name][point] = getattr(one, name)
    variables = {}
    for name, (long_name, units, further) in _MEANINGS.items():
        variables[name] = grid.variable(values[name], {"long_name": long_name, "units": units}, *further)
        variables[name].encoding = dict(_PACKED) if further else {}
    return variables


def instants_of(data: xr.Dataset, count: int) -> dict[int, Instant]:
    """The instants in the group ``snapshots`` of a map of ``count`` points, by the number of the point."""
    values = {name: data[name].values for name in _MEANINGS}
    values = {name: x.reshape(count, *x.shape[x.ndim - len(_MEANINGS[name][2]) :]) for name, x in values.items()}
    found = {}
    for point in np.flatnonzero(np.isfinite(values["side"])).tolist():
        here = {name: numbers[point] for name, numbers in values.items()}
        n, p = np.isfinite(here["x"]).sum(), (here["pair_i"] != _NO_GRAIN).sum()
        found[point] = Instant(
            positions=np.column_stack([here["x"], here["y"]])[:n].astype(float),
            radii=here["radius"][:n].astype(float),
            speed=here["speed"][:n].astype(float),
            pairs=np.column_stack([here["pair_i"], here["pair_j"]])[:p],
            force=here["force"][:p].astype(float),
            clustered=here["clustered"][:p] > 0,
            **{name: float(here[name]) for name in ("side", "tilt", "window")},
        )
    return found


def _rounded(values: np.ndarray, bits: int = _BITS) -> np.ndarray:
    """The values with some binary digits each."""
    digits, exponents = np.frexp(values)
    return np.ldexp(np.round(digits * 2.0**bits), exponents - bits)
