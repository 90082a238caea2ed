"""Tables of pages that are read from the code: variables of a map, options, examples
and notebooks.
"""

import importlib
import json
from pathlib import Path
from typing import Any

from benchmarks.output import ROOT
from jaxgran.cli.options import option_name, with_options
from jaxgran.maps.settings import options as parameters
from jaxgran.maps.variables import VARIABLES
from jaxgran.sampling.observables import OBSERVABLES


def unit_of(unit: str | None) -> str:
    return "–" if unit in ("1", None) else unit


def variables(group: str) -> str:
    """A table of the variables of a group of a map.

    Families of names (of a large system, kinetic theory's predictions, Enskog's factors) have no
    row.
    """
    lines = ["| name (dimensions) | unit | meaning |", "| --- | --- | --- |"]
    for path, row in VARIABLES.items():
        there, _, name = path.rpartition("/")
        family = (
            "_large_system" in name
            or name.startswith("enskog_factor_")
            or (group == "theory" and name in OBSERVABLES)
        )
        if (there or "/") == group and not family:
            dims = f" ({', '.join(f'`{dim}`' for dim in row.dims)})" if row.dims else ""
            lines.append(f"| `{name}`{dims} | {unit_of(row.unit)} | {row.meaning} |")
    return "\n".join(lines)


def table_of(command: str, kind: str) -> Any:
    """A constant of the command line, such as ``MAP_OPTIONS``."""
    module = "map" if command == "plot" else command
    return getattr(importlib.import_module(f"jaxgran.cli.{module}"), f"{command.upper()}_{kind}")


def options(command: str) -> str:
    """A table of the options of a command, but for those that are the same for ``map``."""
    shared = [] if command == "map" else option_rows("map")
    rows = ["| option | meaning | default |", "| --- | --- | --- |"]
    return "\n".join([*rows, *(row for row in option_rows(command) if row not in shared)])


def option_rows(command: str) -> list[str]:
    rows = []
    for name, option in table_of(command, "OPTIONS").items():
        flag = f"-{option.short}, {option_name(name)}" if option.short else option_name(name)
        meaning = with_options(option.help, parameters(command))
        meaning += f" In {option.unit}." if option.unit else ""
        if isinstance(option.kind, tuple):
            flag += " NAME"
            meaning += f" One of {', '.join(f'`{choice}`' for choice in option.kind)}."
        elif option.kind is not bool:
            flag = f"{flag} {option.placeholder}".replace("|auto", " or auto")
        elif option.off:
            flag += f", --no-{name}"
        rows.append(f"| `{flag}` | {meaning} | {option.default or '–'} |")
    return rows


def examples(command: str) -> str:
    """The examples of a command."""
    examples = table_of(command, "EXAMPLES").items()
    return "\n".join(["```shell", *(f"# {about}\n{line}" for about, line in examples), "```"])


def notebooks() -> str:
    """The notebooks by their titles, as a list of links from a page in ``docs``."""
    return "\n".join(
        f"- [{title_of(path)}](../notebooks/{path.name})"
        for path in sorted((ROOT / "notebooks").glob("*.ipynb"))
    )


def title_of(notebook: Path) -> str:
    """The first line of a notebook."""
    first = json.loads(notebook.read_text(encoding="utf-8"))["cells"][0]["source"]
    return "".join(first).split("\n", 1)[0].lstrip("# ")
