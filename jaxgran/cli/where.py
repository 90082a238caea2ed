"""The command ``where``: what kinetic theory can predict in a flow, without a simulation."""

from jaxgran.cli.arguments import command
from jaxgran.cli.json_output import JSON, Entry, print_json
from jaxgran.cli.tables import Table, plain, print_table
from jaxgran.maps.options import Option
from jaxgran.model.display import with_error
from jaxgran.reference.table import FACTORS, MEASURED, THEORIES, shipped_table
from jaxgran.reference.validity import COLUMNS, Validity, validity

WHERE_EXAMPLES = {
    "Does kinetic theory hold at a restitution and a packing fraction": "jaxgran where "
    "--restitution 0.7 --packing-fraction 0.6",
    "The same for a program": "jaxgran where --restitution 0.7 --packing-fraction 0.6 --json",
}
WHERE_OPTIONS = {
    "restitution": Option("Coefficient of restitution α, in the range of the reference map."),
    "packing_fraction": Option("Packing fraction ν, in the range of the reference map."),
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


def run_where_command(restitution: float, packing_fraction: float, json: bool = False) -> None:
    found = validity(restitution, packing_fraction)
    if json:
        print_json(_entries(found))
        return
    table = shipped_table()
    print(plain(found.verdict()))
    about = f"α = {restitution:g}, ν = {packing_fraction:g}; ± 95 %; units of m, σ and 1/γ̇"
    averages = Table(about, COLUMNS, found.rows())
    print_table(averages)
    assumed = (
        "Enskog's contact pressure at the measured granular temperature, one assumption "
        "after the other"
    )
    factors = Table(assumed, ("assumed", "factor if measured instead"))
    for name in FACTORS:
        factor = with_error(float(found.factors[name]), float(found.factors_ci95[name]))
        factors.rows.append([_ASSUMPTIONS[name], factor])
    print_table(factors)
    print(
        plain(
            f"Reference map: {table.made_with}. Kinetic theory: {THEORIES[table.head['theory']]}."
        )
    )


def _entries(found: Validity) -> dict[str, Entry]:
    """The entries of the JSON object."""
    head = shipped_table().head
    entries = {
        "verdict": Entry(found.verdict(), "what kinetic theory can predict, in a sentence", None),
        "restitution": Entry(found.restitution, "coefficient of restitution"),
        "packing_fraction": Entry(found.packing_fraction, "packing fraction"),
        "fails_first": Entry(found.fails_first(), "assumption that is furthest off", None),
    }
    half = "half-width of the 95 % interval"
    for name, unit in _UNITS.items():
        entries[name] = Entry(found.measured[name], "measured average", unit)
        entries[f"{name}_ci95"] = Entry(found.measured_ci95[name], half, unit)
    for name, value in found.theory.items():
        entries[f"theory/{name}"] = Entry(value, "prediction of kinetic theory", _UNITS[name])
    for name, value in found.error.items():
        entries[f"error/{name}"] = Entry(value, "kinetic theory over measured average, less one")
        entries[f"error/{name}_ci95"] = Entry(found.error_ci95[name], half)
    for name, value in found.corrected.items():
        entries[f"corrected/{name}"] = Entry(
            value, "prediction of the corrected theory", _UNITS[name]
        )
    for name, value in found.corrected_error.items():
        entries[f"corrected_error/{name}"] = Entry(
            value, "corrected theory over measured average, less one"
        )
        entries[f"corrected_error/{name}_ci95"] = Entry(found.corrected_error_ci95[name], half)
    for name, value in found.factors.items():
        entries[f"factor/{name}"] = Entry(
            value, f"contact pressure as measured, over that if {_ASSUMPTIONS[name]}"
        )
        entries[f"factor/{name}_ci95"] = Entry(found.factors_ci95[name], half)
    grains = head["grains"]  # a number, or in words where it depends on the flow
    entries["grains"] = Entry(
        int(grains) if grains.isdecimal() else grains, "number of grains of the reference map"
    )
    entries["timestep"] = Entry(
        float(head["timestep"]), "time step of the reference map", "1 / shear rate"
    )
    return entries


where_command = command(WHERE_OPTIONS, run_where_command, ("restitution", "packing_fraction"))
