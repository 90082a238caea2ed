"""Shared by all commands: exit statuses, sentences on standard error, the set-up of JAX.

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
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from io import BufferedWriter, FileIO, TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from jaxgran.cache.folder import cache_folder, fallback_message, use_cache
from jaxgran.environment import devices

NO_FILE = 1
INPUT_MISTAKE = 2
BAD_STATUS = 3
INTERRUPTED = 130
TERMINATED = 143

_T = TypeVar("_T")
_terminated = False  # whether SIGTERM has come


def configured_jax():
    """JAX in double precision, with a cache of compiled programs."""
    import jax

    jax.config.update("jax_enable_x64", True)
    _say_cache()
    use_cache()
    return jax


def require_device() -> None:
    """End the command with one sentence unless JAX has a device."""
    try:
        devices()
    except RuntimeError as failure:
        stop(f"JAX finds no device: {failure}. Set JAX_PLATFORMS=cpu to use the CPU.")


@cache
def _say_cache() -> None:
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


def outlive_readers() -> None:
    """Discard output whose reader has gone, as in ``| head``, instead of failing."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if type(stream) is TextIOWrapper and not stream.isatty():
            stream.flush()
            buffer = BufferedWriter(_Outliving(stream.fileno(), "w", closefd=False))
            lines, encoding = stream.line_buffering, stream.encoding
            setattr(sys, name, TextIOWrapper(buffer, encoding, stream.errors, line_buffering=lines))


class _Outliving(FileIO):
    """A pipe or a file that discards output once its reader has gone, or once it has failed with an
    OSError.
    """

    _failed = False

    def write(self, content: Any) -> int:
        if self._failed:
            return len(content)
        try:
            return super().write(content)
        except BrokenPipeError:
            return len(content)
        except OSError as error:
            self._failed = True
            error.filename = "standard output" if self.fileno() == 1 else "standard error"
            raise


def say(sentence: str) -> None:
    """Print on standard error."""
    print(sentence, file=sys.stderr)


def say_written(paths: Iterable[Path]) -> None:
    """Print the names of the written files."""
    for path in paths:
        say(f"wrote {path}")


def stop(sentence: str, status: int = INPUT_MISTAKE) -> NoReturn:
    """Print why the command ends, and exit with the status."""
    say(f"jaxgran: {sentence}")
    raise SystemExit(status)


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """The first SIGTERM interrupts the block as Ctrl-C does, but leads to another exit status."""
    global _terminated
    _terminated = False

    def interrupt(*_: object) -> NoReturn:
        global _terminated
        _terminated = True
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # finished points are being saved
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def end_without_threads(status: int) -> None:
    """End the process if a thread of this package still computes or compiles, which Python would
    wait for.
    """
    if any(thread.name.startswith("jaxgran-") for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def stop_interrupted(sentence: str) -> NoReturn:
    """Print that the command was interrupted, and exit with the status of the signal."""
    stop(sentence, TERMINATED if _terminated else INTERRUPTED)


def counted(items: Sequence[_T], words: str) -> Iterator[_T]:
    """The items one by one, with a progress bar on a terminal; ``words`` is its title."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = TextColumn(words), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        yield from bar.track(items)
