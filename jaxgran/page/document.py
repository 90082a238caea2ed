"""One file for a browser: Plotly, scripts, style and data in a page that asks for nothing else.

Names and attributes of a file are text to a page, never markup. The data stand in it as JSON whose
``<``, ``>`` and ``&`` are escaped. The scripts put them into the page by ``textContent``. And the
page forbids itself every request.
"""

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from jaxgran.files import atomic_write
from jaxgran.model.checks import InputError

_ESCAPED = {ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&"}
_FRAME = 'style="width: 100%; height: 1000px; border: 0"'  # of a page in a notebook
_MARK = re.compile(r"\{\{(\w+)\}\}")
_SCRIPTS = ("charts.js", "grains.js", "map.js")


@dataclass(frozen=True)
class Page:
    """A page for a browser. A notebook shows it if it is the last line of a cell."""

    text: str

    def save(self, path: str | Path) -> None:
        """Write the page to a file, whole or not at all."""
        with atomic_write(Path(path)) as temporary:
            temporary.write_text(self.text, encoding="utf-8")

    def __repr__(self) -> str:
        return f"Page({len(self.text) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        return f'<iframe title="jaxgran" {_FRAME} srcdoc="{html.escape(self.text)}"></iframe>'


def document(data: Mapping[str, Any]) -> Page:
    """The page of a map, from the template, the style and the scripts beside this file.

    Args:
      data: what the scripts read, in types of JSON.

    Raises:
      InputError: (a ValueError) Plotly is not installed.
    """
    parts = {
        "title": html.escape(data["title"]),
        "style": _text("page.css"),
        "data": json.dumps(data, separators=(",", ":"), allow_nan=False).translate(_ESCAPED),
        "library": _library(),
        "script": "\n".join(_text(script) for script in _SCRIPTS),
    }
    return Page(_MARK.sub(lambda mark: parts[mark[1]], _text("map.html")))


def _library() -> str:
    """Plotly in the browser, compressed and as text: a third of its size."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise InputError("a page needs Plotly: pip install 'jaxgran[explore]'.") from None
    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()


def _text(name: str) -> str:
    """The content of a file beside this one."""
    return files("jaxgran.page").joinpath(name).read_text(encoding="utf-8")
