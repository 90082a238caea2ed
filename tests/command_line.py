"""Runs commands of jaxgran as a user gives them, in this process or in one of their own."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
import typer.main
from made_up_maps import with_variables
from synthetic import random_replica

from jaxgran.cli import app, info, merge, outcome, run, terminal
from jaxgran.maps import results
from jaxgran.maps.replica import Advance
from jaxgran.maps.rows import SUMS
from jaxgran.model.status import Status

POINTS = ["--restitution", "0.5,0.9", "--packing-fraction", "0.6"]


# Typer makes them anew at every call, which takes longer than a mistake
commands = cache(typer.main.get_command)


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


def jaxgran(folder: Path, *arguments: str) -> Outcome:
    """Run a command in a folder, in this process, with JAX as it is set up here."""
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(StringIO()) as out,
        redirect_stderr(StringIO()) as err,
    ):
        patch.chdir(folder)
        patch.setenv("COLUMNS", "200")
        patch.setattr(sys, "argv", ["jaxgran", *arguments])
        patch.setattr(typer.main, "get_command", commands)
        for module in (info, outcome, merge, run):
            patch.setattr(module, "configured_jax", lambda: jax)
        status = terminal.exit_status(app.app)
    return Outcome(status, out.getvalue(), err.getvalue())


def in_a_process(folder: Path, *arguments: str) -> Outcome:
    """Run a command as its user would, in a process of its own."""
    command = [sys.executable, "-c", "from jaxgran.cli.app import program; program()", *arguments]
    environment = {
        name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"
    }  # set by JAX
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    return Outcome(done.returncode, done.stdout, done.stderr)


def made_up_replicas(
    statuses: dict[tuple[int, int], Status], end: type[BaseException] | None = None
) -> Callable:
    """A stand-in for the sweep: replicas of given statuses, and then perhaps an exception."""

    def replicas(settings, missing, workers, report, *_, **__) -> Iterator:
        rng = np.random.default_rng(0)
        for (point, seed), status in statuses.items():
            replica = random_replica(rng, settings, status, point, seed)
            if replica.id in missing:
                report(Advance([replica.id], [1e-3], [100.0]))
                yield replica
        if end is not None:
            raise end

    return replicas


def write_few_variables(patch: pytest.MonkeyPatch, *more: str) -> None:
    """Files of maps have the ratios and what is named; all variables take a second or two."""
    whole, names = results.write_dataset, ("force_ratio", "stress_ratio", *more)
    kept = {
        f"{name}{end}"
        for name in names
        for end in ("", "_stderr", "_large_system", "_large_system_ci95")
    }
    kept |= {"status", *(f"sums/{name}" for name in SUMS)}
    patch.setattr(
        results, "write_dataset", lambda data, path: whole(with_variables(data, *kept), path)
    )


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def assert_one_sentence(outcome: Outcome) -> None:
    assert outcome.status == 2
    assert outcome.out == ""
    sentence = outcome.err.rpartition("\n\n")[2]  # Typer names the help before its sentence
    assert sentence.startswith(("Error: ", "jaxgran: "))
    assert sentence.endswith((".\n", ")\n", "?\n"))
    assert sentence.count("\n") == 1
