"""Software and hardware of this process: versions, commit, processor, cores, devices, precision."""

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


def processor(*entries: str) -> str:
    """The model of the processor, or another entry of ``/proc/cpuinfo``, the first of these names;
    where there is none, the name of the processor, or "unknown".
    """
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(entries or "model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def usable_cores(root: Path = Path("/")) -> int:
    """Number of cores that this process may use: those of its affinity, or fewer where a control
    group, such as that of a container, has a quota of processor time.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    with suppress(OSError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)  # no controllers: version 2
            version_1 = "cpu" in controllers.split(",")
            group = root / "sys/fs/cgroup" / ("cpu" if version_1 else "") / path.strip("/")
            for folder in (group, *group.parents):
                cores = min(cores, _cores_of_quota(folder))
    return math.ceil(cores)


def _cores_of_quota(folder: Path) -> float:
    """What the quota of a control group, of version 2 or 1, is worth; infinite without one."""
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        with suppress(OSError, ValueError):  # no quota is "max" or -1
            quota, period = map(int, " ".join((folder / x).read_text() for x in names).split())
            if quota > 0:
                return quota / period
    return math.inf


def usable_threads() -> int:
    """Number of threads for the replicas of a batch: ``NUMBA_NUM_THREADS``, or one for each usable
    core.
    """
    threads = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(threads) if threads.isdigit() and int(threads) else usable_cores()


def devices() -> list[str]:
    """Platform and kind of each JAX device; RuntimeError if JAX finds none."""
    import jax

    try:
        return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    except (RuntimeError, AssertionError) as error:  # JAX asserts that a requested platform exists
        message = " ".join(str(error).split()).rstrip(".")
        raise RuntimeError(
            message or f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS')} has none"
        ) from error


def default_device() -> Any:
    """The device that JAX computes on by default."""
    import jax

    device = jax.config.values["jax_default_device"]  # set by ``jax.default_device``
    return jax.devices(device)[0] if device is None or isinstance(device, str) else device


def on_processor() -> bool:
    """Whether JAX computes on a processor by default, and not on an accelerator.

    On a processor each replica of a batch advances by itself. On an accelerator the engine ``Jax``
    advances a batch in lockstep, as one array program that waits for its slowest replica.
    """
    return default_device().platform == "cpu"


def precision() -> str:
    """JAX's default floating-point type: float64 or float32."""
    import jax.numpy as jnp

    return str(jnp.dtype(jnp.result_type(float)))
