"""What a result was measured with: processor, versions and commit; and its file."""

import json
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


def json_with_rows(head: dict, name: str, rows: list[dict]) -> str:
    """JSON text of a result with many rows, one to a line; what is not a number is null."""
    lines = ",\n".join(
        "  " + json.dumps({k: None if v != v else v for k, v in row.items()}, ensure_ascii=False, allow_nan=False)
        for row in rows
    )
    return json.dumps(head, indent=1, ensure_ascii=False)[:-2] + f',\n "{name}": [\n{lines}\n ]\n}}\n'
