"""The command ``fit``: the restitution of a trajectory, or a closure fitted to a map."""

import math
from pathlib import Path
from typing import Annotated

import typer

from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import BAD_STATUS, configured_jax, require_device, stop
from jaxgran.model.checks import InputError, require_number, shown
from jaxgran.model.display import with_error

_LARGEST_CHI_SQUARED = 9.0  # above it, no restitution of the map has these stresses

FIT_EXAMPLES = {
    "The restitution of observed grains": "jaxgran fit flow.gsd",
    "How well a smooth law describes a map": "jaxgran fit jaxgran_map.nc",
    "The restitution of a flow from its stresses, with the law of a map": "jaxgran fit jaxgran_map.nc "
    "--packing-fraction 0.7 --pressure 3.2 --shear-stress 1.6 --relative-error 0.02",
}


def fit_command(
    file: Annotated[Path, typer.Argument(help="Trajectory (.gsd), or dataset of a map (.nc).")],
    timestep: Annotated[
        float | None, typer.Option(help="Time step of the runs beside a trajectory. [default: by its velocities]")
    ] = None,
    packing_fraction: Annotated[
        float | None, typer.Option(help="Of a flow whose restitution is sought from its stresses, with a map.")
    ] = None,
    pressure: Annotated[float | None, typer.Option(help="Its pressure, in m γ̇².")] = None,
    shear_stress: Annotated[float | None, typer.Option(help="Its shear stress, in m γ̇².")] = None,
    relative_error: Annotated[float, typer.Option(help="Relative standard error of these stresses.")] = 0.0,
) -> None:
    require_number("relative_error", relative_error, lambda x: (x >= 0) & (x <= 1), "between 0 and 1")
    configured_jax()
    stresses = {"packing_fraction": packing_fraction, "pressure": pressure, "shear_stress": shear_stress}
    given = [name for name, value in stresses.items() if value is not None]
    if file.suffix == ".gsd":
        if given:
            raise InputError(f"{given[0]} goes with a map, and {shown(file.name)} is a trajectory.")
        _fit_trajectory(file, timestep)
    else:
        if timestep is not None:
            raise InputError(f"timestep goes with a trajectory, and {shown(file.name)} is a map.")
        if 0 < len(given) < len(stresses):
            missing = next(name for name in stresses if name not in given)
            raise InputError(f"{missing} must be given too, or a restitution cannot be sought.")
        _fit_map(file, list(stresses.values()) if given else None, relative_error)


def _fit_trajectory(file: Path, timestep: float | None) -> None:
    require_device()
    from jaxgran.inference.restitution import fit_restitution
    from jaxgran.io.trajectory import read_trajectory

    trajectory = read_trajectory(file)
    if not math.isfinite(float(trajectory.shear_rate)):
        raise InputError(
            f"{shown(file.name)} has no strain and shear rate of its frames: use fit_restitution in Python."
        )
    try:
        found = fit_restitution(trajectory.strain, trajectory.state, float(trajectory.shear_rate), timestep)
    except RuntimeError as failure:
        stop(str(failure), BAD_STATUS)
    recorded = f"{float(trajectory.restitution):g}" if math.isfinite(trajectory.restitution) else "none"
    rows = [
        ["restitution ± standard error", with_error(found.restitution, found.stderr)],
        ["recorded restitution", recorded],
        ["noise of the velocities, σγ̇", f"{found.noise:.2g}"],
        ["windows, collisions", f"{found.windows}, {found.collisions:g}"],
        ["outliers", f"{100 * found.outliers:.2g} %"],
    ]
    print_table(Table("", ("of the trajectory", "value"), rows, numbers=False))


def _fit_map(file: Path, stresses: list[float | None] | None, relative_error: float) -> None:
    require_device()
    from jaxgran.inference.closure_fit import fit_closure
    from jaxgran.inference.cross_validation import leave_one_out
    from jaxgran.inference.stress_inversion import restitution_from_stresses
    from jaxgran.maps.results import read_dataset

    data = read_dataset(file)
    closure, errors = fit_closure(data), leave_one_out(data)
    columns = ("observable", "rms error", "largest error", "noise of a point")
    table = Table("Closure of the map, each point predicted from the others", columns, numbers=False)
    for name in ("pressure", "shear_stress", "force_ratio"):
        error, noise = abs(errors[f"{name}_error"]), errors[f"{name}_noise"]
        shares = ((error**2).mean() ** 0.5, error.max(), (noise**2).mean() ** 0.5)
        table.rows.append([name.replace("_", " "), *(f"{100 * float(share):.2g} %" for share in shares)])
    if stresses is None:
        print_table(table)
    else:
        nu, pressure, shear = (float(x) for x in stresses if x is not None)
        noise = (relative_error * pressure, relative_error * shear)
        found = restitution_from_stresses(closure, nu, pressure, shear, *noise)
        words = "" if bool(found.determined) else ", hardly determined: the stresses depend little on it there"
        if float(found.chi_squared) > _LARGEST_CHI_SQUARED:
            words = ", the nearest in the map: none there has these stresses"
        print_table(table)
        print(f"restitution {with_error(float(found.restitution), float(found.stderr))}{words}")
