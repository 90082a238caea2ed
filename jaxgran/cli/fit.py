"""The command ``fit``: the restitution of discs from their tracks, or a closure fitted to a map."""

import math
import warnings
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import BAD_STATUS, configured_jax, require_device, say, stop
from jaxgran.model.checks import InputError, require_number, short_repr
from jaxgran.model.display import with_error

_LARGEST_CHI_SQUARED = 9.0  # above it, no restitution of the map has these stresses

FIT_EXAMPLES = {
    "The restitution of observed grains": "jaxgran fit flow.gsd",
    "The restitution of discs that a camera tracked": "jaxgran fit discs.csv --diameter 4.1",
    "How well a smooth law describes a map": "jaxgran fit jaxgran_map.nc",
    "The restitution of a flow from its stresses, with the law of a map": "jaxgran fit jaxgran_map.nc "
    "--packing-fraction 0.7 --pressure 3.2 --shear-stress 1.6 --relative-error 0.02",
}


def fit_command(
    file: Annotated[
        Path,
        typer.Argument(help="Tracks of discs (.gsd, .csv, .tsv, .txt, .h5, .hdf5, .lammpstrj, .dump), or a map (.nc)."),
    ],
    shear_rate: Annotated[
        float | None, typer.Option(help="Of the tracks. [default: by the file, or by how its cell tilts]")
    ] = None,
    frame_strain: Annotated[
        float | None, typer.Option(help="Strain from frame to frame of the tracks, in place of --frame-time.")
    ] = None,
    frame_time: Annotated[
        float | None,
        typer.Option(help="Time from frame to frame of the tracks. [default: by the file, or its velocities]"),
    ] = None,
    peculiar: Annotated[bool, typer.Option("--peculiar", help="The velocities of the tracks lack the shear.")] = False,
    diameter: Annotated[float | None, typer.Option(help="Of all discs, where the tracks have none.")] = None,
    stride: Annotated[
        int | None, typer.Option(help="Use each N-th frame of the tracks only, where contacts outlast a frame.")
    ] = None,
    position_noise: Annotated[
        float | None,
        typer.Option(help="Standard error of a coordinate. [default: by the straight parts of the tracks]"),
    ] = None,
    velocity_noise: Annotated[
        float | None, typer.Option(help="Standard error of a velocity. [default: as above]")
    ] = None,
    diameter_noise: Annotated[
        float | None, typer.Option(help="Standard error of the distance at contact. [default: as above]")
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
    of_map = [name for name, value in stresses.items() if value is not None]
    of_file = {"shear_rate": shear_rate, "frame_strain": frame_strain, "frame_time": frame_time, "diameter": diameter}
    noise = {"position_noise": position_noise, "velocity_noise": velocity_noise, "diameter_noise": diameter_noise}
    others = {"peculiar": peculiar or None, "stride": stride}
    of_tracks = [name for name, value in (of_file | noise | others).items() if value is not None]
    if file.suffix != ".nc":
        if of_map:
            raise InputError(f"{of_map[0]} goes with a map, and {short_repr(file.name)} is not one.")
        thinned = {} if stride is None else {"stride": stride}
        _fit_tracks(file, _observed(peculiar=peculiar, **of_file) | thinned, noise)
    else:
        if of_tracks:
            raise InputError(f"{of_tracks[0]} goes with tracks of discs, and {short_repr(file.name)} is a map.")
        if 0 < len(of_map) < len(stresses):
            missing = next(name for name in stresses if name not in of_map)
            raise InputError(f"{missing} must be given too, or a restitution cannot be sought.")
        _fit_map(file, list(stresses.values()) if of_map else None, relative_error)


def _observed(
    shear_rate: float | None,
    frame_strain: float | None,
    frame_time: float | None,
    diameter: float | None,
    peculiar: bool,
) -> dict:
    """The arguments of ``read_tracks``: a strain between frames is a time, in units of 1/γ̇ where γ̇ is not given."""
    for name, value in (("frame_strain", frame_strain), ("frame_time", frame_time)):
        if value is not None:
            require_number(name, value, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    if frame_strain is not None:
        if frame_time is not None:
            raise InputError("frame_strain goes without --frame-time, as each says the other.")
        shear_rate = 1.0 if shear_rate is None else shear_rate
        require_number("shear_rate", shear_rate, lambda x: x > 0, "positive beside a strain")
        frame_time = frame_strain / shear_rate
    return {"interval": frame_time, "shear_rate": shear_rate, "peculiar": peculiar, "diameter": diameter}


def _fit_tracks(file: Path, observed: dict, noise: dict) -> None:
    require_device()
    from jaxgran.inference.restitution import caution, fit_restitution
    from jaxgran.io.track_files import read_tracks, recorded_restitution

    tracks = read_tracks(file, **observed)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "the interval may be too narrow")  # printed below
            found = fit_restitution(tracks, **noise)
    except RuntimeError as failure:
        stop(str(failure), BAD_STATUS)
    recorded = recorded_restitution(file)
    frames, grains = tracks.positions.shape[:2]
    digits = 1 - math.floor(math.log10(found.stderr))  # those that an end of the interval is found to
    rows = [
        ["restitution ± standard error", with_error(found.restitution, found.stderr)],
        ["95 % interval", f"{found.low:.{digits}f} to {found.high:.{digits}f}"],
        *([["recorded restitution", f"{recorded:g}"]] if recorded is not None else []),
        ["frames, discs", f"{frames}, {grains}"],
        ["collisions, rejected", f"{found.collisions}, {found.rejected}"],
        ["noise of the positions", f"{found.position_noise:.2g}"],
        [
            "noise of the velocities",
            "none given" if math.isnan(found.velocity_noise) else f"{found.velocity_noise:.2g}",
        ],
        ["error of the distance at contact", f"{found.diameter_noise:.2g}"],
        ["misfit over the noise", f"{found.misfit:.2g}"],
    ]
    print_table(Table("", ("of the tracks", "value"), rows, numbers=False))
    if words := caution(found):
        say(f"caution: {words}")


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
