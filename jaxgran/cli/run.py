"""The command ``run``: one flow, its averages, and its frames as a trajectory or movie."""

import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from jaxgran.cli.options import QUIET, command, of_map
from jaxgran.cli.outcome import finish, run_map
from jaxgran.cli.output import JSON, print_json
from jaxgran.cli.summary import print_flow, summary_of
from jaxgran.cli.terminal import configured_jax, say, with_progress
from jaxgran.io.paths import require_absent
from jaxgran.maps.options import Option
from jaxgran.model.checks import InputError, at_most, require_number
from jaxgran.model.display import counted

MOST_RECORDED = 100_000  # frames of a trajectory
_RECORDED_STRAIN = 5.0  # sampled strain where frames are recorded and none is given
_MOVIE_STRAIN, _MOVIE_FRAMES = 0.005, 40  # between frames of a movie, and its frames

RUN_EXAMPLES = {
    "A flow in its steady state: averages with errors": "jaxgran run --restitution 0.5 "
    "--packing-fraction 0.7",
    "A movie of one, forty frames": "jaxgran run --restitution 0.1 --packing-fraction 0.8 "
    "--movie flow.gif",
    "All its frames for other programs, every 0.01 of strain": "jaxgran run --restitution 0.5 "
    "--packing-fraction 0.7 --trajectory flow.gsd --frame-strain 0.01",
}


RUN_OPTIONS = {
    **of_map("run"),
    "trajectory": Option("Record the flow in a GSD file.", Path, example="FILE.gsd"),
    "movie": Option(
        "Record a movie of the grains and their forces, GIF or MP4.", Path, example="FILE.gif"
    ),
    "frame_strain": Option(
        "Strain between frames.",
        default="0.005 for 40 frames of a movie; a hundredth of --strain, or 0.05 with --error, "
        "with --trajectory",
    ),
    "force_strain": Option(
        "Strain over which the forces of a frame are averaged, at most --frame-strain.",
        default="--frame-strain for a movie, one time step with --trajectory",
    ),
    "all": Option("Print every average.", bool),
    "json": JSON,
    "quiet": QUIET,
}
RUN_OPTIONS["strain"] = replace(
    RUN_OPTIONS["strain"], default=f"{RUN_OPTIONS['strain'].default}; 5 with frames"
)
RUN_OPTIONS["seeds"] = replace(RUN_OPTIONS["seeds"], default="1")
RUN_OPTIONS["grains"] = replace(
    RUN_OPTIONS["grains"], help=f"{RUN_OPTIONS['grains'].help} A list adds columns."
)


def simulate_flow(
    restitution: float,
    packing_fraction: float,
    trajectory: Path | None = None,
    movie: Path | None = None,
    frame_strain: float | None = None,
    force_strain: float | None = None,
    all: bool = False,
    json: bool = False,
    quiet: bool = False,
    **given: Any,
) -> None:
    chosen = {"seeds": 1, **given}
    named = {"trajectory": trajectory, "movie": movie}
    files = {name: file for name, file in named.items() if file is not None}
    recorder = film = record = None
    if files:
        chosen = _recorded(files, chosen)
        strain = chosen.get("strain", _RECORDED_STRAIN)
        if trajectory is not None:  # so that recordings of one name do not meet
            unique = f"{trajectory.name}.unfinished-{secrets.token_hex(4)}"
            files["unfinished"] = Path(os.path.realpath(trajectory)).with_name(unique)
        recorder, film = _recorder(files, strain, frame_strain, force_strain)
        record = recorder.recording
    elif frame_strain is not None or force_strain is not None:
        name = "force_strain" if frame_strain is None else "frame_strain"
        raise InputError(f"`{name}` requires `trajectory` or `movie`.", field=name)
    plane = {"restitution": (restitution,), "packing_fraction": (packing_fraction,)}
    with _complete_at_the_end(files, bool(given.get("overwrite"))):
        data, interrupted, written = run_map({**plane, **chosen, "record": record}, quiet)
    if not json:
        print_flow(data, all)
    if recorder is not None and recorder.frames:
        _write_frames(files, recorder, film, quiet)
    if json:
        print_json(summary_of(data.isel(packing_fraction=0, restitution=0)))
    output = chosen.get("output")
    saved = "the frames until then are saved." if recorder is not None and recorder.frames else ""
    written = [output] if output is not None and written else []
    finish(data, written, interrupted, quiet, output, saved)


run_command = command(RUN_OPTIONS, simulate_flow, required=("restitution", "packing_fraction"))


@contextmanager
def _complete_at_the_end(files: dict[str, Path], overwrite: bool) -> Iterator[None]:
    """A trajectory that the block has recorded gets its own name, also after an interruption; where
    another process has taken this name meanwhile, it keeps its own. An error of the file system,
    such as that of a full disk, leaves none.
    """
    unfinished = files.get("unfinished")
    try:
        yield
    except OSError:
        if unfinished is not None:
            unfinished.unlink(missing_ok=True)
        raise
    finally:
        if unfinished is not None and unfinished.exists():
            taken = not overwrite and os.path.isfile(files["trajectory"])
            if taken:
                say(f"another process has written {files['trajectory']} meanwhile.")
                files["trajectory"] = unfinished
            else:
                unfinished.replace(os.path.realpath(files["trajectory"]))


def _recorded(files: Mapping[str, Path], chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of a flow whose frames are recorded, with a short strain where none is
    given.
    """
    several = {"seeds": chosen["seeds"] > 1, "grains": isinstance(chosen.get("grains"), tuple)}
    for name in (name for name, true in several.items() if true):
        reason = f"`trajectory` and `movie` show one flow of one seed: leave out `{name}`."
        raise InputError(reason, field=name)
    if chosen.get("resume"):
        raise InputError("`trajectory` and `movie` exclude `resume`.", field="resume")
    if not chosen.get("overwrite"):
        for name, file in files.items():
            require_absent(file, name)
    return dict(chosen) if "error" in chosen else {"strain": _RECORDED_STRAIN, **chosen}


def _recorder(
    files: Mapping[str, Path], strain: float, every: float | None, force_strain: float | None
) -> tuple[Any, Any]:
    """The recorder of the flow, and the frames of its movie."""
    configured_jax()
    from jaxgran.io.trajectory import check_trajectory, write_frame
    from jaxgran.plotting.movie import MOST_DRAWN, Frames, check_movie
    from jaxgran.sampling.recorder import Recorder

    film_alone = "trajectory" not in files
    enough = _MOVIE_FRAMES if film_alone and every is None else None
    most = MOST_DRAWN if "movie" in files else MOST_RECORDED
    least, between = strain / most, _MOVIE_STRAIN if enough else every or strain / 100
    accepted = f"at least {least:g}, for {most} frames, and at most the sampled strain, {strain:g}"
    if every is not None:
        require_number(
            "frame_strain", every, lambda x: (x >= 0.99 * least) & at_most(x, strain), accepted
        )
    if force_strain is not None:
        accepted = f"above 0 and at most the strain between frames, {between:g}"
        require_number(
            "force_strain", force_strain, lambda x: (x > 0) & at_most(x, between), accepted
        )
    keep, film = [], Frames()
    if "trajectory" in files:
        check_trajectory(files["trajectory"])
        keep.append(partial(write_frame, files["unfinished"]))
    if "movie" in files:
        check_movie(files["movie"])
        keep.append(film.keep)
    averaged = between if film_alone and force_strain is None else force_strain or 0.0
    return Recorder(between, *keep, force_strain=averaged, most=enough), film


def _write_frames(files: Mapping[str, Path], recorder: Any, film: Any, quiet: bool) -> None:
    """Draw the movie, and say what was written, and whether it lacks forces."""
    from jaxgran.io.trajectory import lost_forces
    from jaxgran.plotting.movie import write_movie

    if "movie" in files:
        write_movie(files["movie"], film, follow=iter if quiet else with_progress)
    if not quiet:
        say("recording splits the run at different steps: averages change within their errors.")
        counts = {"trajectory": recorder.frames, "movie": len(film)}
        for name, count in counts.items():
            if name in files:
                say(f"wrote {files[name]}: {counted(count, 'frame')}")
    if recorder.status > 0:
        say(lost_forces(recorder.status))
