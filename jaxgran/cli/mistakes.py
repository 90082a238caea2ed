"""Mistakes on the command line as one sentence: the option, the given value, and what is
accepted.
"""

import re
import sys
from collections.abc import Container
from difflib import get_close_matches
from typing import Any

import typer
import typer.core

from jaxgran.model.checks import InputError, short_repr

_EXCEPTIONS: Any = sys.modules[typer.BadParameter.__module__]  # Click's, or Typer's copy of them
UsageError: Any = _EXCEPTIONS.UsageError
_PARAMETER = re.compile(r"`(\w+)(?:='?(\w+)'?)?`")  # in an InputError
_COMMON_MISTAKES = {
    "--alpha": "--restitution",
    "-a": "--restitution",
    "--nu": "--packing-fraction",
    "--phi": "--packing-fraction",
    "--density": "--packing-fraction",
    "--dt": "--timestep",
    "--time-step": "--timestep",
    "-N": "--grains",
    "--seed": "--first-seed",
    "--jobs": "--workers",
    "-j": "--workers",
    "--gif": "--movie",
    "--out": "--output",
    "--force": "--overwrite",
    "-f": "--overwrite",
}


class Command(typer.core.TyperCommand):
    """A command whose mistakes name a value without an option, and an option without its value."""

    def __init__(self, *arguments: Any, **parameters: Any):
        super().__init__(*arguments, **parameters)
        self.allow_extra_args = True

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            extra = super().parse_args(ctx, args)
        except _EXCEPTIONS.BadOptionUsage as mistake:
            name = mistake.option_name
            flag = any(getattr(one, "is_flag", False) for one in self.params if name in one.opts)
            need = "takes no value" if flag else "requires a value"
            raise InputError(f"{name} {need}: see {ctx.command_path} --help.") from None
        if extra and not ctx.resilient_parsing:
            given = short_repr(" ".join(extra))
            raise InputError(
                f"{given} belongs to no option; values follow their options, and lists have no "
                "spaces."
            )
        return extra


class Group(typer.core.TyperGroup):
    """The group of all commands, which names a command that does not exist."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = args[0]
        if name not in self.commands and not ctx.resilient_parsing:
            similar = get_close_matches(name, self.commands, n=1)
            meant = f", perhaps {similar[0]} is meant" if similar else ""
            raise InputError(f"there is no command {short_repr(name)}{meant}: see jaxgran --help.")
        return super().resolve_command(ctx, args)


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


def sentence_of(mistake: InputError, names: Container[str]) -> str:
    """The message of an InputError in terms of the options of a command."""
    text = with_options(str(mistake), names)
    first, space, rest = text.partition(" ")  # the field, where it is named at all
    return (
        option_name(first) + space + rest
        if first in names and mistake.field in ("", first)
        else text
    )


def usage_sentence(mistake: Any) -> str:
    """What is wrong with arguments that Typer cannot read, as one sentence that names the help."""
    context = getattr(mistake, "ctx", None)
    path = "jaxgran" if context is None else context.command_path
    return f"{_usage(mistake)}: see {path} --help."


def _usage(mistake: Any) -> str:
    if isinstance(mistake, _EXCEPTIONS.NoSuchOption):
        accepted = {name for one in mistake.ctx.command.params for name in one.opts}
        similar = [name for name in (mistake.possibilities or []) if name != "--help"]
        common = _COMMON_MISTAKES.get(mistake.option_name)
        meant = common if common in accepted else next(iter(similar), None)
        option = _shortened(mistake.option_name)
        return f"there is no option {option}" + (f", perhaps {meant} is meant" if meant else "")
    if isinstance(mistake, _EXCEPTIONS.MissingParameter) and mistake.param is not None:
        name = mistake.param.opts[0]
        return f"{name if name.startswith('-') else name.upper()} must be given"
    return _shortened(" ".join(mistake.format_message().split()).rstrip("."))


def _shortened(text: str, most: int = 300) -> str:
    """The beginning and the end of a long text, on one line."""
    text = " ".join(text.split())
    return text if len(text) <= most else f"{text[: most // 2]} … {text[-most // 2 :]}"
