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
    **{
        name: f"cache, {name}"
        for name in ("cache folder", "compiled programs", "numba engine", "figures")
    },
}
_PACKAGES = (
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
)
_SETTINGS = (
    "JAX_",
    "XLA_",
    "OMP_",
    "CUDA_VISIBLE_DEVICES",
)  # first letters of environment variables that change runs


def run_info_command(json: bool = False) -> None:
    configured_jax()
    lines = {
        "jaxgran": environment.versions(["jaxgran"])["jaxgran"] + _commit(),
        "python": platform.python_version(),
        **environment.versions(_PACKAGES),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": environment.processor(),
        "cores": f"{os.cpu_count()}, of which this process may use {environment.usable_cores()}",
        "memory": environment.memory(),
        **_devices(),
        "precision": environment.precision(),
        "ffmpeg": shutil.which("ffmpeg") or "none",
        "settings": ", ".join(
            f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(_SETTINGS)
        )
        or "none",
        **_caches(),
    }
    if json:
        entries = {
            name: Entry(value, _MEANINGS.get(name, name), None) for name, value in lines.items()
        }
        print_json({name.replace(" ", "_"): entry for name, entry in entries.items()})
        return
    for name, value in lines.items():
        print(f"{name:18s} {value}")


info_command = command({"json": JSON}, run_info_command)


def _commit() -> str:
    found = environment.commit()
    return f", commit {found}" if found else ""


def _devices() -> dict[str, str]:
    """The devices, and the engine and solver that "auto" takes there."""
    try:
        found = environment.devices()
    except RuntimeError as failure:  # the report is needed most if there is none
        return {"devices": f"none: {failure}", "engine": "none", "solver": "none"}
    from jaxgran.dynamics.engine import DEFAULT_NUMERICS, select_engine, solver_in_use
    from jaxgran.model.flow import ShearFlow

    flow = ShearFlow(grains=256, restitution=0.5, packing_fraction=0.7, timestep=1e-3)
    engine = select_engine(flow, DEFAULT_NUMERICS)
    solver = solver_in_use(engine, DEFAULT_NUMERICS.solver)
    return {"devices": ", ".join(found), "engine": f"auto takes {engine.name}", "solver": solver}


def _caches() -> dict[str, str]:
    """The folders of caches, and whether files can be written there."""
    import matplotlib

    from jaxgran.dynamics.numba_engine.ffi import object_file

    folders = {
        "cache folder": users_folder(),
        "compiled programs": programs_folder(),
        "numba engine": object_file().parent,
        "figures": Path(matplotlib.get_cachedir()),
    }
    return {
        name: "none" if folder is None else f"{folder}, {_state(folder)}"
        for name, folder in folders.items()
    }


def _state(folder: Path) -> str:
    why = why_unwritable(folder)
    return f"cannot be written ({why})" if why else "works"
