"""Where a benchmark writes: JSON with what it was measured with, pictures beside it, and a tree
without changes.
"""

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
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
        """The folder that keeps what is done of a long result, that of the commit; None for a quick
        run and from a changed tree.
        """
        commit = str(self.hardware["commit"])
        kept = not self.quick and not commit.endswith("-dirty")
        return self.path(f".unfinished-{name}-{commit}", "") if kept else None

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a result below the hardware, to which the content may add: rows one to a line, in
        which what is not a number is null.
        """
        parts = []
        for key, value in {"hardware": self.hardware, **content}.items():
            text = json.dumps(value, indent=1, ensure_ascii=False).replace("\n", "\n ")
            if isinstance(value, list) and value and isinstance(value[0], dict):
                rows = ({k: None if x != x else x for k, x in row.items()} for row in value)
                lines = (json.dumps(row, ensure_ascii=False) for row in rows)
                text = "[\n  " + ",\n  ".join(lines) + "\n ]"
            parts.append(f' "{key}": {text}')
        self.path(name, ".json").write_text("{\n" + ",\n".join(parts) + "\n}\n")

    def write_picture(self, figure: Figure, name: str, ending: str = ".png") -> None:
        """Write a figure as PNG."""
        write(figure, self.path(name, ending), FILE_DPI, caption=False)
