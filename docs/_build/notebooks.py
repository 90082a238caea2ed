"""Notebooks as pages: their text and code, and what they showed when they were run."""

import base64
import json
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
# characters of HTML that stand in the page itself; longer HTML is a file in a frame
LONGEST = 50_000
NAMES = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]


class Shown(NamedTuple):
    """The Markdown of a notebook, and the files beside it by their names."""

    markdown: str
    files: dict[str, bytes]


def shown(name: str) -> Shown:
    """The page of a notebook of this project."""
    notebook = (ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8")
    return page_of(json.loads(notebook), name)


def page_of(notebook: dict[str, Any], name: str) -> Shown:
    """A notebook in the form of its JSON as a page; warnings are left out, as they name folders of
    a machine.
    """
    parts, files = [], {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts.extend(_output(output, f"{name}_{len(files)}", files) for output in cell["outputs"])
    return Shown("\n\n".join(part for part in parts if part), files)


def _output(output: dict[str, Any], name: str, files: dict[str, bytes]) -> str:
    """The Markdown of one output of a cell; a picture or a long text becomes a file."""
    if output["output_type"] == "stream":
        return "" if output["name"] == "stderr" else _text(output["text"])
    data = output.get("data", {})
    if "image/png" in data:
        files[f"{name}.png"] = base64.b64decode("".join(data["image/png"]))
        return f"![What the cell above draws]({name}.png)"
    html = "".join(data.get("text/html", ""))
    # xarray's needs a style sheet that the site overrides
    if html and "xr-text-repr-fallback" not in html:
        if len(html) <= LONGEST:
            return f'<div class="output">{html}</div>'
        files[f"{name}.html"] = html.encode()
        return (
            f'<iframe class="page" title="What the cell above shows" src="../{name}.html"></iframe>'
        )
    return _text(data.get("text/plain", ""))


def _text(lines: str | list[str]) -> str:
    return f"```text\n{''.join(lines).rstrip()}\n```"
