"""Values of options: lists of numbers, "auto", options that exclude each other; and the examples of a help text."""

from collections.abc import Mapping
from typing import Annotated, Literal

import typer

from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.choices import MAX_REPLICAS

_MOST_DIGITS = 20  # of a whole number

RelativeError = Annotated[
    float | None,
    typer.Option(
        "--error",
        help="Whole relative error of force ratio and stresses to reach, 95 %: chooses grains, time step, tolerance "
        "and strain that are not given.",
    ),
]


def number_list(text: str, name: str) -> tuple[float, ...]:
    """Numbers from ``0.1,0.5,0.9`` or ``start:stop:count``, both ends included."""
    try:
        if ":" in text:
            start, stop, count = text.split(":")
            steps = int(count) - 1
            if not 1 <= steps < MAX_REPLICAS:
                raise ValueError(count)
            return tuple(round(float(start) + (float(stop) - float(start)) * k / steps, 12) for k in range(steps + 1))
        return tuple(float(x) for x in text.split(","))
    except ValueError:
        raise InputError(
            f"{name} must be a number, a list like 0.1,0.5,0.9 or start:stop:count with a count of 2 to "
            f"{MAX_REPLICAS}, not {short_repr(text)}."
        ) from None


def numbers_or_auto(text: str | None, name: str) -> float | tuple[float, ...] | str | None:
    """One number, several numbers, or "auto"; None if the option is not given."""
    if text is None or text == "auto":
        return text
    numbers = number_list(text, name)
    return numbers[0] if len(numbers) == 1 else numbers


def whole_numbers(text: str | None, name: str) -> int | tuple[int, ...] | str | None:
    """One whole number, or several from ``256,1000,4000``, or "auto"; None if the option is not given."""
    if text is None or text == "auto":
        return text
    parts = text.split(",")
    if not all(part.isdecimal() and len(part) <= _MOST_DIGITS for part in parts):
        raise InputError(f"{name} must be a whole number or a list like 256,1000,4000, not {short_repr(text)}.")
    numbers = tuple(int(part) for part in parts)
    return numbers[0] if len(numbers) == 1 else numbers


def batch_size(text: str) -> int | Literal["auto"]:
    """Number of replicas that run together, or "auto"."""
    if text == "auto":
        return "auto"
    if not text.isdecimal() or len(text) > 9 or int(text) < 1:
        raise InputError(
            f"batch must be auto or a whole number of at least 1, below a billion, not {short_repr(text)}."
        )
    return int(text)


def require_one(strain: float | None, error: float | None) -> None:
    """Raise an InputError if both the sampled strain and a target for the error are given."""
    if strain is not None and error is not None:
        raise InputError("--strain and --error exclude each other: give one of them.")


def chosen_for(error: float | None) -> dict[str, str]:
    """The parameters that are chosen for a target of the error, unless they are given."""
    return {} if error is None else dict.fromkeys(("grains", "timestep", "tolerance"), "auto")


def examples(commands: Mapping[str, str]) -> str:
    """The end of a help text: example commands and what they do."""
    lines = [line for words, command in commands.items() for line in (f"  {words}:", f"    {command}")]
    return "\b\n" + "\n".join(["Examples:", *lines])
