"""Where the tests keep what is compiled, and how it is compiled: most of the time of a run is compilation.

Compiled programs are kept from run to run in ``.pytest_cache/jaxgran``, also for processes that the tests start. They
are found again by what they are compiled from, so nothing has to be removed by hand. Programs that were not used for
``DAYS`` days go, and the oldest of more than ``MOST_BYTES``. With ``JAXGRAN_TEST_CACHE=temporary``, a run begins with
an empty folder of its own; any other value names a folder.

XLA leaves out optimisation, and makes a loop of each operation by its older and quicker method. With ``XLA_FLAGS`` of
one's own, ``--xla_backend_optimization_level=3``, the tests run what users have.
"""

import mmap
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from jaxgran.environment import processor_kind

DAYS = 14
MOST_BYTES = 2**30
QUICK_FLAGS = {"xla_backend_optimization_level": "0", "xla_cpu_use_fusion_emitters": "false"}
FIRST_PROCESS = "PYTEST_XDIST_WORKER" not in os.environ
CHOSEN = os.environ.get("JAXGRAN_TEST_CACHE")
TEMPORARY = CHOSEN == "temporary"
DAMAGED = "Error reading persistent compilation cache entry"


def cache_folder() -> Path:
    """The folder of compiled programs of this run; one for each kind of processor."""
    if TEMPORARY:
        return Path(tempfile.mkdtemp(prefix="jaxgran-tests-"))
    if CHOSEN:
        return Path(CHOSEN)
    kind = processor_kind()
    folder = Path(__file__).parents[1] / ".pytest_cache" / "jaxgran" / kind
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder if os.access(folder, os.W_OK) else Path(tempfile.gettempdir()) / f"jaxgran-tests-{kind}"


def remove_unused(folder: Path) -> None:
    """Remove empty files, which a killed process leaves, those of long ago, and the oldest of too many."""
    files = [(path, path.stat()) for path in folder.rglob("*") if path.is_file()]
    files.sort(key=lambda file: max(file[1].st_atime, file[1].st_mtime), reverse=True)
    held, oldest = 0, time.time() - DAYS * 86400
    for path, status in files:
        held += status.st_size
        if not status.st_size or held > MOST_BYTES or max(status.st_atime, status.st_mtime) < oldest:
            path.unlink(missing_ok=True)


def quick_flags() -> str:
    """The flags of XLA that this JAX knows; XLA ends the process at a flag that it does not know."""
    spec = find_spec("jaxlib")
    libraries = [file for folder in spec.submodule_search_locations or () for file in Path(folder).glob("*jax_common*")]
    known = set()
    for library in libraries:
        with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as text:
            # a flag is a text of C between zeros; one that was removed is still among the reserved names
            known |= {flag for flag in QUICK_FLAGS if text.find(b"\0%s\0" % flag.encode()) >= 0}
    return " ".join(f"--{flag}={value}" for flag, value in QUICK_FLAGS.items() if flag in known)


def exact_order() -> dict[str, bool]:
    """Options of a compilation whose sums do not depend on what else is in an array, as users have them."""
    flag = "xla_cpu_use_fusion_emitters"
    return {flag: True} if f"{flag}=false" in os.environ["XLA_FLAGS"] else {}


def optimised(function: Callable) -> Callable:
    """``jax.jit`` of a function that is optimised, where the tests would run it for longer than that takes."""
    import jax

    flag = "xla_backend_optimization_level"
    how = {flag: 1} if f"{flag}=0" in os.environ["XLA_FLAGS"] else {}
    return jax.jit(getattr(function, "__wrapped__", function), compiler_options=how)


def set_up() -> None:
    """Set the environment, before JAX is loaded; processes that share the tests find it set."""
    if FIRST_PROCESS:
        folder = cache_folder()
        remove_unused(folder)
        os.environ["XDG_CACHE_HOME"] = str(folder)
    if "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = quick_flags()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # as the command line does, and why
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes of xdist, which start later: each has a core


def configure_jax() -> None:
    """Keep whatever is compiled."""
    import jax

    from jaxgran.cache import persistent_jit

    jax.config.update("jax_compilation_cache_dir", str(compiled_programs()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    persistent_jit._folder = lambda: None  # tests replace functions, of which the key of a kept program knows nothing


def compiled_programs() -> Path:
    """The folder of what JAX compiles."""
    return Path(os.environ["XDG_CACHE_HOME"]) / "compiled"


def tidy_up(damaged: bool) -> None:
    """A temporary folder goes with the run, and so does a folder in which an entry was damaged."""
    if FIRST_PROCESS and TEMPORARY:
        shutil.rmtree(os.environ["XDG_CACHE_HOME"], ignore_errors=True)
    elif FIRST_PROCESS and damaged:  # JAX does not write an entry again
        shutil.rmtree(compiled_programs(), ignore_errors=True)
