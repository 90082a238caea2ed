"""The command line of the benchmarks: lists them, or reads the options of one and runs it."""

import argparse
import ast
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from benchmarks.process import ROOT, set_up
from benchmarks.registry import BENCHMARKS, Benchmark

SHARED = ("name", "quick", "output", "allow_uncommitted")


def main(arguments: Sequence[str] | None = None) -> None:
    """List the benchmarks, or run the one that is named."""
    chosen = parser().parse_args(arguments)
    if chosen.name is None:
        print("\n".join(map(listing, BENCHMARKS)))
        return
    benchmark = next(one for one in BENCHMARKS if one.name == chosen.name)
    set_up(benchmark.one_core)
    from benchmarks.output import Output, refusal

    if not (chosen.quick or chosen.allow_uncommitted) and (why := refusal()):
        print(f"{benchmark.name}: {why}", file=sys.stderr)
        raise SystemExit(2)
    options = {name: value for name, value in vars(chosen).items() if name not in SHARED and value is not None}
    import_module(benchmark.module_name).run(Output(chosen.output, chosen.quick), **options)


def listing(benchmark: Benchmark) -> str:
    """Name, minutes, question and results of a benchmark, as lines of text."""
    full, quick = (f"{minutes:g}" for minutes in benchmark.minutes)
    results = ", ".join(benchmark.files) or "keeps no result"
    return f"{benchmark.name}  {full} min, quick {quick} min\n    {benchmark.question}\n    {results}"


def parser() -> argparse.ArgumentParser:
    """The command line: the shared options, and those of each benchmark."""
    main_parser = argparse.ArgumentParser("python -m benchmarks", description="Without a name, lists all benchmarks.")
    names = main_parser.add_subparsers(dest="name", metavar="NAME", title="benchmarks")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--quick", action="store_true", help="small and inaccurate, into files named _quick")
    default = ROOT / "benchmarks" / "results"
    shared.add_argument("--output", type=Path, default=default, help="folder [default: benchmarks/results]")
    shared.add_argument(
        "--allow-uncommitted", action="store_true", help="write results although the tree has uncommitted changes"
    )
    for benchmark in BENCHMARKS:
        one = names.add_parser(
            benchmark.name,
            parents=[shared],
            help=benchmark.question.replace("%", "%%"),
            description=module_docstring(benchmark),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for option in benchmark.options:
            if option.kind is bool:
                one.add_argument(option.name, action="store_true", help=option.help)
            else:
                place = {} if option.name.startswith("-") else {"nargs": "?"}
                one.add_argument(option.name, type=option.kind, choices=option.choices, help=option.help, **place)
    return main_parser


def module_docstring(benchmark: Benchmark) -> str:
    """The docstring of the module, read from its source: importing it would start JAX."""
    source = (ROOT / benchmark.module_name.replace(".", "/")).with_suffix(".py")
    return ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""


if __name__ == "__main__":
    main()
