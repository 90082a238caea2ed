"""What a command prints with ``--json``: one object, in which each name has its value, error, unit
and meaning.

=======  ===========================================================================================
key      content
=======  ===========================================================================================
value    a number, a text, true or false, or nested lists of numbers; null for a number that is NaN
stderr   standard error in the form of the value; null where there is none
unit     in m, sigma and t, as in a map; "1" for a pure number, null for what is none
meaning  in words
=======  ===========================================================================================
"""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxgran.maps.options import Option

JSON = Option(
    "Print one JSON object in place of tables: value, stderr, unit and meaning by name.", bool
)


class Entry(NamedTuple):
    """A value with what is known of it."""

    value: Any
    meaning: str
    unit: str | None = "1"
    stderr: Any = None


def print_json(entries: Mapping[str, Entry]) -> None:
    """Print the entries on standard output."""
    keys = ("value", "stderr", "unit", "meaning")
    found = {
        name: {key: _plain(getattr(entry, key)) for key in keys} for name, entry in entries.items()
    }
    print(json.dumps(found, indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    """Numbers as those of JSON, which has neither NaN nor infinity."""
    if value is None or isinstance(value, str):
        return value
    if np.ndim(value):
        return [_plain(x) for x in value]
    number = np.asarray(value).item()
    return None if isinstance(number, float) and not np.isfinite(number) else number
