"""The command ``fit``: the restitution of discs from their tracks, or a closure fitted to a map."""

import math
import warnings
from pathlib import Path
from typing import Any

from jaxgran.cli.arguments import command
from jaxgran.cli.json_output import JSON, Entry, print_json
from jaxgran.cli.tables import Table, print_table
from jaxgran.cli.terminal import BAD_STATUS, configured_jax, require_device, say, stop
from jaxgran.maps.parameters import Option
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


_POSITIVE = (lambda x: (x > 0) & (x < math.inf), "a positive number")
_TRACKS = {
    "shear_rate": Option("Shear rate of the tracks.", default="that of the file, or of its tilting cell"),
    "frame_strain": Option("Strain between frames of the tracks, in place of --frame-time.", range=_POSITIVE),
    "frame_time": Option(
        "Time between frames of the tracks.", range=_POSITIVE, default="that of the file, or of its velocities"
    ),
    "peculiar": Option("The velocities of the tracks lack the shear.", bool),
    "diameter": Option("Diameter of all discs, where the tracks have none."),
    "stride": Option(
        "Use every N-th frame of the tracks, where contacts outlast a frame.",
        int,
        range=(lambda x: x >= 1, "a whole number of at least 1"),
        example="N",
    ),
    "position_noise": Option("Standard error of a coordinate.", default="estimated from straight parts of the tracks"),
    "velocity_noise": Option("Standard error of a velocity component.", default="estimated in the same way"),
    "diameter_noise": Option("Standard error of the distance at contact.", default="estimated from the collisions"),
}
_STRESSES = {
    "packing_fraction": Option("Packing fraction of a flow whose restitution is inferred from its stresses, by a map."),
    "pressure": Option("Its pressure, in m γ̇²."),
    "shear_stress": Option("Its shear stress, in m γ̇²."),
}
FIT_OPTIONS = {
    **_TRACKS,
    **_STRESSES,
    "relative_error": Option(
        "Relative standard error of these stresses.", range=(lambda x: (x >= 0) & (x <= 1), "between 0 and 1")
    ),
    "json": JSON,
}
FIT_FILE = Option("Tracks of discs (.gsd, .csv, .tsv, .txt, .h5, .hdf5, .lammpstrj, .dump), or a map (.nc).", Path)


def run_fit_command(file: Path, relative_error: float = 0.0, json: bool = False, **given: Any) -> None:
    configured_jax()
    of_tracks, of_map = ({name: x for name, x in given.items() if name in table} for table in (_TRACKS, _STRESSES))
    if file.suffix != ".nc":
        if of_map:
            name = next(iter(of_map))
            raise InputError(f"{name} requires a map, and {short_repr(file.name)} is none.", field=name)
        noise = {name: of_tracks.pop(name, None) for name in ("position_noise", "velocity_noise", "diameter_noise")}
        _fit_tracks(file, _reading(**of_tracks), noise, json)
        return
    if of_tracks:
        name = next(iter(of_tracks))
        raise InputError(f"{name} requires tracks of discs, and {short_repr(file.name)} is a map.", field=name)
    missing = [name for name in _STRESSES if name not in of_map]
    if of_map and missing:
        raise InputError(f"{missing[0]} must be given, too, to infer a restitution.", field=missing[0])
    _fit_map(file, [of_map[name] for name in _STRESSES] if of_map else None, relative_error, json)


fit_command = command(FIT_OPTIONS, run_fit_command, argument=FIT_FILE)


def _reading(
    shear_rate: float | None = None,
    frame_strain: float | None = None,
    frame_time: float | None = None,
    stride: int = 1,
    **others: Any,
) -> dict[str, Any]:
    """The arguments of ``read_tracks``: a strain between frames is a time, in units of 1/γ̇ where γ̇ is not given."""
    if frame_strain is not None:
        if frame_time is not None:
            raise InputError("`frame_strain` and `frame_time` exclude each other.", field="frame_strain")
        shear_rate = 1.0 if shear_rate is None else shear_rate
        require_number("shear_rate", shear_rate, lambda x: x > 0, "positive beside a strain")
        frame_time = frame_strain / shear_rate
    return {"interval": frame_time, "shear_rate": shear_rate, "stride": stride, **others}


def _fit_tracks(file: Path, observed: dict, noise: dict, json: bool) -> None:
    require_device()
    from jaxgran.inference.restitution import caution, fit_restitution
    from jaxgran.io.track_files import read_tracks, recorded_restitution

    with warnings.catch_warnings():
        warnings.showwarning = lambda warning, *_, **__: say(f"{warning}")
        tracks = read_tracks(file, **observed)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "the interval may be too narrow")  # printed below
            found = fit_restitution(tracks, **noise)
    except RuntimeError as failure:
        stop(str(failure), BAD_STATUS)
    recorded = recorded_restitution(file)
    frames, grains = tracks.positions.shape[:2]
    if json:
        print_json(_entries_of_tracks(found, recorded, frames, grains))
        if warning := caution(found):
            say(f"caution: {warning}")
        return
    digits = 1 - math.floor(math.log10(found.stderr))  # significant ones of an end of the interval
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
    if warning := caution(found):
        say(f"caution: {warning}")


def _entries_of_tracks(found: Any, recorded: float | None, frames: int, grains: int) -> dict[str, Entry]:
    """What a fit of tracks found."""
    return {
        "restitution": Entry(found.restitution, "restitution of the discs", "1", found.stderr),
        "restitution_low": Entry(found.low, "lower end of the interval of 95 %"),
        "restitution_high": Entry(found.high, "upper end of the interval of 95 %"),
        "recorded_restitution": Entry(math.nan if recorded is None else recorded, "restitution that the file names"),
        "frames": Entry(frames, "frames of the tracks"),
        "grains": Entry(grains, "discs of the tracks"),
        "collisions": Entry(found.collisions, "collisions that were fitted"),
        "rejected": Entry(found.rejected, "collisions that were left out"),
        "position_noise": Entry(found.position_noise, "standard error of a coordinate", "length of the file"),
        "velocity_noise": Entry(found.velocity_noise, "standard error of a velocity component", "velocity of the file"),
        "diameter_noise": Entry(found.diameter_noise, "standard error of a distance at contact", "length of the file"),
        "misfit": Entry(found.misfit, "misfit over the noise"),
    }


def _fit_map(file: Path, stresses: list[float] | None, relative_error: float, json: bool) -> None:
    require_device()
    from jaxgran.inference.closure_fit import fit_closure
    from jaxgran.inference.cross_validation import leave_one_out
    from jaxgran.inference.stress_inversion import restitution_from_stresses
    from jaxgran.maps.results import open_map

    data = open_map(file)
    closure, errors = fit_closure(data), leave_one_out(data)
    columns = ("observable", "rms error", "largest error", "noise of a point")
    table = Table("Closure of the map, each point predicted from the others", columns, numbers=False)
    entries = {}
    for name in ("pressure", "shear_stress", "force_ratio"):
        error, noise = abs(errors[f"{name}_error"]), errors[f"{name}_noise"]
        shares = ((error**2).mean() ** 0.5, error.max(), (noise**2).mean() ** 0.5)
        table.rows.append([name.replace("_", " "), *(f"{100 * float(share):.2g} %" for share in shares)])
        for column, share in zip(columns[1:], shares, strict=True):
            entries[f"{name}_{column.replace(' ', '_')}"] = Entry(share, f"relative {column} of the {name} of a point")
    if stresses is None:
        print_json(entries) if json else print_table(table)
    else:
        nu, pressure, shear = stresses
        noise = (relative_error * pressure, relative_error * shear)
        found = restitution_from_stresses(closure, nu, pressure, shear, *noise)
        if not math.isfinite(found.restitution):
            stop(f"no restitution could be found for these stresses in {short_repr(file.name)}.", BAD_STATUS)
        if json:
            flow = {
                "restitution": Entry(found.restitution, "restitution of a flow with these stresses", "1", found.stderr),
                "chi_squared": Entry(found.chi_squared, "squared misfit of the stresses over their errors"),
                "determined": Entry(found.determined, "whether the stresses determine the restitution", None),
            }
            print_json(flow | entries)
            return
        note = "" if bool(found.determined) else ", poorly determined: the stresses depend little on it there"
        if float(found.chi_squared) > _LARGEST_CHI_SQUARED:
            note = ", the nearest in the map: no restitution has these stresses"
        print_table(table)
        print(f"restitution {with_error(float(found.restitution), float(found.stderr))}{note}")
