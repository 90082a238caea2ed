"""What the numbers of a map were computed with: precision, device, platform, versions, generator of
random numbers, and a hash of the sources.
"""

import os
import platform
from collections.abc import Mapping

import jax

from jaxgran import environment
from jaxgran.cache.persistent_jit import sources_digest

_PACKAGES = ("jaxgran", "jax", "jaxlib", "jax-md", "numba", "numpy", "xarray")
DECIDING = ("jaxgran", "jax", "jaxlib", "numba", "numpy")
"""Packages on whose versions the numbers depend, bit for bit."""


def made_with() -> dict[str, str]:
    """Precision, device, platform, versions, sources and commit of this process."""
    device = environment.default_device()
    return {
        "precision": environment.precision(),
        "device": f"{device.platform}: {device.device_kind}",
        "platform": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "commit": environment.commit(),
        "code_digest": sources_digest(),
        "random_bits": random_bits(),
        **{
            f"version_{name.replace('-', '_')}": number
            for name, number in environment.versions(_PACKAGES).items()
        },
    }


def random_bits() -> str:
    """The generator of random numbers, on whose flags in JAX the numbers depend."""
    partitionable = jax.config.values["jax_threefry_partitionable"]
    return "threefry2x32" if partitionable else "threefry2x32, not partitionable"


def deciding(made: Mapping[str, str]) -> dict[str, str]:
    """The versions, sources and precision on which the numbers depend, of what ``made_with``
    returns or a file has.
    """
    names = (*(f"version_{name}" for name in DECIDING), "code_digest", "random_bits")
    known = {name: made[name] for name in names if name in made}
    return known | {"precision": made.get("precision", "")}


def code_name(made: Mapping[str, str]) -> str:
    """The code that a map was made with, in words."""
    commit = f", commit {made['commit']}" if made.get("commit") else ""
    return f"jaxgran {made.get('version_jaxgran', 'of an unknown version')}{commit}"
