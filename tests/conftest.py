"""How the tests start: see ``compiled_programs``, and ``shared_flows`` for what they share."""

import gc
import os
import sys
from contextlib import suppress

import compiled_programs
import pytest

compiled_programs.set_up()
os.environ.pop("COLUMNS", None)  # the processes of xdist are told a width, and tables would have it

CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []  # of the whole run; on Linux
damaged = []  # reports of compiled programs that could not be read


def keep_to_one_core():
    """Give each process of xdist one core, where each core has one: what XLA hands from core to core costs a tenth."""
    number, count = (int(os.environ[f"PYTEST_XDIST_WORKER{end}"].removeprefix("gw")) for end in ("", "_COUNT"))
    if len(CORES) <= count:
        os.sched_setaffinity(0, {CORES[number % len(CORES)]})


@pytest.fixture
def all_cores():
    """Processes that are started here may use every core."""
    if CORES:
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, CORES)
    yield
    if CORES:
        os.sched_setaffinity(0, before)


def pytest_configure(config: pytest.Config):
    """Load what tests share, but not in a process that leaves the tests to others: it takes two seconds."""
    with suppress(ImportError):  # a name of pytest's own; to look for garbage five times at the end takes four seconds
        from _pytest.unraisableexception import gc_collect_iterations_key

        config.stash[gc_collect_iterations_key] = 1
    if CORES and hasattr(config, "workerinput"):
        keep_to_one_core()
    left_to_others = config.getoption("dist", "no") != "no" and not config.option.collectonly
    if hasattr(config, "workerinput") or not left_to_others:
        config.pluginmanager.import_plugin("shared_flows")


def pytest_collection_finish():
    """Fits are optimised. What is imported stays: to look through it for garbage would take a fifth of a run."""
    collision_model = sys.modules.get("jaxgran.inference.collision_model")
    if collision_model is not None:  # tests of fits would take twice the time
        collision_model._best_unknowns = compiled_programs.optimised(collision_model._best_unknowns)
        collision_model._CHUNK = 64  # most fits have few collisions, and a part of a chunk takes as long as a whole one
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


def pytest_warning_recorded(warning_message):
    """Such a program is compiled again, and the folder goes at the end."""
    if compiled_programs.DAMAGED in str(warning_message.message):
        damaged.append(warning_message)


def pytest_unconfigure():
    compiled_programs.tidy_up(bool(damaged))
