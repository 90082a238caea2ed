"""Pages whose examples run when the site is built, each block followed by its output.

The blocks of a page run in order, in a folder of their own: Python in one namespace, and commands
of ``jaxgran`` in the shell. What a block prints is shown below it, and the Matplotlib figure that
is the value of its last line.
"""

import ast
import os
import re
import shlex
import subprocess
import sys
import textwrap
from contextlib import chdir, redirect_stdout
from functools import cache
from io import BytesIO, StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
PAGES = ("tutorial.md", "reference/map-file.md")
_BLOCK = re.compile(r"^```(python|shell)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@cache
def executed(markdown: str, name: str) -> tuple[str, dict[str, bytes]]:
    """A page with outputs, and its figures by the names of their files."""
    names: dict[str, Any] = {}
    files: dict[str, bytes] = {}

    def with_output(block: re.Match[str]) -> str:
        language, code = block.groups()
        text, figure = _python(code, names) if language == "python" else (_shell(code), None)
        shown = [block[0]]
        if text:
            shown.append(f"```text\n{text.rstrip()}\n```")
        if figure:
            file = f"{name}_{len(files)}.png"
            files[file] = figure
            shown.append(f"![What the code above draws]({Path(file).name})")
        return "\n\n".join(shown)

    with TemporaryDirectory() as folder, chdir(folder):
        return _BLOCK.sub(with_output, markdown), files


def _python(code: str, names: dict[str, Any]) -> tuple[str, bytes | None]:
    """What a block prints, and the figure that its last line returns."""
    block, value = ast.parse(code), None
    last = block.body.pop() if isinstance(block.body[-1], ast.Expr) else None
    with redirect_stdout(StringIO()) as printed:
        exec(compile(block, "page", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "page", "eval"), names)
    if not isinstance(value, Figure):
        return printed.getvalue(), None
    picture = BytesIO()
    value.savefig(picture, format="png", dpi=150)
    return printed.getvalue(), picture.getvalue()


def _shell(code: str) -> str:
    """What commands of ``jaxgran`` print, in 80 columns; an error stops the build."""
    # of this checkout
    environment = os.environ | {"COLUMNS": "80", "NO_COLOR": "1", "PYTHONPATH": str(ROOT)}
    printed = []
    for words in map(shlex.split, code.replace("\\\n", " ").splitlines()):
        command = [sys.executable, "-m", *words]
        done = subprocess.run(
            command, env=environment, stdout=subprocess.PIPE, text=True, check=True
        )
        printed += [
            textwrap.fill(line, 80) if line[:1].isalpha() else line.rstrip()
            for line in done.stdout.splitlines()
        ]
    return "\n".join(printed)
