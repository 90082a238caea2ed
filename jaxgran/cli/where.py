"""The command ``where``: what kinetic theory can predict in a flow, without a simulation."""

from jaxgran.cli.options import command
from jaxgran.cli.output import JSON, Entry, print_json, print_table, print_text
from jaxgran.maps.options import Option
from jaxgran.model.display import with_error
from jaxgran.reference.table import MEASURED, THEORIES, shipped_table
from jaxgran.reference.validity import COLUMNS, Validity, validity

WHERE_EXAMPLES = {
    "Does kinetic theory hold at a restitution and a packing fraction": "jaxgran where "
    "--restitution 0.5 --packing-fraction 0.7",
    "And which of its assumptions fails": "jaxgran where --restitution 0.5 --packing-fraction 0.7 "
    "--factors",
}
WHERE_OPTIONS = {
    "restitution": Option("Coefficient of restitution α, in the range of the reference map."),
    "packing_fraction": Option("Packing fraction ν, in the range of the reference map."),
    "factors": Option("Print how far every assumption of the theory is off.", bool),
    "corrected": Option("Print also the theory with measured correlations.", bool),
    "json": JSON,
}
_UNITS = MEASURED | {"force_ratio": "1"}
_ASSUMPTIONS = {
    "local_temperature": "the granular temperature is that of neighbours",
    "anisotropy": "velocities are isotropic",
    "chaos": "velocities of colliding grains are independent",
    "pairs": "pairs at contact are those of equilibrium",
    "binary": "collisions are binary",
}


def run_where_command(
    restitution: float,
    packing_fraction: float,
    factors: bool = False,
    corrected: bool = False,
    json: bool = False,
) -> None:
    flow = validity(restitution, packing_fraction)
    if json:
        print_json(_entries(flow))
        return
    print_text(flow.verdict())
    columns = len(COLUMNS) if corrected else len(COLUMNS) - 1
    about = f"α = {restitution:g}, ν = {packing_fraction:g}; ± 95 %; units of m, σ and 1/γ̇"
    print_table(about, COLUMNS[:columns], (row[:columns] for row in flow.rows()))
    if factors:
        rows = (
            (words, with_error(float(flow.factors[name]), float(flow.factors_ci95[name])))
            for name, words in _ASSUMPTIONS.items()
        )
        assumed = "Enskog's contact pressure at the measured granular temperature"
        print_table(assumed, ("assumed", "factor if measured instead"), rows)
    table = shipped_table()
    theory = THEORIES[table.head["theory"]]
    print_text(f"Reference map: {table.made_with}. Kinetic theory: {theory}.")


def _entries(flow: Validity) -> dict[str, Entry]:
    """The entries of the JSON object."""
    head = shipped_table().head
    entries = {
        "verdict": Entry(flow.verdict(), "what kinetic theory can predict, in a sentence", None),
        "restitution": Entry(flow.restitution, "coefficient of restitution"),
        "packing_fraction": Entry(flow.packing_fraction, "packing fraction"),
        "fails_first": Entry(flow.fails_first(), "assumption that is furthest off", None),
    }
    of_theory = "kinetic theory over measured average, less one"
    groups = (
        ("", flow.measured, flow.measured_ci95, "measured average"),
        ("theory/", flow.theory, {}, "prediction of kinetic theory"),
        ("error/", flow.error, flow.error_ci95, of_theory),
        ("corrected/", flow.corrected, {}, "prediction of the corrected theory"),
        (
            "corrected_error/",
            flow.corrected_error,
            flow.corrected_error_ci95,
            f"corrected {of_theory[8:]}",
        ),
        ("factor/", flow.factors, flow.factors_ci95, "contact pressure as measured, over that if "),
    )
    for group, values, half_widths, meaning in groups:
        for name, value in values.items():
            unit = _UNITS[name] if group in ("", "theory/", "corrected/") else "1"
            words = meaning + _ASSUMPTIONS.get(name, "")
            entries[group + name] = Entry(value, words, unit, ci95=half_widths.get(name))
    grains = head["grains"]  # a number, or in words where it depends on the flow
    entries["grains"] = Entry(
        int(grains) if grains.isdecimal() else grains, "number of grains of the reference map"
    )
    entries["timestep"] = Entry(
        float(head["timestep"]), "time step of the reference map", "1 / shear rate"
    )
    return entries


where_command = command(WHERE_OPTIONS, run_where_command, ("restitution", "packing_fraction"))
