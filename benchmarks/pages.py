"""Measured numbers of pages, filled in from ``benchmarks/results``, and tables read from the code.

A page with numbers is made from a Jinja template in ``docs/_build`` and committed, so that it reads
the same in the repository and on the site. ``{{ pm(row.value, row.error) }}`` stands for a value
with its standard error, a loop over the rows of a result makes a table, and so neither can differ
from the file; a test says when a page is stale. Markdown needs braces for itself: comments of Jinja
are ``{=# … #=}``.

    python -m benchmarks.pages
"""

import json
import math
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import jinja2

from benchmarks import page_tables, timestep_error
from benchmarks.output import RESULTS, ROOT
from benchmarks.peers import front
from jaxgran.maps.automatic import chosen_settings
from jaxgran.maps.results import open_map
from jaxgran.maps.schema import shear_stress_ratio
from jaxgran.model.display import with_error
from jaxgran.reference.validity import validity
from jaxgran.sampling.budget import SIZE_LAWS
from jaxgran.theory.assumptions import ASSUMPTIONS

BUILD = ROOT / "docs" / "_build"
TEMPLATES = {  # of committed pages
    "README.md": "docs/_build/README.md",
    "docs/paper/paper.md": "docs/_build/paper.md",
    **{
        f"docs/{path.relative_to(BUILD / 'pages').as_posix()}": path.relative_to(ROOT).as_posix()
        for path in sorted((BUILD / "pages").rglob("*.md"))
    },
}


class Results:
    """The JSON files of ``benchmarks/results``, each by its name as an attribute."""

    def __getattr__(self, name: str) -> Any:
        return read(name)


@cache
def read(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def at(rows: Iterable[Mapping[str, Any]], **conditions: Any) -> Mapping[str, Any]:
    """The one row with these values; an error if there is none, or more than one.

    Examples:
      >>> at([{"nu": 0.2, "p": 1}, {"nu": 0.6, "p": 4}], nu=0.6)["p"]
      4
    """
    (row,) = (row for row in rows if all(row[name] == value for name, value in conditions.items()))
    return row


def sig(value: float, digits: int = 2) -> str:
    """A number rounded to some significant digits, with commas between thousands and without an
    exponent above 1e-4.

    Examples:
      >>> sig(0.12346), sig(1234.5, 3), sig(99999), sig(3.2e-7), sig(1.0, 3)
      ('0.12', '1,230', '100,000', '3.2e-07', '1.00')
    """
    if value == 0 or not math.isfinite(value) or abs(value) < 1e-4:
        return f"{value:.{digits}g}"
    rounded = float(f"{value:.{digits - 1}e}")
    return f"{rounded:,.{max(digits - 1 - math.floor(math.log10(abs(rounded))), 0)}f}"


def percent(value: float, digits: int = 2) -> str:
    """A fraction in percent.

    Examples:
      >>> percent(0.0123), percent(-0.2)
      ('1.2 %', '−20 %')
    """
    return sig(100 * value, digits).replace("-", "−") + " %"


def pm(value: float, error: float) -> str:
    """A value and its standard error, with a true minus sign; the value alone without scatter.

    Examples:
      >>> pm(-0.0123, 0.0042), pm(1.0, math.nan)
      ('−0.012 ± 0.004', '1')
    """
    text = f"{value:.4g}" if math.isnan(error) else with_error(value, error)
    return text.replace("-", "−")


def duration(seconds: float, digits: int = 2) -> str:
    """Seconds in the unit that fits.

    Examples:
      >>> duration(2.4e-6), duration(0.0017), duration(5.0), duration(600)
      ('2.4 µs', '1.7 ms', '5.0 s', '10 min')
    """
    for unit, size in (("µs", 1e-6), ("ms", 1e-3), ("s", 1.0)):
        if seconds < 999.5 * size if unit != "s" else seconds < 300:
            return f"{sig(seconds / size, digits)} {unit}"
    return f"{sig(seconds / 60, digits)} min"


@cache
def _map(file: str) -> Any:
    return open_map(RESULTS / file)


def point(file: str, name: str, restitution: float, packing_fraction: float) -> tuple[float, float]:
    """A variable of a map at a point, and its standard error; 0 for a prediction, which has
    none.
    """
    data = _map(file)[name.rpartition("/")[0] or "/"]
    variable = data[name.rpartition("/")[2]]
    error = data.get(f"{variable.name}_stderr", 0.0 * variable)
    return _at_point((variable, error), restitution, packing_fraction)


def shear_stress_ratio_at(
    file: str, restitution: float, packing_fraction: float
) -> tuple[float, float]:
    """Contact shear stress over the binary one at a point of a map, and its standard error."""
    return _at_point(shear_stress_ratio(_map(file)), restitution, packing_fraction)


def _at_point(variables: Any, restitution: float, packing_fraction: float) -> tuple[float, float]:
    chosen = {"restitution": restitution, "packing_fraction": packing_fraction}
    value, error = (float(x.sel(chosen)) for x in variables)
    return value, error


def grains_for(error: float, restitution: float, packing_fraction: float) -> int:
    """The number of grains that ``--error`` chooses for a flow with one seed."""
    flow = {"restitution": restitution, "packing_fraction": packing_fraction}
    automatic = {"error": error, "seeds": 1, "grains": "auto", "timestep": "auto"}
    settings, _ = chosen_settings(flow | automatic)
    return settings.grains[-1]


def percent_pm(value_and_error: Iterable[float]) -> str:
    """A fraction with its standard error, in percent.

    Examples:
      >>> percent_pm((0.0123, 0.0042))
      '1.2 ± 0.4 %'
    """
    return pm(*(100 * x for x in value_and_error)) + " %"


def fastest_loop(rows: Iterable[Mapping[str, Any]], row: Mapping[str, Any]) -> float:
    """Steps per second of the Gauss–Seidel loop in the flow of a row of ``device_batch``: the
    fastest of its runs there.
    """
    flow = ("grains", "dt", "alpha", "nu")
    return max(other["rival"] for other in rows if all(other[x] == row[x] for x in flow))


def quotients(rows: Iterable[Mapping[str, float]], dividend: str, divisor: str) -> list[float]:
    """One column over another."""
    return [row[dividend] / row[divisor] for row in rows]


def output_of_where(restitution: float, packing_fraction: float) -> str:
    """What ``jaxgran where`` prints, without empty lines in its table."""
    command = f"where --restitution {restitution} --packing-fraction {packing_fraction}"
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    words = [sys.executable, "-m", "jaxgran", *command.split()]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    verdict, table = done.stdout.split("α = ")
    lines = [line.rstrip() for line in f"α = {table}".splitlines()]
    return "\n".join([textwrap.fill(" ".join(verdict.split()), 100), "", *filter(None, lines)])


ENVIRONMENT = jinja2.Environment(
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    comment_start_string="{=#",
    comment_end_string="#=}",
    keep_trailing_newline=True,
    autoescape=False,
)
ENVIRONMENT.filters |= {
    "e": lambda value: f"{float(value):.0e}".replace("e-0", "e-"),
    "g": lambda value: f"{float(value):g}",
    "date": lambda number: f"{number // 10000}-{number // 100 % 100:02d}-{number % 100:02d}",
}
ENVIRONMENT.globals |= {
    "results": Results(),
    "peers_table": front.table,
    "peer_ratio": front.ratio,
    "timestep_verdicts": timestep_error.verdicts,
    "ASSUMPTIONS": ASSUMPTIONS,
    "SIZE_LAWS": SIZE_LAWS,
}
ENVIRONMENT.globals |= {
    function.__name__: function
    for function in (
        *(max, at, fastest_loop, point, quotients, validity),
        *(sig, percent, percent_pm, pm, duration),
        *(grains_for, shear_stress_ratio_at, output_of_where),
        *(page_tables.variables, page_tables.options, page_tables.examples),
        page_tables.notebooks,
    )
}


def filled(page: str) -> str:
    """A page with its numbers."""
    return f"{wrapped(ENVIRONMENT.from_string(page).render()).rstrip()}\n"


_CODE_OR_GAP = re.compile(r"(^```.*?^```$|\n{2,})", re.MULTILINE | re.DOTALL)
_LEFT = re.compile(r"\A(---|```|[|#><$!{:\d\s])|^(\||:::)|(  |\\|<br>)$", re.MULTILINE)
_LISTED = re.compile(r"^\s*([-+*]|\d+[.)]|#+)\s", re.MULTILINE)


def wrapped(page: str) -> str:
    """A page whose paragraphs and lists have lines of at most 100 characters. What begins otherwise
    than with a word is left as it is (tables, pictures, formulas, headings, numbers, HTML), and so
    are code and paragraphs with line breaks of their own.

    Examples:
      >>> print(wrapped("Two\\nlines.\\n\\n- an\\n  item\\n- `a b`"))
      Two lines.
      <BLANKLINE>
      - an item
      - `a b`
    """
    return "".join(
        part if _LEFT.search(part) else _wrapped_part(part) for part in _CODE_OR_GAP.split(page)
    )


def _wrapped_part(part: str) -> str:
    """A paragraph or a list; as it is where a line would begin like an item of a list."""
    solid = re.sub(r"`[^`]*`", lambda code: re.sub(r"\s", "\0", code[0]), part)
    items = re.split(r"\n(?=- )", solid)
    settings: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}
    text = "\n".join(
        textwrap.fill(item, 100, subsequent_indent="  " * item.startswith("- "), **settings)
        for item in (" ".join(item.split()) for item in items)
    ).replace("\0", " ")
    is_same = len(_LISTED.findall(text)) == sum(item.startswith("- ") for item in items)
    return text if is_same else part


if __name__ == "__main__":
    for page, template in TEMPLATES.items():
        (ROOT / page).write_text(
            filled((ROOT / template).read_text(encoding="utf-8")), encoding="utf-8"
        )
