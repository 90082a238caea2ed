"""The command ``info``: versions and hardware for a bug report."""

import os
import platform
import shutil

from jaxgran import environment
from jaxgran.cli.terminal import configured_jax

INFO_EXAMPLES = {"For a bug report": "jaxgran info"}
_PACKAGES = ("jax", "jaxlib", "jax-md", "numba", "numpy", "scipy", "xarray", "h5netcdf", "gsd", "matplotlib")
_SETTINGS = ("JAX_", "XLA_", "OMP_", "CUDA_VISIBLE_DEVICES")  # first letters of environment variables that change runs


def info_command() -> None:
    """Print versions, processor, devices and folders for a bug report."""
    jax = configured_jax()
    lines = {
        "jaxgran": environment.versions(["jaxgran"])["jaxgran"] + _commit(),
        "python": platform.python_version(),
        **environment.versions(_PACKAGES),
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": environment.processor(),
        "cores": f"{os.cpu_count()}, of which this process may use {environment.usable_cores()}",
        "memory": environment.memory(),
        "devices": _devices(),
        **_engine(),
        "precision": environment.precision(),
        "ffmpeg": shutil.which("ffmpeg") or "none",
        "settings": ", ".join(f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(_SETTINGS)) or "none",
        "compilation cache": jax.config.values["jax_compilation_cache_dir"],
    }
    for name, value in lines.items():
        print(f"{name:18s} {value}")


def _commit() -> str:
    found = environment.commit()
    return f", commit {found}" if found else ""


def _devices() -> str:
    try:
        return ", ".join(environment.devices())
    except RuntimeError as failure:  # the report is needed most if a driver does not answer
        return f"none: {' '.join(str(failure).split())}"


def _engine() -> dict[str, str]:
    from jaxgran.dynamics.engine import select_engine, solver_in_use
    from jaxgran.model.flow import ShearFlow

    flow = ShearFlow(grains=256, restitution=0.5, packing_fraction=0.7, timestep=1e-3)
    try:
        engine = select_engine(flow)
    except RuntimeError:  # there is no device
        return {"engine": "none", "solver": "none"}
    return {"engine": f"auto takes {engine}", "solver": solver_in_use(engine, flow.solver)}
