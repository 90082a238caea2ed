"""How a command ends, and what it says on standard error.

===========  ========================================================
exit status  meaning
===========  ========================================================
0            done
1            the file system failed
2            a mistake in the input
3            finished, but a point has a bad status
130          interrupted (Ctrl-C)
143          ended by SIGTERM, which Slurm sends before it kills
===========  ========================================================
"""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import typer

from jaxgran.cache.folder import cache_folder, fallback_message, use_cache
from jaxgran.cli.output import Entry, JsonObject, print_json
from jaxgran.environment import devices
from jaxgran.maps.interruption import is_interruption
from jaxgran.model.checks import InputError, short_repr

NO_FILE = 1
INPUT_MISTAKE = 2
BAD_STATUS = 3
INTERRUPTED = 130
TERMINATED = 143

_SYMBOLS = {"--alpha": "--restitution", "--nu": "--packing-fraction", "--dt": "--timestep"}
"""The options of quantities that users may call by their symbols."""

_T = TypeVar("_T")
_UsageError: Any = typer.BadParameter.__base__  # of Typer, which does not export it


def run_command(command: Callable[[], None], sentence: Callable[[Any], str]) -> None:
    """Run a command; a mistake in its input, a file that cannot be written and an interruption end
    it with one sentence, made from a message by ``sentence``.
    """
    _Terminated.now = False
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        command()
    except InputError as mistake:
        stop(sentence(mistake))
    except (SystemExit, BrokenPipeError):
        raise
    except OSError as error:
        stop(_of_file(error, sentence), NO_FILE)
    except BaseException as error:
        if not is_interruption(error):
            raise
        stop("interrupted.", interrupted_status())
    finally:
        signal.signal(signal.SIGTERM, before)


def _of_file(error: OSError, sentence: Callable[[Any], str] = str) -> str:
    ours = (note for note in getattr(error, "__notes__", []) if note[:2] != "--")  # not JAX's
    notes = "".join(f"; {sentence(note)}" for note in ours)
    file = "" if error.filename is None else f": {short_repr(str(error.filename))}"
    cause = ":" if isinstance(error, ConnectionError) else " by the file system,"
    return f"stopped{cause} {error.strerror or error}{file}{notes}."


def exit_status(app: Callable[..., Any]) -> int:
    """Run the program, and return its exit status."""
    JsonObject.printed = False
    try:
        return app(prog_name="jaxgran", standalone_mode=False) or 0
    except _UsageError as mistake:
        name = _SYMBOLS.get(getattr(mistake, "option_name", ""))
        if name and any(name in parameter.opts for parameter in mistake.ctx.command.params):
            mistake.possibilities = [name]
        mistake.show()
        _print_json_error(mistake.format_message())
        return INPUT_MISTAKE
    except SystemExit as end:
        return int(end.code or 0)


def run_program(app: Callable[..., Any]) -> NoReturn:
    """Run the program, and end its process."""
    status = 0
    try:
        status = exit_status(app)
        sys.stdout.flush()  # a full disk fails here, and not when Python ends
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python fails as it ends
        if not isinstance(error, BrokenPipeError) and status != NO_FILE:
            say(f"jaxgran: {_of_file(error)}")
        status = NO_FILE
    _end_without_threads(status)
    raise SystemExit(status)


class _Terminated:
    """Whether SIGTERM has come."""

    now = False


def _interrupt(*_: object) -> NoReturn:
    """The first SIGTERM interrupts as Ctrl-C does, but leads to another exit status."""
    _Terminated.now = True
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # finished points are being saved
    raise KeyboardInterrupt


def _end_without_threads(status: int) -> None:
    """End the process if a thread of this package still computes or compiles.

    Python would wait for it, as for a minute of a large system; if it did not wait, XLA would end
    the process by a segmentation fault.
    """
    if any(thread.name.startswith("jaxgran-") for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def say(sentence: str) -> None:
    """Print on standard error."""
    print(sentence, file=sys.stderr)


def say_written(paths: Iterable[Path]) -> None:
    """Print the names of the written files."""
    for path in paths:
        say(f"wrote {path}")


def stop(sentence: str, status: int = INPUT_MISTAKE) -> NoReturn:
    """Print why the command ends without a result, and exit with the status."""
    say(f"jaxgran: {sentence}")
    _print_json_error(sentence)
    raise SystemExit(status)


def _print_json_error(sentence: str) -> None:
    """Print an error as the object that was asked for."""
    if "--json" in sys.argv and not JsonObject.printed:
        with suppress(OSError):  # it is the reason why there is no result
            print_json({"error": Entry(sentence, "why there is no result", None)})


def interrupted_status() -> int:
    """The exit status of the signal that interrupted the command."""
    return TERMINATED if _Terminated.now else INTERRUPTED


def configured_jax():
    """JAX in double precision, with a cache of compiled programs."""
    import jax

    if jax.config.jax_disable_jit:  # type: ignore[attr-defined]
        raise InputError("flows are compiled: unset JAX_DISABLE_JIT.")
    jax.config.update("jax_enable_x64", True)
    say_cache()
    use_cache()
    return jax


def require_device() -> None:
    """End the command with one sentence unless JAX has a device."""
    try:
        devices()
    except RuntimeError as failure:
        stop(f"JAX finds no device: {failure}. Set JAX_PLATFORMS=cpu to use the CPU.")


@cache
def say_cache() -> None:
    """Print once if the cache is not in the user's folder; Matplotlib's cache then goes to the same
    place.
    """
    if not fallback_message():
        return
    say(fallback_message())
    for message in ("the cache folder", "the numba engine is compiled anew"):
        warnings.filterwarnings("ignore", message)
    folder = cache_folder()
    if folder is not None:
        os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))


def with_progress(frames: Sequence[_T]) -> Iterable[_T]:
    """The frames of a movie one by one, with a progress bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    return track(frames, "drawing", console=console, disable=not console.is_terminal)
