"""Software and hardware of a run: versions, commit, processor, cores, memory, devices and precision."""

import hashlib
import os
import platform
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path


def versions(packages: Iterable[str]) -> dict[str, str]:
    """The installed versions of packages, by name."""
    return {name: version(name) for name in packages}


def commit() -> str:
    """The commit of the repository that this package runs from; empty outside a repository."""
    folder = Path(__file__).parents[1]
    if not (folder / ".git").exists():
        return ""
    with suppress(OSError):
        command = ["git", "-C", str(folder), "describe", "--always", "--dirty"]
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    return ""


def system() -> str:
    """Operating system and architecture."""
    return f"{platform.system()} {platform.machine()}"


def processor() -> str:
    """The model of the processor, or "unknown"."""
    names = [line.split(":", 1)[1].strip() for line in processor_lines() if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def processor_features() -> str:
    """The list of the processor's instruction sets; its name on systems without such a list."""
    features = (line for line in processor_lines() if line.startswith(("flags", "Features")))
    return next(features, platform.processor())


def processor_kind() -> str:
    """A name for folders of compiled programs: processors with the same instruction sets have the same."""
    return hashlib.sha256(processor_features().encode()).hexdigest()[:12]


def processor_lines() -> list[str]:
    """Lines of ``/proc/cpuinfo``; empty on systems without this file."""
    information = Path("/proc/cpuinfo")
    return information.read_text().splitlines() if information.is_file() else []


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory() -> str:
    """The memory of the machine in GiB, or "unknown"."""
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    except (AttributeError, ValueError, OSError):
        return "unknown"


def devices() -> list[str]:
    """Platform and kind of each JAX device; RuntimeError if there is none, or if a driver does not answer."""
    import jax

    try:
        return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    except (RuntimeError, AssertionError) as failure:  # JAX asserts that a platform it was asked for is there
        why = " ".join(str(failure).split()).partition(" (set JAX_PLATFORMS")[0].rstrip(".")
        raise RuntimeError(why or f"none is there for JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS')}") from failure


def precision() -> str:
    """The precision of JAX: float64 or float32."""
    import jax

    return "float64" if jax.config.read("jax_enable_x64") else "float32"
