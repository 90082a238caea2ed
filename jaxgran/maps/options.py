"""``Option``: what a user can give for a parameter, in Python and on the command line, and what it
means.

This module loads neither JAX nor xarray, so that the command line prints its help at once.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

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

    @property
    def placeholder(self) -> str:
        """What stands for the value in a help text."""
        if isinstance(self.kind, tuple):
            return "|".join(self.kind)
        kinds: dict[type, str] = {float: "NUMBER", int: "INTEGER", Path: "FILE"}
        word = self.example or kinds.get(self.kind, "TEXT")
        return ("LIST" if self.several or self.values else word) + ("|auto" if self.auto else "")


def option(value: Any, help: str, kind: type | tuple[str, ...] = float, **about: Any) -> Any:
    """A field of a dataclass with a default value and an ``Option``."""
    return field(default=value, metadata={"option": Option(help, kind, **about)})
