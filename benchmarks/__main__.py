"""The command line of the benchmarks; it sets up JAX before anything imports it.

python -m benchmarks                  # what there is
python -m benchmarks NAME [--quick]   # one of them
python -m benchmarks NAME --help      # what it measures, how long it takes, and its options
python -m benchmarks all [--quick]    # one after the other
python -m benchmarks draw [PICTURE …] # the figures of the committed results, without measuring
"""

import argparse
import ast
import inspect
import os
import subprocess
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_type_hints

from benchmarks import ROOT

FOLDER = ROOT / "benchmarks"
ONE_CORE_FLAGS = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


def main(arguments: Sequence[str] | None = None) -> None:
    """List the benchmarks, or run the one that is named."""
    name, *words = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    known = benchmarks()
    if name == "draw":
        set_up(one_core=False)
        import_module("benchmarks.draw").redraw(words)
    elif name == "all" and "--replace" in words:
        raise SystemExit("all: replace results one by one, as some are made from others.")
    elif name == "all":
        commands = ([sys.executable, "-m", "benchmarks", each, *words] for each in known)
        failed = [
            command[3] for command in commands if subprocess.run(command, cwd=ROOT).returncode
        ]
        raise SystemExit(f"failed: {', '.join(failed)}" if failed else 0)
    elif name in known:
        run(name, words)
    else:
        print(__doc__, *(f"{each}: {about}" for each, about in known.items()), sep="\n")
        raise SystemExit(0 if name in ("-h", "--help") else 2)


def benchmarks() -> dict[str, str]:
    """The first paragraph of the docstring of each benchmark, by name; read from the source, since
    importing one starts JAX.
    """
    found = {}
    for file in sorted(FOLDER.glob("*.py")):
        module = ast.parse(file.read_text(encoding="utf-8"))
        functions = [x.name for x in module.body if isinstance(x, ast.FunctionDef)]
        if file.stem != "__main__" and "run" in functions:
            paragraph, *_ = (ast.get_docstring(module) or "").split("\n\n")
            found[file.stem] = " ".join(paragraph.split())
    return found


def run(name: str, words: Sequence[str]) -> None:
    """Run a benchmark with the options of its command."""
    one_core = "\nONE_CORE = True\n" in (FOLDER / f"{name}.py").read_text(encoding="utf-8")
    set_up(one_core)
    module = import_module(f"benchmarks.{name}")
    chosen = vars(parser_of(name, module).parse_args(words))
    from benchmarks.output import RESULTS, Output, refusal

    quick, folder, replace = (chosen.pop(x) for x in ("quick", "output", "replace"))
    if replace and (why := refusal(quick)):
        raise SystemExit(f"{name}: {why}")
    given = {option: value for option, value in chosen.items() if value is not None}
    module.run(Output(RESULTS if replace else folder, quick), **given)


def set_up(one_core: bool) -> None:
    """Double precision, and where it is asked for one core, for this process and all that it
    starts.
    """
    if "jax" in sys.modules:
        raise RuntimeError("JAX has been imported before it was set up.")
    os.environ["JAX_ENABLE_X64"] = "1"
    if one_core:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {ONE_CORE_FLAGS}".strip()
        os.environ["OMP_NUM_THREADS"] = "1"


def parser_of(name: str, module: Any) -> argparse.ArgumentParser:
    """The options that all benchmarks share, and the further arguments of this one's ``run``."""
    parser = argparse.ArgumentParser(
        f"python -m benchmarks {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    quick = "small and inaccurate, into files named _quick"
    replace = "replace the committed results in benchmarks/results, from a clean working tree"
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--output", type=Path, default=FOLDER / "scratch", help="folder")
    parser.add_argument("--replace", action="store_true", help=replace)
    kinds = get_type_hints(module.run)
    for option in list(inspect.signature(module.run).parameters)[1:]:
        kind, *_ = get_args(kinds[option]) or (kinds[option],)
        flag = f"--{option.replace('_', '-')}"
        if kind is bool:
            parser.add_argument(flag, action="store_true")
        elif isinstance(kind, str):  # one of the words of a Literal
            parser.add_argument(flag, choices=get_args(kinds[option]))
        else:
            parser.add_argument(flag, type=kind)
    return parser


if __name__ == "__main__":
    main()
