"""The options of a command, from its table: their help texts, their values from text, and what is
wrong with them.

Typer sees texts, flags and paths only. Numbers, lists and choices are read here, so every mistake
is an ``InputError``, on the command line as in Python.
"""

import inspect
import re
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxgran.cli.terminal import run_command
from jaxgran.maps.options import Command, Option
from jaxgran.maps.presets import PRESETS
from jaxgran.maps.settings import DEFAULTS, is_new_dimension, options
from jaxgran.model.checks import InputError, refused, require
from jaxgran.model.choices import MAX_REPLICAS

_PARAMETER = re.compile(r"`(\w+)(?:='?(\w+)'?)?`")  # in an InputError
_MOST_DIGITS = 20  # of a whole number
_LIST = f"or a list like 0.1,0.5,0.9 or start:stop:count with a count of 2 to {MAX_REPLICAS}"
_WHOLE_LIST = "or a list like 256,1000,4000"
FILE = Option("Dataset of a map.", Path)
QUIET = Option("Say on standard error what went wrong only.", bool, short="q")
OVERWRITE = Option("Replace the output, whatever it holds.", bool)


def of_map(command: Command) -> dict[str, Option]:
    """The parameters of a map that a command offers, with the defaults of the command."""
    return {name: _as_offered(name, one, command) for name, one in options(command).items()}


def _as_offered(name: str, one: Option, command: Command) -> Option:
    start, text = DEFAULTS[name], one.default
    if command == "run" and name in ("restitution", "packing_fraction"):
        text = None
    elif command == "map" and name in PRESETS["quick"]:
        text = "of the preset"
    elif text is None and one.kind is not bool and start is not None:
        text = f"{start:g}" if isinstance(start, float) else str(start)
    if command == "run":
        return replace(one, default=text, several=False)
    words = " A list adds a dimension." if is_new_dimension(name) else ""
    return replace(one, default=text, help=one.help + words)


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

    def parsed(**texts: Any) -> None:
        file = () if argument is None else (texts.pop(place),)
        given = {name: text for name, text in texts.items() if text is not None}

        def values_and_run() -> None:
            run(*file, **{name: value(name, table[name], text) for name, text in given.items()})

        run_command(values_and_run, lambda mistake: sentence_of(mistake, table))

    place, kind = ("files", list[Path]) if several else ("file", Path)
    parameters = []
    if argument is not None:
        words = argument.help + (f" [default: {argument.default}]" if argument.default else "")
        declared = typer.Argument(help=words, show_default=False)
        parameters.append(_parameter(place, kind, declared, not argument.default))
    for name, one in table.items():
        kind = one.kind if one.kind in (bool, Path) else str
        parameters.append(_parameter(name, kind, _declared(name, one), name in required))
    parsed.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return parsed


def _parameter(name: str, kind: Any, declared: Any, required: bool) -> inspect.Parameter:
    start = inspect.Parameter.empty if required else None
    annotation = Annotated[kind if required else kind | None, declared]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=start, annotation=annotation
    )


def _declared(name: str, one: Option) -> Any:
    """The option as Typer knows it."""
    off = f"/--no-{name}" if one.off else ""
    names = [option_name(name) + off, *([f"-{one.short}"] if one.short else [])]
    words = with_options(one.help, (*options("map"), *options("run")))
    words += f" [unit: {one.unit}]" if one.unit else ""
    words += f" [default: {one.default}]" if one.default else ""
    choices = one.kind if isinstance(one.kind, tuple) else ("auto",) if one.auto else ()
    completion = (lambda: list(choices)) if choices else None
    metavar = None if one.kind is bool else one.placeholder
    return typer.Option(
        *names, help=words, metavar=metavar, show_default=False, autocompletion=completion
    )


def value(name: str, one: Option, text: Any) -> Any:
    """The value of an option from its text.

    Raises:
      InputError: (a ValueError) it is not accepted; ``field`` is the name.
    """
    if not isinstance(text, str) or one.kind is str:
        return text
    if isinstance(one.kind, tuple):
        if text not in one.kind:
            raise refused(name, text, f"must be {', '.join(one.kind[:-1])} or {one.kind[-1]}")
        return text
    if one.auto and text == "auto":
        return text
    several = (_WHOLE_LIST if one.kind is int else _LIST) if one.several or one.values else ""
    auto = "" if not one.auto else "auto, " if several else "auto or "
    accepted = f"{auto}{'a whole number' if one.kind is int else 'a number'} {several}".strip()
    try:
        numbers = list(_whole(text) if one.kind is int else _numbers(text))
        if len(numbers) > 1 and not (one.several or one.values):
            raise ValueError(text)
    except ValueError:
        raise refused(name, text, f"must be {accepted}") from None
    if one.range is not None:
        for number in numbers:
            accepts, words = one.range
            require(name, number, accepts, ("auto or " if one.auto else "") + words)
    is_list = one.values or (one.several and not is_new_dimension(name))
    return tuple(numbers) if len(numbers) > 1 or is_list else numbers[0]


def _whole(text: str) -> tuple[int, ...]:
    parts = text.split(",")
    if not all(part.removeprefix("-").isdecimal() and len(part) <= _MOST_DIGITS for part in parts):
        raise ValueError(text)
    return tuple(int(part) for part in parts)


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers from ``0.1,0.5,0.9`` or ``start:stop:count``, both ends included."""
    if ":" not in text:
        return tuple(float(x) for x in text.split(","))
    start, stop, count = text.split(":")
    steps = int(count) - 1
    if not 1 <= steps < MAX_REPLICAS:
        raise ValueError(count)
    return tuple(
        round(float(start) + (float(stop) - float(start)) * k / steps, 12) for k in range(steps + 1)
    )


def examples(commands: Mapping[str, str]) -> str:
    """The end of a help text: example commands and what they do."""
    lines = [
        line for purpose, line in commands.items() for line in (f"  {purpose}:", f"    {line}")
    ]
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
