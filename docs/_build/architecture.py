"""The drawing of the folders of ``jaxgran`` and of the imports between them, made from the code.

Every folder is a box. The rows are those that ``lint-imports`` checks (``pyproject.toml``). A line
leaves a box to the right, and goes down into each folder that it imports; the number at the corner
says how many files of the upper folder import the lower one. No import goes up, so the lower left
of the drawing stays empty, and no line crosses a box.

    python docs/_build/architecture.py                # writes architecture.svg here
    python docs/_build/architecture.py drawing.png
"""

import ast
import sys
import tomllib
from collections import Counter
from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "jaxgran"
_BAND, _WIDTH, _HEIGHT = 1.0, 0.96, 0.62  # distance of two boxes, and the size of a box
_LINE, _NUMBER = "0.35", 7.0


def rows() -> list[list[str]]:
    """The rows of folders, the highest first, as the contract of the imports names them."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract = next(x for x in settings["tool"]["importlinter"]["contracts"] if "layers" in x)
    return [[name.strip() for name in layer.split("|")] for layer in contract["layers"]]


def imports() -> Counter[tuple[str, str]]:
    """How many files of one folder import another folder, for all pairs of folders that do."""
    found: Counter[tuple[str, str]] = Counter()
    for path in sorted(PACKAGE.rglob("*.py")):
        importer = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if not importer.startswith("__"):
            found.update(
                (importer, imported) for imported in _imported(path) if imported != importer
            )
    return found


def _imported(path: Path) -> set[str]:
    """The folders of the package that a file imports, inside functions too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    parts = [name.split(".") for name in names if name.startswith("jaxgran.")]
    return {
        part[1]
        for part in parts
        if (PACKAGE / part[1]).is_dir() or (PACKAGE / f"{part[1]}.py").is_file()
    }


def drawing() -> Figure:
    """The folders from top left to bottom right, and the imports between them."""
    ordered, arrows = rows(), imports()
    place = {name: k for k, name in enumerate(name for row in ordered for name in row)}
    unknown = sorted({name for arrow in arrows for name in arrow} - set(place))
    if unknown:
        raise ValueError(
            f"the contract of the imports in pyproject.toml names no row for {', '.join(unknown)}."
        )
    upward = [f"{upper} → {lower}" for upper, lower in arrows if place[upper] > place[lower]]
    if upward:
        raise ValueError(f"these imports go up, and cannot be drawn: {', '.join(upward)}.")
    count = len(place)
    figure = Figure(figsize=(0.76 * count + 0.3, 0.52 * count + 0.3), layout="constrained")
    axes = figure.add_subplot()
    first = 0
    for k, row in enumerate(ordered):
        top, bottom = -(first - 0.5) * _BAND, -(first + len(row) - 0.5) * _BAND
        axes.axhspan(bottom, top, color="0.93" if k % 2 else "0.98", lw=0, zorder=0)
        first += len(row)
    for name, k in place.items():
        _draw_box(axes, name, k)
        _draw_imports(
            axes,
            k,
            {place[lower]: number for (upper, lower), number in arrows.items() if upper == name},
        )
    axes.set_xlim(-0.5, count - 0.5)
    axes.set_ylim(-(count - 0.5) * _BAND, 0.5 * _BAND)
    axes.set_axis_off()
    return figure


def _draw_box(axes: Axes, name: str, k: int) -> None:
    corner = (k - _WIDTH / 2, -k * _BAND - _HEIGHT / 2)
    axes.add_patch(
        FancyBboxPatch(
            corner, _WIDTH, _HEIGHT, "round,pad=0,rounding_size=0.08", fc="white", ec="black"
        )
    )
    axes.text(k, -k * _BAND, name, ha="center", va="center", fontsize=7.5)


def _draw_imports(axes: Axes, k: int, imported: dict[int, int]) -> None:
    """A line from the box to the right, and an arrow down into each box that is imported."""
    if not imported:
        return
    y = -k * _BAND
    axes.plot([k + _WIDTH / 2, max(imported)], [y, y], color=_LINE, lw=0.8, zorder=1)
    for lower, number in imported.items():
        tip = -lower * _BAND + _HEIGHT / 2
        arrow = {
            "arrowstyle": "-|>",
            "color": _LINE,
            "lw": 0.8,
            "shrinkA": 0,
            "shrinkB": 0,
            "mutation_scale": 8,
        }
        axes.annotate("", (lower, tip), (lower, y), arrowprops=arrow, zorder=1)
        circle = {"boxstyle": "circle,pad=0.25", "fc": "white", "ec": _LINE, "lw": 0.6}
        axes.text(
            lower, y, str(number), ha="center", va="center", fontsize=_NUMBER, bbox=circle, zorder=3
        )


def picture(suffix: str = "svg") -> bytes:
    """The drawing as the content of a file; the same code gives the same bytes."""
    content = BytesIO()
    with rc_context({"svg.hashsalt": "architecture"}):
        drawing().savefig(
            content, format=suffix, dpi=200, metadata={"Date": None} if suffix == "svg" else None
        )
    return content.getvalue()


if __name__ == "__main__":
    file = Path(sys.argv[1] if len(sys.argv) > 1 else "architecture.svg")
    file.write_bytes(picture(file.suffix.lstrip(".")))
