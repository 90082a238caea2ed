"""Software and hardware of this process: versions, commit, processor, cores, memory, devices,
precision.
"""

import hashlib
import math
import os
import platform
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Installed versions by package name."""
    return {name: version(name) for name in packages}


def commit() -> str:
    """Git commit of the repository that the package is imported from; "" outside a repository."""
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
    names = [
        line.split(":", 1)[1].strip() for line in processor_lines() if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or "unknown"


def processor_features() -> str:
    """The instruction sets of the processor; its name where the system does not list them."""
    features = (line for line in processor_lines() if line.startswith(("flags", "Features")))
    return next(features, platform.processor())


def processor_kind() -> str:
    """A short hash of the instruction sets, which names the cache folder of a kind of processor."""
    return hashlib.sha256(processor_features().encode()).hexdigest()[:12]


def processor_lines() -> list[str]:
    """Lines of ``/proc/cpuinfo``; empty on systems without this file."""
    information = Path("/proc/cpuinfo")
    return information.read_text().splitlines() if information.is_file() else []


def usable_cores(root: Path = Path("/sys/fs/cgroup")) -> int:
    """Number of cores that this process may use: those of its affinity, or fewer where a control
    group, such as that of a container, has a quota of processor time.
    """
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
    with suppress(OSError, ValueError):
        own = Path("/proc/self/cgroup").read_text().rpartition("::")[2].strip().strip("/")
        for folder in (root / own, *(root / own).parents):
            if root not in (folder, *folder.parents):
                break
            with suppress(OSError):
                quota, period = (folder / "cpu.max").read_text().split()
                if quota != "max":
                    cores = list(cores)[: max(1, math.ceil(int(quota) / int(period)))]
    return len(cores) or os.cpu_count() or 1


def usable_threads() -> int:
    """Number of threads for the replicas of a batch: ``NUMBA_NUM_THREADS``, or one for each usable
    core.
    """
    asked = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) else usable_cores()


def memory() -> str:
    """Total memory in GiB, or "unknown"."""
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB"
    except (AttributeError, ValueError, OSError):
        return "unknown"


def devices() -> list[str]:
    """Platform and kind of each JAX device; RuntimeError if JAX finds none."""
    import jax

    try:
        return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    except (
        RuntimeError,
        AssertionError,
    ) as failure:  # JAX asserts that a requested platform exists
        message = " ".join(str(failure).split()).rstrip(".")
        raise RuntimeError(
            message or f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS')} has none"
        ) from failure


def random_bits() -> str:
    """The generator of random numbers, on whose flags in JAX the numbers depend."""
    import jax

    partitionable: bool = jax.config.jax_threefry_partitionable  # type: ignore[attr-defined]
    return "threefry2x32" if partitionable else "threefry2x32, not partitionable"


def default_device() -> Any:
    """The device that JAX computes on by default."""
    import jax

    # set by ``jax.default_device``
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    return jax.devices(device)[0] if device is None or isinstance(device, str) else device


def precision() -> str:
    """JAX's default floating-point type: float64 or float32."""
    import jax.numpy as jnp

    return str(jnp.dtype(jnp.result_type(float)))
