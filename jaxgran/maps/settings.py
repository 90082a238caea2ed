"""The settings of a map, once: names, defaults, ranges, units and help.

A row is a field of ``MapSettings`` if the numbers of a map depend on it, and of ``RunOptions`` if
it says how the map is run and kept. From the rows follow

- the options of ``jaxgran map`` and ``jaxgran run``, with their help, and the tables of the
  documentation,
- the checks of ranges in ``check_settings``,
- the attributes of the dataset, which ``--resume``, ``--from-map`` and ``merge`` compare, see
  ``attributes``.

``ratio_map`` takes them as arguments with the same defaults. This module loads neither JAX nor
xarray by itself, so that the command line prints its help at once.
"""

import math
import os
import sys
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, fields
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from jaxgran.maps.options import Command, Option, option
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.replica import AXES, FURTHER, PLANE, Point
from jaxgran.model.choices import Activation, EngineName, SolverName

if TYPE_CHECKING:
    from jaxgran.dynamics.engine import Numerics
    from jaxgran.model.flow import ShearFlow
    from jaxgran.model.grains import Grains

_POSITIVE = (lambda x: (x > 0) & (x < math.inf), "a positive number")
_ERROR = (lambda x: (x >= 1e-3) & (x <= 0.5), "between 1e-3 and 0.5")
_EQUILIBRATION = (lambda x: (x >= 0) & (x <= 1e6), "a number of at least 0 and at most 1e+06")
_TOLERANCE = (lambda x: (x >= 1e-12) & (x <= 0.1), "between 1e-12 and 0.1")


@dataclass(frozen=True)
class MapSettings:
    """What the numbers of a map depend on, checked, without "auto", and with tuples for lists.

    Each of the four axes is a tuple, also where one number is given. ``solver`` and ``engine`` are
    values, see ``ProjectedMethod`` and ``dynamics.engine``; None stands for the default solver and
    for the automatic choice of an engine. A given ``tolerance`` becomes that of the solver.
    Restitutions and packing fractions are sorted. These and time steps are rounded to ten digits,
    so that 0.3 and 0.1 + 0.2 are one point.

    Raises:
      InputError: (a ValueError) a parameter is out of its range.
    """

    restitution: tuple[float, ...] = option(
        None, "Restitution, 0 to 1.", several=True, default="of the preset"
    )
    packing_fraction: tuple[float, ...] = option(
        None, "Packing fraction, up to 0.83.", several=True, default="of the preset"
    )
    _: KW_ONLY
    grains: tuple[int, ...] = option(
        256,
        'Number of grains; "auto" chooses it for `error`.',
        int,
        several=True,
        auto=True,
        short="n",
    )
    seeds: int = option(2, "Independent runs of each point, averaged together.", int)
    timestep: tuple[float, ...] = option(
        1e-3,
        'Time step of the sample; "auto" takes the longest one that changes the stresses of no '
        "point by more than 2 %, or a share of `error`.",
        several=True,
        auto=True,
        unit="1/shear rate",
        range=(lambda x: x > 0, "a positive number"),
    )
    equilibrate: float | None = option(
        None, "Strain before the sample.", range=_EQUILIBRATION, default="until the flow is steady"
    )
    strain: float | None = option(
        None,
        "Sampled strain of each seed.",
        range=_POSITIVE,
        default="six correlation strains, at least 8",
    )
    error: float | None = option(
        None,
        "Relative error of force ratio and stresses to reach at every point, as half of a 95 % "
        "interval; chooses the strain, and grains and time step unless given.",
        range=_ERROR,
    )
    tolerance: float | None = option(
        None,
        "Relative residual at which a contact solve ends.",
        range=_TOLERANCE,
        default="1e-4, or that of the solver",
    )
    solver: Any = option(
        None,
        "Method of the contact solve.",
        get_args(SolverName),
        default="barzilai-borwein; on a CPU after gauss-seidel",
    )
    activation: Activation = option(
        "midpoint", "When a pair of grains is a contact.", get_args(Activation)
    )
    engine: Any = option(
        None, "Implementation of the simulation.", get_args(EngineName), default="auto"
    )
    grains_by_point: tuple[int, ...] | None = option(
        None,
        "Number of grains of each point, in the order of time steps, packing fractions and "
        "restitutions, the last one fastest; `grains` is then the largest.",
        int,
        commands=(),
    )
    snapshots: bool = option(
        False,
        "Keep the last state of every point, from which `explore` draws its grains and forces.",
        bool,
        commands=("map",),
        off=True,
    )
    first_seed: int = option(0, "Number of the first seed; other numbers are other runs.", int)
    observe: Any = option(
        None,
        "A function as in `sample` that returns numbers or arrays by name; each is averaged into "
        "a variable of this name.",
        commands=(),
    )
    polydispersity: float = option(
        0.26,
        "Half-width of the uniform distribution of diameters, over their mean, 0 to 0.5.",
        range=(lambda x: (x >= 0) & (x <= 0.5), "between 0 and 0.5"),
    )
    diameters: tuple[float, ...] | None = option(
        None,
        "Diameters, in equal numbers of grains, such as 1,1.4, instead of the uniform "
        "distribution; their mean is the unit of length.",
        values=True,
    )
    part: str | None = option(
        None,
        "Measure only the Kth of N parts of about the same cost; `jaxgran merge` joins their "
        "files.",
        str,
        commands=("map",),
        example="K/N",
    )

    def __post_init__(self):
        from jaxgran.maps.settings_checks import check_axes, check_settings, with_tolerance

        object.__setattr__(self, "solver", with_tolerance(self.solver, self.tolerance))
        object.__setattr__(self, "tolerance", None)
        for name in AXES:
            values = getattr(self, name)
            values = values if isinstance(values, tuple) else (values,)
            object.__setattr__(self, name, tuple(map(rounded, values)))
        check_axes(self)
        self._sort_plane()
        check_settings(self)

    def _sort_plane(self) -> None:
        """Put restitutions and packing fractions, and the grains of their points, in ascending
        order.
        """
        if self.grains_by_point is not None:
            rows, columns = np.argsort(self.packing_fraction), np.argsort(self.restitution)
            planes = np.reshape(self.grains_by_point, (-1, len(rows), len(columns)))
            by_point = planes[:, rows][..., columns].ravel().tolist()
            object.__setattr__(self, "grains_by_point", tuple(by_point))
        for name in ("restitution", "packing_fraction"):
            object.__setattr__(self, name, tuple(sorted(getattr(self, name))))

    def __getstate__(self) -> dict[str, Any]:
        """Without the flows, so that what a cluster is sent does not grow with the map."""
        return {row.name: getattr(self, row.name) for row in fields(self)}

    @property
    def axes(self) -> dict[str, tuple[Any, ...]]:
        """Values of the four axes by name, outermost first."""
        return {name: getattr(self, name) for name in AXES}

    @property
    def dimensions(self) -> tuple[str, ...]:
        """The dimensions of a point in the data: the plane, and axes of two or more values."""
        return tuple(name for name, x in self.axes.items() if name in PLANE or len(x) > 1)

    @property
    def seed_numbers(self) -> range:
        """The numbers of the seeds of every point."""
        return range(self.first_seed, self.first_seed + self.seeds)

    @property
    def numerics(self) -> "Numerics":
        """Solver and engine as one value."""
        from jaxgran.dynamics.engine import Numerics

        return Numerics(self.solver, self.engine)

    @property
    def points(self) -> list[Point]:
        """All points, in the order of ``axes``: the last one changes fastest."""
        if self.grains_by_point is None:
            return [Point(*numbers) for numbers in product(*self.axes.values())]
        flows = product(self.timestep, self.packing_fraction, self.restitution)
        sized = zip(self.grains_by_point, flows, strict=True)
        return [Point(grains, *numbers) for grains, numbers in sized]

    @cached_property
    def flows(self) -> "dict[Point, ShearFlow]":
        """The flow of every point; InputError if a number of a flow is out of its range."""
        return {point: self.flow_at(point) for point in self.points}

    def flow_at(self, point: Point) -> "ShearFlow":
        """The flow of a point, which may be one of another map."""
        from jaxgran.model.flow import ShearFlow

        grains, timestep, packing_fraction, restitution = point
        return ShearFlow(
            grains,
            restitution,
            packing_fraction,
            timestep,
            activation=self.activation,
            polydispersity=self.polydispersity,
        )

    def grains_of(self, size: int, replicas: int) -> "Grains | None":
        """The discs (replicas, size) that a flow is given; None where their diameters are
        uniform.
        """
        if self.diameters is None:
            return None
        import jax
        import jax.numpy as jnp

        from jaxgran.model.grains import own_grains

        discs = own_grains(np.resize(self.diameters, size))
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (replicas, size)), discs)

    @property
    def discs(self) -> "Grains | None":
        """A disc of each of the given diameters, for kinetic theory; None where diameters are
        uniform.
        """
        from jaxgran.model.grains import own_grains

        return None if self.diameters is None else own_grains(np.asarray(self.diameters))


def rounded(number: Any) -> Any:
    """A real number to ten digits, or to those that its type has; anything else unchanged.

    Examples:
      >>> rounded(0.1 + 0.2), rounded(np.float32(0.3)), rounded("auto")
      (0.3, 0.3, 'auto')
    """
    if not isinstance(number, (float, np.floating)):
        return number
    return float(f"{number:.{min(10, np.finfo(type(number)).precision)}g}")


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How a map is run and kept, checked: no number of it depends on this.

    Raises:
      InputError: (a ValueError) an option cannot be accepted.
    """

    preset: str | None = option(
        None,
        "Values of all parameters that are not given.",
        tuple(PRESETS),
        commands=("map",),
        default="quick",
    )
    from_map: str | os.PathLike | None = option(
        None,
        "Repeat the map of this file, but for the parameters that are given; with other "
        "restitutions or packing fractions the whole of it.",
        Path,
        commands=("map",),
        example="FILE.nc",
    )
    output: Path | None = option(
        None, "NetCDF file of the results, with all parameters.", Path, short="o", example="FILE.nc"
    )
    overwrite: bool = option(False, "Replace existing files.", bool)
    resume: bool = option(
        False,
        "Continue an unfinished map of the output, or extend a finished one: only what is missing "
        "is run.",
        bool,
    )
    workers: int | None = option(
        None,
        "Batches that run at the same time, in threads; more than one only on a CPU.",
        int,
        commands=("map",),
        default="one for each core on a CPU",
    )
    scheduler: str | None = option(
        None,
        "Address of a running Dask scheduler, such as tcp://127.0.0.1:8786.",
        str,
        commands=("map",),
        example="ADDRESS",
    )
    progress: bool | Callable[[float], object] = option(
        False,
        "Show progress on standard error, or a function that is called with the replica-steps "
        "done since its last call.",
        bool,
        commands=(),
    )
    record: Any = option(
        None,
        "Wraps the function that advances a sampled batch, such as that of a recorder.",
        commands=(),
    )
    attributes: dict[str, Any] | None = option(None, "More attributes of the dataset.", commands=())

    def __post_init__(self):
        from jaxgran.maps.settings_checks import check_run

        check_run(self)
        if self.output is not None:
            object.__setattr__(self, "output", Path(self.output))

    def tell(self, sentence: str) -> None:
        """Print a sentence on standard error where progress is shown."""
        if self.progress is True:
            print(sentence, file=sys.stderr)


DEFAULTS: dict[str, Any] = {
    row.name: row.default for kind in (MapSettings, RunOptions) for row in fields(kind)
}
OPTIONS: dict[str, Option] = {
    row.name: row.metadata["option"] for kind in (MapSettings, RunOptions) for row in fields(kind)
}


def options(command: Command) -> dict[str, Option]:
    """The parameters that a command offers, by name."""
    return {name: row for name, row in OPTIONS.items() if command in row.commands}


def table() -> str:
    """The parameters of ``ratio_map`` as lines of a docstring."""
    return "\n      ".join(map(_described, OPTIONS))


def _described(name: str) -> str:
    about = OPTIONS[name]
    unit = f" In {about.unit}." if about.unit else ""
    dimension = " Several add a dimension." if name in FURTHER else ""
    return (
        f"{name}: {about.help}{unit}{dimension} Default: {about.default or repr(DEFAULTS[name])}."
    )
