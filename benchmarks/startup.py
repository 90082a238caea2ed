"""How long does a command take, from the prompt to its end?

Every command runs in its own process, with a cache folder of this benchmark: once with nothing in
it, and then five times more, of which the median is taken.

    python -m benchmarks startup            # 3 minutes on two cores
    python -m benchmarks startup --quick    # two runs of each command, and a small map
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import ROOT
from benchmarks.output import Output

RUNS = 5
MAP = "map.nc"
COMMANDS = {
    "help": "--help",
    "info": "info",
    "run, strain 0.5": "run --restitution 0.5 --packing-fraction 0.7 --strain 0.5 --quiet",
    "map, quick preset": f"map --output {MAP} --overwrite --quiet",
    "plot": f"plot {MAP}",
}
SMALL_MAP = (
    f"{COMMANDS['map, quick preset']} --restitution 0.3,0.7 --packing-fraction 0.5,0.6 --grains 32"
)
_SAMPLE = """
import time, statistics, jax
jax.config.update("jax_enable_x64", True)
import jaxgran as jg
flow = jg.ShearFlow(grains=16, restitution=0.5, packing_fraction=0.3, timestep=1e-3)
state = jg.heated(flow, jax.random.key(0))
seconds = []
for _ in range(210):
    start = time.perf_counter()
    jg.sample(flow, state, 0.032)
    seconds.append(time.perf_counter() - start)
print(1e3 * statistics.median(seconds[10:]))
"""


def run(output: Output) -> None:
    """Time the commands, print a table and write JSON."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="jaxgran-startup-") as name:
        folder = Path(name)
        for command, text in COMMANDS.items():
            words = (SMALL_MAP if output.quick and text.startswith("map") else text).split()
            first = seconds_of(words, folder)
            warm = [seconds_of(words, folder) for _ in range(2 if output.quick else RUNS)]
            row = {"command": command, "first": first, "warm": statistics.median(warm)}
            rows.append(row | {"warm_runs": warm})
            print(rows[-1], flush=True)
        printed = process([sys.executable, "-c", _SAMPLE], folder).stdout
    milliseconds = {"sample_milliseconds": float(printed)}
    print(milliseconds)
    output.write_json("startup", {"runs": RUNS} | milliseconds | {"commands": rows})


def process(command: list[str], folder: Path) -> subprocess.CompletedProcess:
    """A finished process whose caches are in the folder."""
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    for name in ("JAX_ENABLE_X64", "JAX_COMPILATION_CACHE_DIR", "NUMBA_CACHE_DIR"):
        environment.pop(name, None)
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )


def seconds_of(words: list[str], folder: Path) -> float:
    """Seconds of one command, from its start to its end."""
    start = time.perf_counter()
    process([sys.executable, "-m", "jaxgran", *words], folder)
    return round(time.perf_counter() - start, 3)
