"""The parameters of a map: one table, from which all else that knows them follows.

A row is a field of ``MapParameters`` if the numbers of a map depend on it, and of ``RunParameters``
if it says how the map is run and kept. From the rows follow

- the arguments of ``ratio_map``, with their defaults,
- the options of ``jaxgran map`` and ``jaxgran run``, with their help, and the tables of the
  documentation,
- the checks of ranges in ``MapSettings``,
- the attributes of the dataset, which ``--resume`` and ``--from-map`` compare, and
- the command on a page of a map that measures a point again.

This module loads neither JAX nor xarray, so that the command line can print its help at once.
"""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar, get_args

from jaxgran.maps.presets import PRESETS
from jaxgran.model.choices import Activation, EngineName, SolverName

P = ParamSpec("P")
R = TypeVar("R")
Command = Literal["map", "run"]


@dataclass(frozen=True)
class Option:
    """What a user can give for a parameter, and what it means.

    Attributes:
      help: its meaning, in one sentence.
      kind: ``float``, ``int``, ``bool``, ``str`` or ``Path``, or the words that are accepted.
      several: whether a map also accepts a list.
      values: whether the value itself is a list.
      auto: whether "auto" is accepted.
      unit: unit of the number, or "".
      range: whether a number is accepted, and the same in words; None where ``ShearFlow`` checks
        it.
      default: the default in words; None for the default of the field.
      commands: the commands that offer it; none for a parameter of Python only.
      short: one letter, or "".
      example: what stands for the value in a help text, such as "FILE.nc".
      off: whether a flag also has --no-NAME.
    """

    help: str
    kind: type | tuple[str, ...] = float
    several: bool = False
    values: bool = False
    auto: bool = False
    unit: str = ""
    range: tuple[Callable[[Any], Any], str] | None = None
    default: str | None = None
    commands: tuple[Command, ...] = ("map", "run")
    short: str = ""
    example: str = ""
    off: bool = False


def row(help: str, kind: type | tuple[str, ...] = float, **option: Any) -> dict[str, Option]:
    """The metadata of a field: its ``Option``."""
    return {"option": Option(help, kind, **option)}


_POSITIVE = (lambda x: (x > 0) & (x < math.inf), "a positive number")
_ERROR = (lambda x: (x >= 1e-3) & (x <= 0.5), "between 1e-3 and 0.5")
_EQUILIBRATION = (lambda x: (x >= 0) & (x <= 1e6), "a number of at least 0 and at most 1e+06")
_TOLERANCE = (lambda x: (x >= 1e-12) & (x <= 0.1), "between 1e-12 and 0.1")


@dataclass(frozen=True)
class MapParameters:
    """What the numbers of a map depend on."""

    restitution: float | Sequence[float] = field(  # type: ignore[assignment]
        default=None, metadata=row("Restitution, 0 to 1.", several=True, default="of the preset")
    )
    packing_fraction: float | Sequence[float] = field(  # type: ignore[assignment]
        default=None,
        metadata=row("Packing fraction, up to 0.83.", several=True, default="of the preset"),
    )
    _: KW_ONLY
    grains: int | Sequence[int] | Literal["auto"] = field(
        default=256,
        metadata=row(
            'Number of grains; "auto" chooses it for `error`.',
            int,
            several=True,
            auto=True,
            short="n",
        ),
    )
    seeds: int = field(
        default=2, metadata=row("Independent runs of each point, averaged together.", int)
    )
    timestep: float | Sequence[float] | Literal["auto"] = field(
        default=1e-3,
        metadata=row(
            'Time step of the sample; "auto" takes the longest one that changes the stresses of no '
            "point by more than "
            "2 %, or a share of `error`.",
            several=True,
            auto=True,
            unit="1/shear rate",
            range=(lambda x: x > 0, "a positive number"),
        ),
    )
    equilibrate: float | None = field(
        default=None,
        metadata=row(
            "Strain before the sample.", range=_EQUILIBRATION, default="until the flow is steady"
        ),
    )
    strain: float | None = field(
        default=None,
        metadata=row(
            "Sampled strain of each seed.",
            range=_POSITIVE,
            default="six correlation strains, at least 8",
        ),
    )
    error: float | None = field(
        default=None,
        metadata=row(
            "Relative error of force ratio and stresses to reach at every point, half of a 95 % "
            "interval: sets the "
            "strain, and is the target of auto.",
            range=_ERROR,
        ),
    )
    tolerance: float | None = field(
        default=None,
        metadata=row(
            "Relative residual of a contact solve, in place of that of the solver.",
            range=_TOLERANCE,
            default="1e-4, or that of the solver",
        ),
    )
    solver: Any = field(
        default=None,
        metadata=row(
            "Projected method of the contact solve.",
            get_args(SolverName),
            default="barzilai-borwein",
        ),
    )
    activation: Activation = field(
        default="midpoint",
        metadata=row("When a pair of grains is a contact.", get_args(Activation)),
    )
    engine: Any = field(
        default=None,
        metadata=row(
            "Program that advances the flows.",
            get_args(EngineName),
            default="auto",
        ),
    )
    grains_by_point: Sequence[int] | None = field(
        default=None,
        metadata=row(
            "Number of grains of each point, in the order of time steps, packing fractions and "
            "restitutions, the last "
            "one fastest; `grains` is then the largest.",
            int,
            commands=(),
        ),
    )
    snapshots: bool = field(
        default=False,
        metadata=row(
            "Keep the last state of every point, from which `explore` draws its grains and forces.",
            bool,
            commands=("map",),
            off=True,
        ),
    )
    first_seed: int = field(
        default=0,
        metadata=row(
            "Number of the first seed; seeds of other numbers start from other grains.", int
        ),
    )
    observe: Any = field(
        default=None,
        metadata=row(
            "A function as in `sample` that returns numbers or arrays by name; each is averaged "
            "into a variable of "
            "this name.",
            commands=(),
        ),
    )
    polydispersity: float = field(
        default=0.26,
        metadata=row(
            "Half-width of the uniform distribution of diameters, over their mean, 0 to 0.5.",
            range=(lambda x: (x >= 0) & (x <= 0.5), "between 0 and 0.5"),
        ),
    )
    diameters: Sequence[float] | None = field(
        default=None,
        metadata=row(
            "Diameters of equally many grains each, such as 1,1.4, in place of the uniform "
            "distribution; their mean is "
            "the unit of length.",
            values=True,
        ),
    )
    part: str | None = field(
        default=None,
        metadata=row(
            "Measure one share of the points only, such as 3/20, the third of twenty of about the "
            "same cost; `jaxgran "
            "merge` joins their files.",
            str,
            commands=("map",),
            example="K/N",
        ),
    )


@dataclass(frozen=True, kw_only=True)
class RunParameters(MapParameters):
    """All parameters of ``ratio_map``: what the numbers depend on, and how the map is run and
    kept.
    """

    preset: str = field(
        default="quick",
        metadata=row("Starting point of all other parameters.", tuple(PRESETS), commands=("map",)),
    )
    from_map: str | Path | None = field(
        default=None,
        metadata=row(
            "Repeat the map of this file; parameters that are given replace those of the file.",
            Path,
            commands=("map",),
            example="FILE.nc",
        ),
    )

    output: str | Path | None = field(
        default=None,
        metadata=row(
            "NetCDF file of the results, with all parameters.", Path, short="o", example="FILE.nc"
        ),
    )
    overwrite: bool = field(
        default=False, metadata=row("Replace existing files, whatever they hold.", bool)
    )
    resume: bool = field(
        default=False,
        metadata=row(
            "Continue an unfinished map of the output, or read the output if it is finished.", bool
        ),
    )
    workers: int | None = field(
        default=None,
        metadata=row(
            "Number of batches that run at a time, in threads; more than one only on a CPU.",
            int,
            commands=("map",),
            default="one for each core on a CPU",
        ),
    )
    scheduler: str | None = field(
        default=None,
        metadata=row(
            "Address of a running Dask scheduler, such as tcp://127.0.0.1:8786.",
            str,
            commands=("map",),
            example="ADDRESS",
        ),
    )
    progress: bool | Callable[[float], object] = field(
        default=False,
        metadata=row(
            "Show progress on standard error, or a function that is called with the replica-steps "
            "done since its last "
            "call.",
            bool,
            commands=(),
        ),
    )
    record: Any = field(
        default=None,
        metadata=row(
            "Wraps the function that advances a sampled batch, such as that of a recorder.",
            commands=(),
        ),
    )
    attributes: dict[str, Any] | None = field(
        default=None, metadata=row("More attributes of the dataset.", commands=())
    )


def options(command: Command) -> dict[str, Option]:
    """The parameters that a command offers, by name."""
    return {
        f.name: option(f.name) for f in fields(RunParameters) if command in option(f.name).commands
    }


def option(name: str) -> Option:
    """The ``Option`` of a parameter."""
    return RunParameters.__dataclass_fields__[name].metadata["option"]


def default(name: str) -> Any:
    """The default of a parameter."""
    return RunParameters.__dataclass_fields__[name].default


def takes(parameters: Callable[P, object]) -> Callable[[Callable[..., R]], Callable[P, R]]:
    """Decorator: gives a function of any arguments the signature of a dataclass, and its table for
    ``{PARAMETERS}``.
    """

    def decorate(function: Callable[..., R]) -> Callable[P, R]:
        setattr(function, "__signature__", inspect.signature(parameters))  # noqa: B010
        if function.__doc__:  # none under python -OO
            function.__doc__ = function.__doc__.replace("{PARAMETERS}", table())
        return function

    return decorate


def table() -> str:
    """The parameters of ``ratio_map`` as lines of a docstring."""
    return "\n      ".join(map(_described, RunParameters.__dataclass_fields__))


def _described(name: str) -> str:
    about, value = option(name), RunParameters.__dataclass_fields__[name].default
    words = f"{name}: {about.help}"
    if about.unit:
        words += f" In {about.unit}."
    if is_new_dimension(name):
        words += " A list adds a dimension."
    return f"{words} Default: {about.default or repr(value)}."


def is_new_dimension(name: str) -> bool:
    """Whether a list of values adds a dimension to the plane of a map."""
    return option(name).several and default(name) is not None
