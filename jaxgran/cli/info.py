"""The command ``info``: what a report of a bug needs."""

import os
import platform
import shutil
from importlib.metadata import version

from jaxgran.cli.terminal import configured_jax, processor_lines

INFO_EXAMPLES = {"For a bug report": "jaxgran info"}
_PACKAGES = ("jax", "jaxlib", "jax-md", "numba", "numpy", "scipy", "xarray", "h5netcdf", "gsd", "matplotlib")
_SETTINGS = ("JAX_", "XLA_", "OMP_", "CUDA_VISIBLE_DEVICES")  # beginnings of the names of variables that change runs


def info_command() -> None:
    """Print versions, processor, devices and folders: what a report of a bug needs."""
    jax = configured_jax()
    lines = {
        "jaxgran": version("jaxgran") + _commit(),
        "python": platform.python_version(),
        **{name: version(name) for name in _PACKAGES},
        "platform": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": _processor(),
        "cores": _cores(),
        "memory": _memory(),
        "devices": _devices(jax),
        "precision": "float64" if jax.config.read("jax_enable_x64") else "float32",
        "ffmpeg": shutil.which("ffmpeg") or "none",
        "settings": ", ".join(f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(_SETTINGS)) or "none",
        "compilation cache": jax.config.values["jax_compilation_cache_dir"],
    }
    for name, value in lines.items():
        print(f"{name:18s} {value}")


def _commit() -> str:
    from jaxgran.maps.dataset import commit

    found = commit()
    return f", commit {found}" if found else ""


def _processor() -> str:
    names = [line.split(":", 1)[1].strip() for line in processor_lines() if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def _cores() -> str:
    from jaxgran.maps.sweep import usable_cores

    return f"{os.cpu_count()}, of which this process may use {usable_cores()}"


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    except (AttributeError, ValueError, OSError):  # where the system does not tell
        return "unknown"


def _devices(jax) -> str:
    try:
        return ", ".join(f"{device.platform}: {device.device_kind}" for device in jax.devices())
    except RuntimeError as failure:  # a driver that does not answer is what the report is about
        return f"none: {' '.join(str(failure).split())}"
