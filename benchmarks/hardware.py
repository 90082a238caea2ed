"""What a result was measured with: processor, versions and commit."""

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path


def hardware() -> dict[str, str | int]:
    """Processor, system, versions and commit, for the head of a JSON file of results."""
    model = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.is_file():
        names = [line.split(":", 1)[1].strip() for line in information.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=Path(__file__).parent
    ).stdout.strip()
    packages = ("jaxgran", "jax", "jaxlib", "numpy", "numba")
    return {
        "processor": model,
        "cores": os.cpu_count() or 0,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
        "commit": commit,
    }
