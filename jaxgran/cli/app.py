"""Command line: ``jaxgran map``, ``merge``, ``plot``, ``run`` and the others. Exit statuses:
``terminal``.
"""

import gc
import os
from typing import Annotated

import typer

# XLA logs a long error if a cached program was compiled with tuning hints. The variable must be set
# before JAX loads.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# Matrices here are small: threads of OpenBLAS, which NumPy loads, wait for each other longer than
# they calculate.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ["MPLBACKEND"] = "agg"  # figures are files, and the backend of a user may be missing here

import jaxgran
from jaxgran.cli.explore import EXPLORE_EXAMPLES, explore_command
from jaxgran.cli.info import INFO_EXAMPLES, info_command
from jaxgran.cli.map import MAP_EXAMPLES, PLOT_EXAMPLES, map_command, plot_command
from jaxgran.cli.merge import MERGE_EXAMPLES, merge_command
from jaxgran.cli.options import examples
from jaxgran.cli.output import use_plain_letters
from jaxgran.cli.run import RUN_EXAMPLES, run_command
from jaxgran.cli.terminal import run_program
from jaxgran.cli.where import WHERE_EXAMPLES, where_command

EXAMPLES = {
    "Where binary collisions dominate, and where they do not": "jaxgran map",
    "One flow, with a movie of it": "jaxgran run --restitution 0.1 --packing-fraction 0.8 --movie "
    "flow.gif",
    "The options of a command": "jaxgran run --help",
}
COMMANDS = {  # with their help here, as python -OO leaves docstrings out
    "map": (map_command, "Map the force ratio over a plane of flows, and draw it.", MAP_EXAMPLES),
    "merge": (merge_command, "Merge maps of other parts, seeds or points.", MERGE_EXAMPLES),
    "plot": (plot_command, "Draw the figures of a map again.", PLOT_EXAMPLES),
    "explore": (
        explore_command,
        "Write a page to look into a map: one file for a browser.",
        EXPLORE_EXAMPLES,
    ),
    "run": (run_command, "Run one flow, and print its averages with errors.", RUN_EXAMPLES),
    "where": (
        where_command,
        "Say by how much kinetic theory errs in a flow, and why.",
        WHERE_EXAMPLES,
    ),
    "info": (info_command, "Print what a bug report needs.", INFO_EXAMPLES),
}

app = typer.Typer(
    no_args_is_help=True,
    help="Flows of rigid, frictionless discs in simple shear by contact dynamics.",
    epilog=examples(EXAMPLES),
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for name, (command, words, command_examples) in COMMANDS.items():
    app.command(name, help=words, epilog=examples(command_examples))(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"jaxgran {jaxgran.__version__}")
        raise typer.Exit


@app.callback()
def command_line(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Options before the command."""


def program() -> None:
    """The program ``jaxgran``."""
    gc.set_threshold(50_000, 20, 100)  # fewer collections: the process is short-lived
    use_plain_letters()
    run_program(app)
