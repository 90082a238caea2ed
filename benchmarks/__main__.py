"""The command line of the benchmarks: lists them, or reads the options of one and runs it."""

import argparse
import ast
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from benchmarks.process import ROOT, set_up
from benchmarks.registry import BENCHMARKS, Benchmark

SHARED = ("name", "quick", "output", "replace")


def main(arguments: Sequence[str] | None = None) -> None:
    """List the benchmarks, or run the one that is named."""
    chosen = parser().parse_args(arguments)
    if chosen.name is None:
        print("\n".join(map(listing, BENCHMARKS)))
        return
    if chosen.name == "draw":
        from benchmarks.draw import redraw

        redraw(chosen.pictures, chosen.output)
        return
    benchmark = next((known for known in BENCHMARKS if known.name == chosen.name), None)
    set_up(benchmark is not None and benchmark.one_core)
    from benchmarks.output import RESULTS, Output, refusal

    if chosen.replace:
        if why := refusal(chosen.quick):
            print(f"{chosen.name}: {why}", file=sys.stderr)
            raise SystemExit(2)
        chosen.output = RESULTS
    if benchmark is None:
        raise SystemExit(run_all(chosen))
    options = {
        name: value
        for name, value in vars(chosen).items()
        if name not in SHARED and value is not None
    }
    import_module(benchmark.module_name).run(Output(chosen.output, chosen.quick), **options)


def run_all(chosen: argparse.Namespace) -> int:
    """Run every benchmark in a process of its own; 1 if one of them fails.

    What is done is noted beside the results with the commit, so that a second call goes on where
    the first one ended.
    """
    from benchmarks.output import hardware

    state = f"{'quick ' if chosen.quick else ''}{hardware()['commit']}"
    output = chosen.output.resolve()
    output.mkdir(parents=True, exist_ok=True)
    ledger = output / ".all"
    done = set(ledger.read_text().splitlines()) if ledger.exists() else set()
    flags = [f"--{name}" for name in ("quick", "replace") if getattr(chosen, name)]
    failed = 0
    for benchmark in BENCHMARKS:
        note = f"{state} {benchmark.name}"
        if note in done:
            continue
        print(f"{benchmark.name}: {benchmark.question}", flush=True)
        start = time.perf_counter()
        command = [
            sys.executable,
            "-m",
            "benchmarks",
            benchmark.name,
            "--output",
            str(output),
            *flags,
        ]
        code = subprocess.run(command, cwd=ROOT).returncode
        print(
            f"{benchmark.name}: status {code}, {(time.perf_counter() - start) / 60:.1f} minutes",
            flush=True,
        )
        failed |= code != 0
        if not (code or state.endswith("-dirty")):
            with ledger.open("a") as file:
                file.write(f"{note}\n")
    return int(failed)


def listing(benchmark: Benchmark) -> str:
    """Name, minutes, question and results of a benchmark, as lines of text."""
    full, quick = (f"{minutes:g}" for minutes in benchmark.minutes)
    results = ", ".join(benchmark.files) or "keeps no result"
    return (
        f"{benchmark.name}  {full} min, quick {quick} min\n    {benchmark.question}\n    {results}"
    )


def parser() -> argparse.ArgumentParser:
    """The command line: the shared options, and those of each benchmark."""
    main_parser = argparse.ArgumentParser(
        "python -m benchmarks", description="Without a name, lists all benchmarks."
    )
    names = main_parser.add_subparsers(dest="name", metavar="NAME", title="benchmarks")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--quick", action="store_true", help="small and inaccurate, into files named _quick"
    )
    shared.add_argument(
        "--output",
        type=Path,
        default=ROOT / "benchmarks" / "scratch",
        help="folder [default: benchmarks/scratch, which is not committed]",
    )
    shared.add_argument(
        "--replace",
        action="store_true",
        help="replace the committed results in benchmarks/results; the tree must have no "
        "uncommitted changes, so that each result names a commit that exists",
    )
    about = "run all of them, one after the other; a second call goes on where the first one ended"
    names.add_parser("all", parents=[shared], help=about, description=about)
    about = "draw the figures of the committed results again, without a measurement"
    draw = names.add_parser("draw", help=about, description=about)
    draw.add_argument(
        "pictures", nargs="*", metavar="PICTURE", help="name without .png [default: all]"
    )
    draw.add_argument(
        "--output",
        type=Path,
        default=ROOT / "benchmarks" / "results",
        help="folder [default: benchmarks/results]",
    )
    for benchmark in BENCHMARKS:
        subparser = names.add_parser(
            benchmark.name,
            parents=[shared],
            help=benchmark.question.replace("%", "%%"),
            description=module_docstring(benchmark),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for option in benchmark.options:
            subparser.add_argument(
                option.name, type=option.kind, choices=option.choices, help=option.help
            )
    return main_parser


def module_docstring(benchmark: Benchmark) -> str:
    """The docstring of the module, read from its source: importing it would start JAX."""
    source = (ROOT / benchmark.module_name.replace(".", "/")).with_suffix(".py")
    return ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""


if __name__ == "__main__":
    main()
