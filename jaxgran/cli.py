"""Command line: ``jaxgran map``, ``plot``, ``run``, ``fit`` and ``info``.

Exit status: 0 done; 1 the file system fails; 2 a mistake in the input; 3 finished, but a point carries a bad status;
130 interrupted.
"""

import hashlib
import math
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import platformdirs
import typer
from rich import box
from rich.console import Console
from rich.table import Table

# XLA calls it an error, at length, that a program from the cache was compiled with tuning hints. This precedes JAX.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from jaxgran.flow import MAX_REPLICAS, Activation, InputError, Solver, require_number, shown
from jaxgran.progress import progress

NO_FILE, INPUT_MISTAKE, BAD_STATUS, INTERRUPTED = 1, 2, 3, 130
MOST_FRAMES = 100_000  # of a trajectory
_FAR_FROM_A_LAW = 9.0  # χ² of stresses that belong to no restitution of a map
FIRST_STRAIN = 4.0  # of samples that grow until their errors are small

_UsageError: Any = typer.BadParameter.__base__  # what typer raises for options that it cannot read

app = typer.Typer(
    help="Flows of rigid, frictionless discs in simple shear by contact dynamics.",
    epilog="Example: jaxgran map --restitution 0.1,0.5,0.9 --packing-fraction 0.5:0.8:4 --output ratio.nc",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

PRESETS: dict[str, dict[str, Any]] = {
    "quick": {
        "restitution": "0.2,0.35,0.5,0.65,0.8",
        "packing_fraction": "0.5,0.6,0.65,0.7,0.75,0.79",
        "grains": 256,
        "seeds": 2,
        "timestep": 1e-3,
        "strain": 8.0,
    },
    "paper": {
        "restitution": "0.1,0.2,0.3,0.4,0.5,0.6,0.7,0.8,0.9,0.98",
        "packing_fraction": "0.1,0.2,0.3,0.4,0.5,0.56,0.6,0.65,0.7,0.75,0.8,0.82",
        "grains": 400,
        "seeds": 4,
        "timestep": 1e-5,
        "strain": 4.0,
    },
}


def main() -> None:
    """Entry point: mistakes in the input end with one sentence and exit status 2."""
    try:
        status = app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except InputError as mistake:
        _stop(str(mistake))
    except _UsageError as mistake:
        words = " ".join(mistake.format_message().split()).rstrip(".")
        _stop(f"{words if len(words) <= 500 else f'{words[:250]} … {words[-245:]}'}.")
    except OSError as error:
        _stop(f"stopped by the file system, {error.strerror or error}.", NO_FILE)
    raise SystemExit(status)


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
            f"{MAX_REPLICAS}, not {shown(text)}."
        ) from None


def _numbers_or_auto(text: str | None, name: str) -> float | tuple[float, ...] | str | None:
    """One number, several, or the word auto, of an option that may be absent."""
    if text is None or text == "auto":
        return text
    numbers = number_list(text, name)
    return numbers[0] if len(numbers) == 1 else numbers


@app.command("map")
def map_command(
    preset: Annotated[Literal["quick", "paper"], typer.Option(help="Starting point for all other options.")] = "quick",
    restitution: Annotated[
        str | None, typer.Option(help="List of restitutions: 0.1,0.5,0.9 or start:stop:count.")
    ] = None,
    packing_fraction: Annotated[str | None, typer.Option(help="List of packing fractions, up to 0.83.")] = None,
    grains: Annotated[int | None, typer.Option(help="Grains of a replica.")] = None,
    seeds: Annotated[int | None, typer.Option(help="Replicas of each point.")] = None,
    timestep: Annotated[
        str | None,
        typer.Option(help="Time step of the sample, in 1/shear rate, auto, or a list that adds a dimension."),
    ] = None,
    equilibrate: Annotated[float | None, typer.Option(help="Strain before the sample. [default: until steady]")] = None,
    strain: Annotated[float | None, typer.Option(help="Sampled strain of each seed.")] = None,
    error: Annotated[
        float | None,
        typer.Option(help="Relative standard error of force ratio and stresses to reach, in place of --strain."),
    ] = None,
    tolerance: Annotated[
        str | None, typer.Option(help="Relative residual of a contact solve, or auto. [default: 1e-4]")
    ] = None,
    target_error: Annotated[
        float, typer.Option(help="Relative error of the stresses that auto aims at, 1e-4 to 0.1.")
    ] = 0.02,
    solver: Annotated[
        Solver | None, typer.Option(help="Iteration of the contact solve. [default: barzilai-borwein]")
    ] = None,
    activation: Annotated[Activation | None, typer.Option(help="When a pair is a contact. [default: midpoint]")] = None,
    batch: Annotated[str, typer.Option(help="Replicas that run together, or auto.")] = "auto",
    workers: Annotated[int | None, typer.Option(help="Processes. [default: one per core on a CPU]")] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a running Dask cluster, such as tcp://127.0.0.1:8786.")
    ] = None,
    output: Annotated[Path, typer.Option(help="NetCDF file; the figures go beside it.")] = Path("jaxgran_map.nc"),
    like: Annotated[
        Path | None, typer.Option(help="Dataset whose map is repeated; other options override its choices.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an unfinished map of this output.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress on standard error.")] = False,
) -> None:
    """Map the force ratio over restitution and packing fraction, with error bars, and draw Figures 1 and 2."""
    if scheduler is not None and workers is not None:
        raise InputError("scheduler and workers exclude each other: give one of them.")
    given = {
        "restitution": restitution,
        "packing_fraction": packing_fraction,
        "grains": grains,
        "seeds": seeds,
        "timestep": _numbers_or_auto(timestep, "timestep"),
        "equilibrate": equilibrate,
        "strain": _first_strain(strain, error),
        "error": error,
        "tolerance": _numbers_or_auto(tolerance, "tolerance"),
        "solver": solver,
        "activation": activation,
    }
    chosen = (PRESETS[preset] if like is None else _like(like)) | {
        name: value for name, value in given.items() if value is not None
    }
    for name in ("restitution", "packing_fraction"):
        if isinstance(chosen[name], str):
            chosen[name] = number_list(chosen[name], name)
    data, interrupted = _measure(chosen, _batch(batch), workers, output, quiet, target_error, resume, scheduler)

    from jaxgran.figures import save_figures

    pictures = [] if interrupted else save_figures(data, output.with_suffix(""))
    for one in _by_timestep(data):
        _print_table(_ratio_table(one))
    _finish(data, [output, *pictures], interrupted, can_resume=True)


@app.command("plot")
def plot_command(
    file: Annotated[Path, typer.Argument(help="Dataset of a map.")],
    output: Annotated[Path | None, typer.Option(help="Folder of the figures. [default: that of the dataset]")] = None,
) -> None:
    """Draw the figures of a map that has been run."""
    from jaxgran.dataset import read_dataset
    from jaxgran.figures import save_figures

    data = read_dataset(file)
    folder = file.parent if output is None else output
    if not os.path.isdir(folder) or not os.access(folder, os.W_OK):
        raise InputError(f"output must be a folder that exists and can be written to, not {shown(str(folder))}.")
    _say_written(save_figures(data, folder / file.stem))


@app.command("run")
def run_command(
    restitution: Annotated[float, typer.Option(help="Restitution, 0 to 1.")],
    packing_fraction: Annotated[float, typer.Option(help="Packing fraction, up to 0.83.")],
    grains: Annotated[int, typer.Option(help="Number of grains.")] = 256,
    strain: Annotated[float | None, typer.Option(help="Sampled strain. [default: 5]")] = None,
    error: Annotated[
        float | None,
        typer.Option(help="Relative standard error of force ratio and stresses to reach, in place of --strain."),
    ] = None,
    timestep: Annotated[str, typer.Option(help="Time step of the sample, in 1/shear rate, or auto.")] = "1e-3",
    trajectory: Annotated[Path | None, typer.Option(help="GSD file of the flow, frame by frame.")] = None,
    every: Annotated[
        float | None, typer.Option(help="Strain from frame to frame. [default: a hundredth of the sampled strain]")
    ] = None,
    movie: Annotated[Path | None, typer.Option(help="GIF of the flow (not available yet).")] = None,
    output: Annotated[Path | None, typer.Option(help="NetCDF file of the averages.")] = None,
) -> None:
    """Run one flow to its steady state, sample it, and print its averages with their errors."""
    if movie is not None:
        raise InputError("--movie is not available yet: run without it.")
    step = _numbers_or_auto(timestep, "timestep")
    if isinstance(step, tuple):
        raise InputError(f"timestep must be one number or auto, not {shown(timestep)}.")
    chosen = {
        "restitution": (restitution,),
        "packing_fraction": (packing_fraction,),
        "grains": grains,
        "seeds": 1,
        "timestep": step,
        "strain": _first_strain(strain, error) or 5.0,
        "error": error,
    }
    recorder = _recorder(trajectory, every, chosen["strain"])
    record = None if recorder is None else recorder.recording
    data, interrupted = _measure(chosen, "auto", 1, output, quiet=False, record=record)
    _print_table(_summary_table(data))
    if recorder is not None and recorder.frames:
        _say(f"wrote {trajectory}: {recorder.frames} frames")
    _finish(data, [output] if output else [], interrupted)


def _recorder(trajectory: Path | None, every: float | None, strain: float):
    """What records the flow in a file, frame by frame; None where no file is given."""
    if trajectory is None:
        if every is not None:
            raise InputError("every is the strain between the frames of a trajectory: add --trajectory FILE.gsd.")
        return None
    _configured_jax()
    from jaxgran.trajectory import Recorder, check_trajectory

    if every is not None:
        least, most = strain / MOST_FRAMES, strain
        words = f"at least {least:g} and at most the sampled strain, {most:g}"
        require_number("every", every, lambda x: (x >= 0.99 * least) & (x <= most), words)
    check_trajectory(trajectory)
    return Recorder(trajectory, strain / 100 if every is None else every)


def _like(file: Path) -> dict[str, Any]:
    """The choices of the map in a file; what else could change its numbers is said on standard error."""
    _configured_jax()
    from jaxgran.dataset import choices_of, differences, read_dataset
    from jaxgran.settings import MapSettings

    data = read_dataset(file)
    chosen = choices_of(data)
    others = differences(data, MapSettings(**chosen))
    if others:
        _say(f"not as in {file}: {'; '.join(others)}.")
    return chosen


def _first_strain(strain: float | None, error: float | None) -> float | None:
    """The strain to begin with: the one given, or a short one where an error is given in its place."""
    if strain is not None and error is not None:
        raise InputError("strain and error exclude each other: give one of them.")
    return strain if error is None else FIRST_STRAIN


@app.command("fit")
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
    """Infer the restitution of a trajectory, or fit a closure to a map and infer it from stresses."""
    _configured_jax()
    stresses = {"packing fraction": packing_fraction, "pressure": pressure, "shear stress": shear_stress}
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
    from jaxgran.calibrate import fit_restitution
    from jaxgran.trajectory import read_trajectory

    seen = read_trajectory(file)
    if not math.isfinite(float(seen.shear_rate)):
        raise InputError(
            f"{shown(file.name)} tells no strain and shear rate of its frames: use fit_restitution in Python."
        )
    try:
        found = fit_restitution(seen.strain, seen.state, float(seen.shear_rate), timestep)
    except RuntimeError as failure:
        _stop(f"{failure}" if f"{failure}".endswith(("?", ".")) else f"{failure}.", BAD_STATUS)
    table = Table(box=box.SIMPLE)
    table.add_column("restitution ± standard error")
    table.add_column(_with_error(found.restitution, found.stderr))
    table.add_row("recorded restitution", f"{float(seen.restitution):g}" if math.isfinite(seen.restitution) else "none")
    table.add_row("noise of the velocities, σγ̇", f"{found.noise:.2g}")
    table.add_row("windows, collisions", f"{found.windows}, {found.collisions:g}")
    table.add_row("outliers", f"{100 * found.outliers:.2g} %")
    _print_table(table)


def _fit_map(file: Path, stresses: list[float | None] | None, relative_error: float) -> None:
    from jaxgran.closure_fit import fit_closure
    from jaxgran.cross_validation import leave_one_out
    from jaxgran.dataset import read_dataset
    from jaxgran.stress_inversion import restitution_from_stresses

    data = read_dataset(file)
    closure, errors = fit_closure(data), leave_one_out(data)
    table = Table(
        title="Closure of the map, each point predicted from the others", box=box.SIMPLE, title_justify="left"
    )
    for name in ("observable", "rms error", "largest error", "noise of a point"):
        table.add_column(name)
    for name in ("pressure", "shear_stress", "force_ratio"):
        error, noise = abs(errors[f"{name}_error"]), errors[f"{name}_noise"]
        shares = ((error**2).mean() ** 0.5, error.max(), (noise**2).mean() ** 0.5)
        table.add_row(name.replace("_", " "), *(f"{100 * float(share):.2g} %" for share in shares))
    _print_table(table)
    if stresses is not None:
        nu, pressure, shear = (float(x) for x in stresses if x is not None)
        noise = (relative_error * pressure, relative_error * shear)
        found = restitution_from_stresses(closure, nu, pressure, shear, *noise)
        words = "" if bool(found.determined) else ", hardly determined: the stresses depend little on it there"
        if float(found.chi_squared) > _FAR_FROM_A_LAW:
            words = ", the nearest in the map: none there has these stresses"
        print(f"restitution {_with_error(float(found.restitution), float(found.stderr))}{words}")


@app.command("info")
def info_command() -> None:
    """Print the versions, devices and folders that a bug report needs."""
    jax = _configured_jax()
    packages = ("jaxgran", "jax", "jaxlib", "jax-md", "numpy", "xarray", "h5netcdf", "matplotlib")
    lines = {
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
        "platform": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "devices": ", ".join(f"{d.platform}: {d.device_kind}" for d in jax.devices()),
        "precision": "float64",
        "compilation cache": jax.config.values["jax_compilation_cache_dir"],
    }
    for name, value in lines.items():
        print(f"{name:18s} {value}")


def _stop(sentence: str, status: int = INPUT_MISTAKE) -> NoReturn:
    print(f"jaxgran: {sentence}", file=sys.stderr)
    raise SystemExit(status)


def _configured_jax():
    """JAX in double precision, with compiled programs kept in the cache folder of the user."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", _compilation_cache())
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    return jax


def _compilation_cache() -> str:
    """Folder of compiled programs, one for each kind of processor: a home folder may be shared by several."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.is_file() else []
    processor = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    kind = hashlib.sha256(processor.encode()).hexdigest()[:12]
    return str(Path(platformdirs.user_cache_dir("jaxgran")) / kind)


def _batch(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if not text.isdecimal() or len(text) > 9 or int(text) < 1:
        raise InputError(f"batch must be auto or a whole number of at least 1, below a billion, not {shown(text)}.")
    return int(text)


def _measure(
    chosen: dict[str, Any],
    batch: int | Literal["auto"],
    workers: int | None,
    output: Path | None,
    quiet: bool,
    target_error: float = 0.02,
    resume: bool | None = None,
    scheduler: str | None = None,
    record: Callable | None = None,
):
    """Run a map with progress, write its dataset, and return it and whether it was interrupted.

    Where ``resume`` is not None a checkpoint is kept beside the output, and continued if ``resume`` is True. What
    ``record`` is, ``replicas`` says.
    """
    jax = _configured_jax()
    from jaxgran.checkpoint import Checkpoint
    from jaxgran.dataset import check_output, map_dataset, write_dataset
    from jaxgran.settings import MapSettings, automatic
    from jaxgran.sweep import check_batches, predicted_cost, replicas, usable_cores

    if output is not None:
        check_output(output)
    numbers, automatic_choice = automatic(chosen, target_error)
    settings = MapSettings(**numbers)
    if automatic_choice:
        _say(f"chosen: {automatic_choice}")
    on_cpu = jax.default_backend() == "cpu"
    check_batches(batch, 1 if workers is None else workers)
    count = len(settings.flows()) * settings.seeds
    workers = min(count, workers or (usable_cores() if on_cpu else 1))
    costs = [predicted_cost(flow) for flow in settings.flows()]
    checkpoint = None if output is None or resume is None else Checkpoint(output, settings, resume)
    results = {} if checkpoint is None else dict(checkpoint.done)
    run: dict[str, Any] = {
        "automatic_choice": automatic_choice,
        "command": os.fsencode(shlex.join(["jaxgran", *sys.argv[1:]])).decode(errors="backslashreplace"),
        "workers": workers,
        "resumed_replicas": len(results),
    }
    if resume:
        _say_resumed(checkpoint, count)

    start, interrupted, finished = time.perf_counter(), False, False
    try:
        with progress(costs, settings.seeds, quiet) as meter:
            meter.resumed(point for point, _ in results)
            running = replicas(settings, batch, workers, meter.steps, checkpoint, _say, scheduler, record)
            try:
                for key, replica in running:
                    results[key] = replica
                    meter.replica(key[0])
            except KeyboardInterrupt:
                interrupted = True
            finally:
                running.close()
        seconds = time.perf_counter() - start
        speed = {"wall_time_seconds": seconds, "replica_steps_per_second": meter.done_steps / seconds}
        data = map_dataset(settings, results, run | speed)
        if output is not None and results:
            write_dataset(data, output)
        finished = len(results) == count
    except OSError as error:
        kept = "" if checkpoint is None else f"; what is done is in {checkpoint.folder}: make room and add --resume"
        _stop(f"stopped by the file system, {error.strerror or error}{kept}.", NO_FILE)
    finally:
        if checkpoint is not None:
            checkpoint.close(finished)
    return data, interrupted


def _say_resumed(checkpoint, count: int) -> None:
    journals = len(checkpoint.journals())
    _say(f"continued: {len(checkpoint.done)} of {count} replicas are done, {journals} batches are under way.")
    if checkpoint.damaged:
        _say(f"damaged and computed anew: {', '.join(checkpoint.damaged)}.")


def _say(sentence: str) -> None:
    print(sentence, file=sys.stderr)


def _with_error(value: float, error: float) -> str:
    return f"{value:.4g} ± {error:.2g}"


def _by_timestep(data) -> list:
    """The part of a map for each of its time steps, which is the attribute ``timestep`` of the part."""
    if "timestep" not in data.dims:
        return [data]
    return [data.sel(timestep=dt).assign_attrs(timestep=dt) for dt in data.timestep.values.tolist()]


def _bad_points(data) -> dict[str, list[str]]:
    """Points by the name of their bad status."""
    names = dict(
        zip(data.status.attrs["flag_values"].tolist(), data.status.attrs["flag_meanings"].split(), strict=True)
    )
    bad: dict[str, list[str]] = {}
    parts = _by_timestep(data)
    for part in parts:
        which = f", time step {part.attrs['timestep']:g}" if len(parts) > 1 else ""
        for nu in part.packing_fraction.values:
            for alpha in part.restitution.values:
                name = names[int(part.status.sel(packing_fraction=nu, restitution=alpha))]
                if name != "ok":
                    bad.setdefault(name, []).append(f"(restitution {alpha:g}, packing fraction {nu:g}{which})")
    return bad


def _ratio_table(data) -> Table:
    timestep, rule = data.attrs["timestep"], data.attrs["activation"]
    title = f"Force ratio at dt = {timestep:g} / shear rate, {rule} activation; a column is a restitution"
    table = Table(title=title, box=box.SIMPLE, title_justify="left")
    table.add_column("packing fraction")
    for alpha in data.restitution.values:
        table.add_column(f"{alpha:g}", justify="right", no_wrap=True)
    for nu in data.packing_fraction.values:
        row = data.sel(packing_fraction=nu)
        marks = ["" if status == 0 else " *" for status in row.status.values]
        cells = zip(row.force_ratio.values, row.force_ratio_stderr.values, marks, strict=True)
        table.add_row(f"{nu:g}", *(_with_error(value, error) + mark for value, error, mark in cells))
    return table


def _summary_table(data) -> Table:
    from jaxgran.observables import OBSERVABLES, TENSORS

    table = Table(box=box.SIMPLE)
    for name in ("observable", "value ± standard error", "unit", "effective samples", "kinetic theory"):
        table.add_column(name)
    point = data.isel(packing_fraction=0, restitution=0)
    strain = float(point.strain_by_seed.sum())
    for name in OBSERVABLES:
        if name not in TENSORS:
            unit = OBSERVABLES[name][1]
            cell = _with_error(float(point[name]), float(point[f"{name}_stderr"]))
            correlation = (
                float(point[f"{name}_correlation_strain"]) if f"{name}_correlation_strain" in point else math.nan
            )
            samples = strain / correlation
            theory = float(point[f"theory_{name}"]) if f"theory_{name}" in point else math.nan
            numbers = ["" if math.isnan(x) else f"{x:.3g}" for x in (samples, theory)]
            table.add_row(name.replace("_", " "), cell, "" if unit == "1" else unit, *numbers)
    return table


def _print_table(table: Table) -> None:
    """Print a table on standard output, in full width where that is a file."""
    console = Console()
    console.print(table) if console.is_terminal else Console(width=40 + 20 * len(table.columns)).print(table)


def _say_written(paths: Iterable[Path]) -> None:
    for path in paths:
        print(f"wrote {path}", file=sys.stderr)


def _say_imprecise(data) -> None:
    """Say where the error that was asked for has not been reached."""
    from jaxgran.measure import ERROR_OBSERVABLES

    if "error" not in data.attrs:
        return
    worst = max(float((data[f"{name}_stderr"] / abs(data[name])).max()) for name in ERROR_OBSERVABLES)
    strain = data.strain_by_seed
    print(
        f"relative standard errors: {data.attrs['error']:g} asked for, {worst:.2g} at the worst point; strains of "
        f"{float(strain.min()):g} to {float(strain.max()):g} per seed",
        file=sys.stderr,
    )


def _say_retried(data) -> None:
    """Say how many replicas have shorter time steps than asked for, because they had come to nothing."""
    asked = data.timestep if "timestep" in data.dims else data.attrs["timestep"]
    retried = int((data.timestep_by_seed < 0.75 * asked).sum())
    if retried:
        _say(f"retried with half the time step: {retried} replicas, see timestep_by_seed.")


def _finish(data, written: list[Path], interrupted: bool, can_resume: bool = False) -> None:
    """Say what was written and what went wrong, and exit with the status that tells it."""
    started = bool((data.status_by_seed >= 0).any())  # with nothing to save, a file there is an older one
    written = [path for path in written if started and path.exists()]
    _say_written(written)
    _say_imprecise(data)
    _say_retried(data)
    bad = _bad_points(data)
    if interrupted:
        missing = len(bad.get("not_run", []))
        saved = "; what is done is saved" if written else ""
        resume = " --resume" if can_resume and "--resume" not in data.attrs["command"] else ""
        _stop(
            f"interrupted with {missing} points missing{saved}. Continue: {data.attrs['command']}{resume}", INTERRUPTED
        )
    if bad:
        words = "; ".join(f"{name.replace('_', ' ')}: {', '.join(points)}" for name, points in bad.items())
        _stop(f"finished, but points marked * have a bad status. {words}.", BAD_STATUS)
