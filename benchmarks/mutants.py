"""Do the tests find mistakes? Twenty are made, one at a time, in a copy of the tracked files; see ``mistakes``.

For each, the nearest tests are run in one process until one fails. If none fails, all tests are run. What is printed
and written is the first test that fails. The nearest tests are also run without a mistake: a test that fails there
finds nothing. The working tree is never changed. What unchanged code compiles to is shared by all runs.

    python -m benchmarks mutants                               # 20 minutes on two cores
    python -m benchmarks mutants --quick                       # three mistakes, and their nearest tests only
    python -m benchmarks mutants --only "sign of the tilt"     # one mistake; writes nothing
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.mistakes import MISTAKES, QUICK, Mistake
from benchmarks.output import Output
from benchmarks.process import ROOT

NEAREST_LIMIT, WHOLE_LIMIT = 1200, 3600  # seconds of one run of the tests
OWN_TEST = "tests/test_mutants.py"  # fails with every mistake, since it looks for the lines without one
NO_FAILURE = (0, 5)  # exit statuses of pytest: all passed, nothing to run
NOT_PASSED_ON = ("JAX_ENABLE_X64", "NUMBA_CACHE_DIR")  # set for benchmarks; a cache in use, which mistakes would fill
TIME_LIMIT = "the tests did not end within {} s"


def run(output: Output, only: str | None = None) -> None:
    """Make the mistakes, run the tests, print a table, and write JSON unless one mistake is chosen."""
    names = [only] if only else QUICK if output.quick else [one.name for one in MISTAKES]
    chosen = [one for one in MISTAKES if one.name in names]
    if not chosen:
        raise SystemExit(f"there is no mistake {only!r}: it must be one of {', '.join(one.name for one in MISTAKES)}.")
    with tempfile.TemporaryDirectory(prefix="jaxgran-mutants-") as folder:
        copy = Copy(Path(folder) / "tree", Path(folder) / "cache")
        copy.fill()
        nearest = {test: None for one in chosen for test in one.tests}
        missing = [test for test in nearest if not (copy.tree / "tests" / test).is_file()]
        if missing:
            print(f"left out, as they are not there: {', '.join(missing)}")
        print(f"without a mistake: {len(nearest) - len(missing)} files of tests", flush=True)
        failing, seconds = copy.failures(nearest_words(copy, list(nearest)), 10 * NEAREST_LIMIT)
        print(f"  {seconds:.0f} s; failing: {', '.join(failing) or 'none'}", flush=True)
        rows = [judged(copy, one, failing, output.quick) for one in chosen]
    print_table(rows)
    if only is None:
        tests = "nearest" if output.quick else "nearest, then all"
        output.write_rows("mutants", {"tests": tests, "fail_without_a_mistake": failing}, "mistakes", rows)


@dataclass(frozen=True)
class Copy:
    """A copy of the tracked files, always in the same place, so that what they compile to is found again."""

    tree: Path
    cache: Path

    def fill(self) -> None:
        """Copy all tracked files with their times."""
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
        for name in filter(None, listed.stdout.split("\0")):
            if (ROOT / name).is_file():  # not one that was removed and is still tracked
                (self.tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.tree / name)
        self.cache.mkdir()
        where = "import jaxgran; print(jaxgran.__file__)"
        said = subprocess.run(
            [sys.executable, "-c", where], cwd=self.tree, env=self.environment(), capture_output=True, text=True
        )
        if Path(said.stdout.strip()).parent != self.tree / "jaxgran":
            raise RuntimeError(f"the tests would not run the copy, but {said.stdout.strip() or said.stderr}")

    def environment(self) -> dict[str, str]:
        """That of the tests: the copy comes first, what is compiled is kept, and precision is as they choose it."""
        path = os.pathsep.join([str(self.tree), *filter(None, [os.environ.get("PYTHONPATH")])])
        ours = {"PYTHONPATH": path, "JAXGRAN_TEST_CACHE": str(self.cache), "PYTHONDONTWRITEBYTECODE": "1"}
        return {name: value for name, value in os.environ.items() if name not in NOT_PASSED_ON} | ours

    def failures(self, words: Sequence[str], limit: float) -> tuple[list[str], float]:
        """The tests that fail in one run of pytest, and its seconds; why it ended, if that was no test."""
        start = time.perf_counter()
        with tempfile.TemporaryFile("w+") as said:
            process = subprocess.Popen(
                [sys.executable, "-m", "pytest", "-q", *words],
                cwd=self.tree,
                env=self.environment(),
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # with all that the tests start it can be ended
            )
            try:
                status = process.wait(limit)
            except BaseException as error:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                if not isinstance(error, subprocess.TimeoutExpired):
                    raise
                return [TIME_LIMIT.format(limit)], time.perf_counter() - start
            said.seek(0)
            failed = failed_tests(said.read())
        if status not in NO_FAILURE and not failed:
            failed = [f"pytest ended with {status}"]
        return failed, time.perf_counter() - start


def failed_tests(said: str) -> list[str]:
    """The tests that pytest names in its short summary, in the order of their failure."""
    return re.findall(r"^(?:FAILED|ERROR) (tests/[^\s[]+(?:\[.*?\])?)(?: - .*)?$", said, re.MULTILINE)


def nearest_words(copy: Copy, tests: Sequence[str]) -> list[str]:
    """The words of pytest for those files of tests that exist, in one process."""
    files = [f"tests/{test}" for test in tests if (copy.tree / "tests" / test).is_file()]
    return ["-n0", *files]


def judged(copy: Copy, mistake: Mistake, failing: Sequence[str], quick: bool) -> dict:
    """A row of the results: which test finds a mistake, if any does, and whether among the nearest ones."""
    print(f"{mistake.name}: {mistake.file}", flush=True)
    file = copy.tree / mistake.file
    text = (ROOT / mistake.file).read_text(encoding="utf-8")
    file.write_text(mistake.made_in(text), encoding="utf-8")
    words = nearest_words(copy, mistake.tests)
    found, seconds = copy.failures(["-x", *words], NEAREST_LIMIT) if words[1:] else ([], 0.0)
    nearest = bool(found)
    if not found and not quick:
        print(f"  {seconds:.0f} s; none of the nearest tests fails: all tests", flush=True)
        found, more = copy.failures(["-x", f"--ignore={OWN_TEST}"], WHOLE_LIMIT)
        seconds += more
    shutil.copy2(ROOT / mistake.file, file)
    first = found[0] if found else None
    also_without = first in failing
    if first and not nearest and first.startswith("tests/"):  # not one of those that were run without a mistake
        also_without = bool(copy.failures(["-n0", first], NEAREST_LIMIT)[0])
    note = " (which fails without it, too)" if also_without else ""
    print(f"  {seconds:.0f} s; {first or 'not found'}{note}", flush=True)
    return {
        **{name: value for name, value in asdict(mistake).items() if name != "tests"},
        "found_by": first,
        "nearest": nearest,
        "also_without": also_without,
        "seconds": round(seconds, 1),
    }


def print_table(rows: Sequence[dict]) -> None:
    """Mistake, seconds, and the test that finds it; last, how many are found."""
    width = max(len(row["name"]) for row in rows)
    print(f"\n{'mistake':{width}}  seconds  found by")
    for row in rows:
        by = "not found" if row["found_by"] is None else row["found_by"]
        by += " (fails without it, too)" if row["also_without"] else ""
        print(f"{row['name']:{width}}  {row['seconds']:7.0f}  {by}")
    found = sum(row["found_by"] is not None and not row["also_without"] for row in rows)
    print(f"{found} of {len(rows)} are found")
