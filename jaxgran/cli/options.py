"""The options of a command, from its table: what Typer shows and reads, and what is wrong with a
value, in terms of options.
"""

import inspect
import re
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from jaxgran.cli.terminal import run_command
from jaxgran.maps.options import Command, Option
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.replica import FURTHER
from jaxgran.maps.settings import DEFAULTS, OPTIONS, options, rounded
from jaxgran.model.checks import InputError
from jaxgran.model.choices import MAX_REPLICAS

_PARAMETER = re.compile(r"`(\w+)(?:='?(\w+)'?)?`")  # in an InputError
_LISTS = {
    int: "a list like 256,1000,4000",
    float: f"a list like 0.1,0.5,0.9 or start:stop:count with a count of 2 to {MAX_REPLICAS}",
}
FILE = Option("Dataset of a map.", Path)
QUIET = Option("On standard error, print only what went wrong.", bool, short="q")
OVERWRITE = Option("Replace an existing file.", bool)


def of_map(command: Command) -> dict[str, Option]:
    """The parameters of a map that a command offers, with the defaults of the command."""
    return {name: _as_offered(name, row, command) for name, row in options(command).items()}


def _as_offered(name: str, row: Option, command: Command) -> Option:
    start, text = DEFAULTS[name], row.default
    if command == "run" and name in ("restitution", "packing_fraction"):
        text = None
    elif command == "map" and name in PRESETS["quick"]:
        text = "of the preset"
    elif text is None and row.kind is not bool and start is not None:
        text = f"{start:g}" if isinstance(start, float) else str(start)
    if command == "run":
        return replace(row, default=text, several=name == "grains")
    words = " Several add a dimension." if name in FURTHER else ""
    return replace(row, default=text, help=row.help + words)


def command(
    table: Mapping[str, Option],
    run: Callable[..., None],
    required: tuple[str, ...] = (),
    argument: Option | None = None,
    several: bool = False,
) -> Callable[..., None]:
    """A command function for Typer that calls ``run`` with the values of the options that were
    given.

    Args:
      table: the options by name.
      run: called with the argument, if there is one, and with the values by name.
      required: options that must be given.
      argument: a file without an option's name.
      several: whether several such files are given.
    """

    def parsed(**values: Any) -> None:
        files = () if argument is None else (values.pop("file"),)
        given = {name: value for name, value in values.items() if value is not None}
        run_command(partial(run, *files, **given), lambda mistake: sentence_of(mistake, table))

    parameters = []
    if argument is not None:
        words = argument.help + (f" [default: {argument.default}]" if argument.default else "")
        metavar = "FILE..." if several else "FILE"
        shown = typer.Argument(help=words, show_default=False, metavar=metavar)
        kind = list[Path] if several else Path
        parameters.append(_parameter("file", kind, shown, not argument.default))
    for name, row in table.items():
        kind, declared = _declared(name, row)
        parameters.append(_parameter(name, kind, declared, name in required))
    parsed.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return parsed


def _parameter(name: str, kind: Any, declared: Any, required: bool) -> inspect.Parameter:
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if required else None,
        annotation=Annotated[kind if required else kind | None, declared],
    )


def _declared(name: str, row: Option) -> tuple[Any, Any]:
    """The type of an option, and the option itself, as Typer knows them."""
    names = [option_name(name) + (f"/--no-{name}" if row.off else "")]
    names += [f"-{row.short}"] if row.short else []
    words = with_options(row.help, OPTIONS)
    words += f" [unit: {row.unit}]" if row.unit else ""
    words += f" [default: {row.default}]" if row.default else ""
    option = partial(typer.Option, *names, help=words, show_default=False)
    if row.kind is bool:
        return bool, option()
    choices = list(row.kind) if isinstance(row.kind, tuple) else ["auto"] if row.auto else []
    option = partial(option, metavar=row.placeholder, autocompletion=lambda: choices)
    if row.kind in (Path, str):
        return row.kind, option()

    def parsed(text: str) -> Any:  # older versions of Typer ask for the name of a parser
        return parse(name, row, text)

    return str, option(parser=parsed)


def parse(name: str, row: Option, text: str) -> Any:
    """A number, a tuple of numbers or a word; a mistake is one of Typer's, in our words."""
    choices = row.kind if isinstance(row.kind, tuple) else ("auto",) if row.auto else ()
    if text in choices:
        return text
    several = row.several or row.values
    try:
        if isinstance(row.kind, tuple):
            raise ValueError(text)
        numbers = list(map(int, text.split(",")) if row.kind is int else _numbers(name, text))
        if len(numbers) > 1 and not several:
            raise ValueError(text)
    except ValueError:
        accepted = list(choices)
        if not isinstance(row.kind, tuple):
            accepted += ["a whole number" if row.kind is int else "a number"]
            accepted += [_LISTS[row.kind]] if several else []
        *others, last = accepted
        words = f"{', '.join(others)} or {last}" if others else last
        raise typer.BadParameter(f"must be {words}, not {text!r}.") from None
    is_list = row.values or (row.several and name not in FURTHER)
    return tuple(numbers) if len(numbers) > 1 or is_list else numbers[0]


def _numbers(name: str, text: str) -> tuple[float, ...]:
    """Numbers from ``0.1,0.5,0.9`` or ``start:stop:count``, both ends included, with equal gaps, or
    equal ratios of time steps.
    """
    if ":" not in text:
        return tuple(float(x) for x in text.split(","))
    start, stop, count = text.split(":")
    ends, points = (float(start), float(stop)), int(count)
    if (
        not np.isfinite(ends).all()
        or not 2 <= points <= MAX_REPLICAS
        or (name == "timestep" and min(ends) <= 0)
    ):
        raise ValueError(text)
    series = np.geomspace if name == "timestep" else np.linspace
    return tuple(map(rounded, series(*ends, points).tolist()))


def examples(commands: Mapping[str, str]) -> str:
    """The end of a help text: example commands and what they do."""
    lines = [f"  {purpose}:\n    {line}" for purpose, line in commands.items()]
    return "\b\n" + "\n".join(["Examples:", *lines])


def option_name(field: str) -> str:
    """The option of a parameter."""
    return f"--{field.replace('_', '-')}"


def with_options(text: str, names: Container[str]) -> str:
    """The text with options in place of parameters in backticks: `overwrite=True` becomes
    --overwrite.
    """

    def as_option(match: re.Match) -> str:
        name, value = match.groups()
        if name not in names:
            return match[0]
        return option_name(name) + ("" if value in (None, "True") else f" {value}")

    return _PARAMETER.sub(as_option, text)


def sentence_of(mistake: InputError | str, names: Container[str]) -> str:
    """A message of the library in terms of the options of a command."""
    text = with_options(str(mistake), names)
    first, space, rest = text.partition(" ")  # the field, where it is named at all
    named = isinstance(mistake, InputError) and mistake.field in ("", first)
    return option_name(first) + space + rest if named and first in names else text
