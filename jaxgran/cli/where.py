"""The command ``where``: what kinetic theory can predict in a flow, without a simulation."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxgran.cli.options import OVERWRITE, command
from jaxgran.cli.output import JSON, Entry, in_brackets, print_json, print_table, print_text
from jaxgran.cli.terminal import say_written
from jaxgran.maps.options import Option
from jaxgran.model.checks import InputError
from jaxgran.model.choices import MAX_REPLICAS
from jaxgran.model.display import with_error
from jaxgran.reference.evaluation import Estimate
from jaxgran.reference.table import MEASURED, THEORIES, shipped_table
from jaxgran.reference.validity import COLUMNS, Validity, validity
from jaxgran.theory.assumptions import ASSUMPTIONS

WHERE_EXAMPLES = {
    "Error of kinetic theory at a restitution and a packing fraction": "jaxgran where "
    "--restitution 0.5 --packing-fraction 0.7",
    "And how far each of its assumptions is off": "jaxgran where --restitution 0.5 "
    "--packing-fraction 0.7 --factors",
    "Every pair of two lists, as a table": "jaxgran where --restitution 0.2,0.5,0.8 "
    "--packing-fraction 0.5:0.8:4",
    "The constitutive law over the whole range": "jaxgran where --law law.csv",
}
WHERE_OPTIONS = {
    "restitution": Option(
        "Coefficient of restitution α, in the range of the reference map.", several=True
    ),
    "packing_fraction": Option(
        "Packing fraction ν, in the range of the reference map.", several=True
    ),
    "factors": Option("Print the factor of each assumption of the theory.", bool),
    "corrected": Option("Also print the theory with measured correlations.", bool),
    "json": JSON,
    "law": Option(
        "Write the constitutive law, at the given values or over the range of the map.",
        Path,
        example="FILE.csv",
    ),
    "overwrite": OVERWRITE,
}
_UNITS = MEASURED | {"force_ratio": "1"}
_FACTORS = "Enskog's contact pressure at the measured granular temperature"


def run_where_command(
    restitution: Sequence[float] | None = None,
    packing_fraction: Sequence[float] | None = None,
    factors: bool = False,
    corrected: bool = False,
    json: bool = False,
    law: Path | None = None,
    overwrite: bool = False,
) -> None:
    no_pair = restitution is None or packing_fraction is None
    if no_pair and (law is None or json):
        raise InputError("`restitution` and `packing_fraction` are required, or `law` alone.")
    pairs = len(restitution or ()) * len(packing_fraction or ())
    if pairs > MAX_REPLICAS:
        raise InputError(
            f"`restitution` and `packing_fraction` must have at most {MAX_REPLICAS} pairs, not "
            f"{pairs}."
        )
    if law is not None:
        from jaxgran.io.paths import require_place
        from jaxgran.reference.law import constitutive_law

        require_place(law, "law", ".csv")
        constitutive_law().to_csv(law, restitution, packing_fraction, overwrite)
        say_written([law])
    if restitution is None or packing_fraction is None:
        return
    plane = np.meshgrid(restitution, packing_fraction)
    is_point = plane[0].size == 1
    flow = validity(*(x.item() if is_point else x for x in plane))
    if json:
        axes = {"restitution": restitution, "packing_fraction": packing_fraction}
        entries = _entries(flow)
        entries |= {
            name: entries[name]._replace(value=values[0] if is_point else values)
            for name, values in axes.items()
        }
        print_json(entries)
    elif is_point:
        _print_point(flow, factors, corrected)
    else:
        _print_plane(flow, factors, corrected)


def _print_point(flow: Validity, factors: bool, corrected: bool) -> None:
    print_text(flow.verdict())
    columns = len(COLUMNS) if corrected else len(COLUMNS) - 1
    pair = f"α = {flow.restitution:g}, ν = {flow.packing_fraction:g}"
    about = f"{pair}; ± 95 %; units of m, σ and 1/γ̇"
    print_table(about, COLUMNS[:columns], (row[:columns] for row in flow.rows()))
    if factors:
        statements = (assumption.statement for assumption in ASSUMPTIONS.values())
        rows = [*zip(statements, _factors(flow, with_error), strict=True)]
        rows.append(("all of these", f"{float(flow.over_enskog()):#.3g}"))
        print_table(_FACTORS, ("assumed", "factor if measured instead"), rows)
    _print_source()


def _print_plane(flow: Validity, factors: bool, corrected: bool) -> None:
    rows, factor_rows = [], []
    for place in np.ndindex(flow.restitution.shape):
        point = flow.at(place)
        pair = [f"{point.restitution:g}", f"{point.packing_fraction:g}"]
        averages = [
            in_brackets(*map(float, point.measured[name])) for name in ("force_ratio", "pressure")
        ]
        errors = [point.error, point.corrected_error][: 1 + corrected]
        percents = [in_brackets(*(100 * float(x) for x in error["pressure"])) for error in errors]
        rows.append([*pair, *averages, *percents, point.fails_first().replace("_", " ")])
        factor_rows.append([*pair, *_factors(point, in_brackets)])
    about = "In brackets: 95 % half-width of the last digits"
    names = ("error in %", "if corrected")[: 1 + corrected]
    columns = ("α", "ν", "force ratio", "pressure", *names, "largest error from")
    print_table(f"Error of kinetic theory in the pressure. {about}.", columns, rows)
    if factors:
        names = (name.replace("_", " ") for name in ASSUMPTIONS)
        print_table(f"Factors of {_FACTORS}. {about}.", ("α", "ν", *names), factor_rows)
    _print_source()


def _factors(flow: Validity, text: Callable[[float, float], str]) -> list[str]:
    """The factor of every assumption, with its interval."""
    return [text(*map(float, flow.factors[name])) for name in ASSUMPTIONS]


def _print_source() -> None:
    table = shipped_table()
    theory = THEORIES[table.head["theory"]]
    print_text(f"Reference map: {table.made_with}. Kinetic theory: {theory}.")


def _entries(flow: Validity) -> dict[str, Entry]:
    """The entries of the JSON object."""
    head = shipped_table().head
    entries = {
        "verdict": Entry(flow.verdict(), "what kinetic theory can predict, in words", None),
        "restitution": Entry(flow.restitution, "coefficient of restitution"),
        "packing_fraction": Entry(flow.packing_fraction, "packing fraction"),
        "fails_first": Entry(flow.fails_first(), "assumption with the largest error", None),
    }
    of_theory = "kinetic theory over measured average, less one"
    groups = (
        ("", flow.measured, "measured average"),
        ("theory/", flow.theory, "prediction of kinetic theory"),
        ("error/", flow.error, of_theory),
        ("corrected/", flow.corrected, "prediction of the corrected theory"),
        ("corrected_error/", flow.corrected_error, f"corrected {of_theory[8:]}"),
        ("factor/", flow.factors, "contact pressure as measured, over that if "),
    )
    for group, values, meaning in groups:
        for name, x in values.items():
            value, ci95 = x if isinstance(x, Estimate) else (x, None)
            unit = _UNITS[name] if group in ("", "theory/", "corrected/") else "1"
            words = meaning + (ASSUMPTIONS[name].statement if group == "factor/" else "")
            entries[group + name] = Entry(value, words, unit, ci95=ci95)
    grains = head["grains"]  # a number, or in words where it depends on the flow
    entries["grains"] = Entry(
        int(grains) if grains.isdecimal() else grains, "number of grains of the reference map"
    )
    entries["timestep"] = Entry(
        float(head["timestep"]), "time step of the reference map", "1 / shear rate"
    )
    return entries


where_command = command(WHERE_OPTIONS, run_where_command)
