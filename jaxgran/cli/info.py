"""The command ``info``: versions, hardware and caches for a bug report."""

import os
import platform
import shutil
from pathlib import Path

from jaxgran import environment
from jaxgran.cache.folder import programs_folder, users_folder, why_unwritable
from jaxgran.cli.options import command
from jaxgran.cli.output import JSON, Entry, print_json
from jaxgran.cli.terminal import configured_jax

INFO_EXAMPLES = {"For a bug report": "jaxgran info"}
_MEANINGS = {
    "engine": "engine that is taken where none is given",
    "solver": "solver of that engine",
    "cores": "cores of the machine, and of this process",
    "settings": "environment variables that change runs",
}
_PACKAGES = [
    "jax",
    "jaxlib",
    "jax-md",
    "numba",
    "numpy",
    "scipy",
    "xarray",
    "netCDF4",
    "gsd",
    "matplotlib",
]
_SETTINGS = ("JAX_", "XLA_", "OMP_", "CUDA_VISIBLE_DEVICES")  # how such variables begin


def run_info_command(json: bool = False) -> None:
    configured_jax()
    settings = [f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(_SETTINGS)]
    commit = environment.commit()
    lines = {
        "jaxgran": environment.versions(["jaxgran"])["jaxgran"]
        + (f", commit {commit}" if commit else ""),
        "python": platform.python_version(),
        **environment.versions(_PACKAGES),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": environment.processor(),
        "cores": f"{os.cpu_count()}, of which this process may use {environment.usable_cores()}",
        "memory": _memory(),
        **_devices(),
        "precision": environment.precision(),
        "ffmpeg": shutil.which("ffmpeg") or "none",
        "settings": ", ".join(settings) or "none",
    }
    caches = {name: _state(folder) for name, folder in _caches().items()}
    if json:
        meanings = _MEANINGS | {name: f"cache, {name}" for name in caches}
        print_json(
            {
                name.replace(" ", "_"): Entry(value, meanings.get(name, name), None)
                for name, value in (lines | caches).items()
            }
        )
        return
    for name, value in (lines | caches).items():
        print(f"{name:18s} {value}")


info_command = command({"json": JSON}, run_info_command)


def _devices() -> dict[str, str]:
    """The devices, and the engine and solver that "auto" takes there."""
    try:
        names = environment.devices()
    except RuntimeError as failure:  # the report is needed most if there is none
        return {"devices": f"none: {failure}", "engine": "none", "solver": "none"}
    from jaxgran.dynamics.engine import DEFAULT_NUMERICS, select_engine

    engine = select_engine(DEFAULT_NUMERICS)
    solver = engine.solver_in_use(DEFAULT_NUMERICS.solver)
    return {"devices": ", ".join(names), "engine": f"auto takes {engine.name}", "solver": solver}


def _caches() -> dict[str, Path | None]:
    import matplotlib

    from jaxgran.dynamics.numba_engine.ffi import engine_folder

    return {
        "cache folder": users_folder(),
        "compiled programs": programs_folder(),
        "numba engine": engine_folder().parent,
        "figures": Path(matplotlib.get_cachedir()),
    }


def _memory() -> str:
    """Total memory in GiB, or "unknown"."""
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    except (AttributeError, ValueError, OSError):
        return "unknown"


def _state(folder: Path | None) -> str:
    """A folder, and whether files can be written there."""
    if folder is None:
        return "none"
    why = why_unwritable(folder)
    return f"{folder}, " + (f"cannot be written ({why})" if why else "works")
