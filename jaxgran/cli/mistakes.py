"""Mistakes on the command line as one sentence: the option, the given value, and what is accepted."""

import re
from typing import Any

import typer

from jaxgran.model.checks import short_repr

UsageError: Any = typer.BadParameter.__base__  # typer raises it for options that it cannot read
_LONGEST_SENTENCE = 500  # characters; a quoted value may be longer
_KINDS_OF_NUMBER = {"integer": "a whole number", "number": "a number", "float": "a number"}
_COMMON_MISTAKES = {
    "--alpha": "--restitution",
    "-a": "--restitution",
    "--nu": "--packing-fraction",
    "--phi": "--packing-fraction",
    "--density": "--packing-fraction",
    "--dt": "--timestep",
    "--time-step": "--timestep",
    "-n": "--grains",
    "-N": "--grains",
    "--seed": "--seeds",
    "--jobs": "--workers",
    "-j": "--workers",
    "--gif": "--movie",
    "--out": "--output",
    "-o": "--output",
}


def by_option(sentence: str, options: frozenset[str]) -> str:
    """The sentence with the option in place of the parameter name that it begins with."""
    name, _, rest = sentence.partition(" ")
    option = "--" + name.replace("_", "-")
    return f"{option} {rest}" if option in options and re.match("must |goes ", rest) else sentence


def in_words(mistake: Any, arguments: list[str]) -> str:
    """The message of typer about arguments that it cannot read, as one sentence that names the help."""
    context = getattr(mistake, "ctx", None)
    words = " ".join(_words(mistake, arguments).split()).rstrip(".?")
    words = words if len(words) <= _LONGEST_SENTENCE else _shortened(words)
    return f"{words}: see {'jaxgran' if context is None else context.command_path} --help."


def _shortened(words: str) -> str:
    """The beginning and the end of a long sentence."""
    half = _LONGEST_SENTENCE // 2
    return f"{words[:half]} … {words[5 - half :]}"


def _words(mistake: Any, arguments: list[str]) -> str:
    """The message of typer in other words, without the name of the help."""
    words = mistake.format_message()
    parameter, option = getattr(mistake, "param", None), getattr(mistake, "option_name", None)
    if words.startswith("No such option") and option is not None:
        similar = [name for name in (mistake.possibilities or []) if name != "--help"]
        accepted = {name for one in mistake.ctx.command.params for name in one.opts}
        meant = _COMMON_MISTAKES[option] if _COMMON_MISTAKES.get(option) in accepted else next(iter(similar), None)
        return f"there is no option {option}" + (f", perhaps {meant} is meant" if meant else "")
    if words.startswith("Missing") and parameter is not None:
        return f"{parameter.opts[0] if parameter.opts[0].startswith('-') else parameter.name.upper()} must be given"
    found = re.match("No such command '(.*?)'(?:. Did you mean '([^']*)')?", words, re.DOTALL)
    if found:
        command, meant = found.groups()
        return f"there is no command {short_repr(command)}" + (f", perhaps {meant} is meant" if meant else "")
    found = re.match(r"Got unexpected extra argument\(?s?\)? \((.*)\)", words, re.DOTALL)
    if found:
        return f"{short_repr(found[1])} stands alone, and values follow their options; a list has commas and no spaces"
    found = re.search("(?:should be|is not) a valid (integer|number|float)", words)  # the latter before typer 0.29
    if found and parameter is not None:
        given = _given(arguments, parameter.opts[0])
        return f"{parameter.opts[0]} must be {_KINDS_OF_NUMBER[found[1]]}" + (
            "" if given is None else f", not {short_repr(given)}"
        )
    found = re.match(r"Invalid value for '(\S+)': (?:Value error, )?(.*) is not one of (.*)", words, re.DOTALL)
    if found:
        return f"{found[1]} must be one of {found[3].rstrip('.')}, not {found[2]}"
    return words.replace("Value error, ", "")


def _given(arguments: list[str], option: str) -> str | None:
    """The last value that was given for an option; None if there is none."""
    next_word = dict(enumerate(arguments[1:]))
    given = [
        word.removeprefix(f"{option}=") if word.startswith(f"{option}=") else next_word.get(k)
        for k, word in enumerate(arguments)
        if word == option or word.startswith(f"{option}=")
    ]
    return given[-1] if given else None
