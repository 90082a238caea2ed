"""Where a benchmark writes: JSON with what it was measured with, pictures beside it, and a tree
without changes.
"""

import json
import os
import platform
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks import ROOT
from jaxgran import environment
from jaxgran.plotting.style import FILE_DPI, write

RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = ("jaxgran", "jax", "jaxlib", "numpy", "numba")


def uncommitted() -> list[str]:
    """Files of the checkout that differ from its commit, other than results; none where this is no
    checkout.
    """
    if not (ROOT / ".git").exists():
        return []
    command = ["git", "status", "--porcelain", "--", ".", ":(exclude)benchmarks/results"]
    lines = subprocess.run(command, capture_output=True, text=True, cwd=ROOT).stdout.splitlines()
    return [line[3:] for line in lines]


def rounded(value: Any, digits: int) -> Any:
    """The numbers to some digits, anywhere within lists and dictionaries."""
    if isinstance(value, dict):
        return {name: rounded(x, digits) for name, x in value.items()}
    if isinstance(value, list):
        return [rounded(x, digits) for x in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _without_nan(x) for name, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(x) for x in value]
    return None if isinstance(value, float) and value != value else value


def refusal(quick: bool) -> str | None:
    """Why the committed results cannot be replaced, and what to do; None where they can."""
    if quick:
        return "a quick run replaces no results: leave out --quick or --replace."
    changed = uncommitted()
    if not changed:
        return None
    others = f" and {len(changed) - 1} more" if changed[1:] else ""
    return (
        f"the tree has uncommitted changes ({changed[0]}{others}): commit them, or leave out "
        "--replace."
    )


def hardware() -> dict[str, str | int]:
    """Processor, system, versions and commit, for the head of a JSON file of results."""
    commit = environment.commit().removesuffix("-dirty")
    return {
        "processor": environment.processor(),
        "cores": os.cpu_count() or 0,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **environment.versions(PACKAGES),
        "commit": f"{commit}-dirty" if uncommitted() else commit,
    }


@dataclass(frozen=True)
class Output:
    """The folder of the results of one run, and what they are measured with, as it was when the run
    began.

    The names of the files of a quick run contain ``_quick``, so that they are never taken for
    results.
    """

    folder: Path
    quick: bool
    hardware: dict[str, str | int] = field(default_factory=hardware)

    @property
    def replaces(self) -> bool:
        """Whether the committed results are replaced."""
        return self.folder == RESULTS and not self.quick

    def path(self, name: str, ending: str) -> Path:
        """The file of a name and an ending, such as ``stability`` and ``_variants.png``; its folder
        exists.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / f"{name}{'_quick' if self.quick else ''}{ending}"

    def unfinished(self, name: str) -> Path | None:
        """The folder that keeps what is done of a long result on this hardware, until the result is
        written; None for a quick run and from a changed tree.
        """
        kept = not self.quick and not str(self.hardware["commit"]).endswith("-dirty")
        measured_with = sha256(json.dumps(self.hardware).encode()).hexdigest()[:16]
        return self.path(f".unfinished-{name}-{measured_with}", "") if kept else None

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a result below the hardware, to which the content may add: rows one to a line; what
        is not a number is null.
        """
        dumps, parts = partial(json.dumps, ensure_ascii=False, allow_nan=False), []
        for key, value in _without_nan({"hardware": self.hardware, **content}).items():
            text = dumps(value, indent=1).replace("\n", "\n ")
            if isinstance(value, list) and value and isinstance(value[0], dict):
                text = "[\n  " + ",\n  ".join(map(dumps, value)) + "\n ]"
            parts.append(f' "{key}": {text}')
        file, unfinished = self.path(name, ".json"), self.unfinished(name)
        file.write_text("{\n" + ",\n".join(parts) + "\n}\n", "utf-8")
        if unfinished is not None:
            shutil.rmtree(unfinished, ignore_errors=True)

    def write_picture(self, figure: Figure, name: str, ending: str = ".png") -> None:
        """Write a figure as PNG."""
        write(figure, self.path(name, ending), FILE_DPI, caption=False)
