"""What many points cost besides their flows, and whether memory stays flat.

- 4096 replicas in one sweep: 32 × 32 points, 4 seeds, 16 grains.
- 10,000 points of tiny work: the time of a sweep, with its checkpoint and its dataset, less that spent in the batches.
- A soak: sweeps one after another in one process for a given time, with the resident memory of the process.

    python benchmarks/load.py [--quick] [--soak MINUTES]    # about 4 minutes on one core, and the soak
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from hardware import hardware
from matplotlib.figure import Figure

from jaxgran.maps import sweep
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.results import write_dataset
from jaxgran.maps.settings import MapSettings


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--quick", action="store_true", help="a hundredth of the points")
    arguments.add_argument("--soak", type=float, default=0.0, metavar="MINUTES", help="length of the soak")
    arguments.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    chosen = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    stem = chosen.output / ("load_quick" if chosen.quick else "load")
    chosen.output.mkdir(parents=True, exist_ok=True)
    found = json.loads(stem.with_suffix(".json").read_text()) if stem.with_suffix(".json").exists() else {}
    found["hardware"] = hardware()
    if chosen.soak:
        found["soak"] = soak(60 * chosen.soak)
        draw(found["soak"]).savefig(chosen.output / "soak.png", dpi=150)
    else:
        found["replicas"] = timed(settings(3, 3, 4) if chosen.quick else settings(32, 32, 4))
        found["points"] = timed(settings(10, 10, 1) if chosen.quick else settings(100, 100, 1))
    for name in ("replicas", "points"):
        if name in found:
            print(name, {key: f"{value:.3g}" for key, value in found[name].items()})
    stem.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")


def settings(restitutions: int, packing_fractions: int, seeds: int) -> MapSettings:
    """A map whose points take next to no time: 16 grains, a strain of 160 steps."""
    return MapSettings(
        tuple(np.linspace(0.1, 0.9, restitutions).tolist()),
        tuple(np.linspace(0.3, 0.7, packing_fractions).tolist()),
        grains=16,
        seeds=seeds,
        timestep=1e-3,
        equilibrate=0.0,
        strain=0.16,
    )


def timed(chosen: MapSettings) -> dict[str, float]:
    """Time of a sweep, of its batches, and of all else by point."""
    inside, measured = 0.0, sweep._measured

    def counted(*arguments):
        nonlocal inside
        start = time.perf_counter()
        done = measured(*arguments)
        inside += time.perf_counter() - start
        return done

    run(settings(2, 1, 2))  # compiles
    sweep._measured, start = counted, time.perf_counter()
    try:
        points, replicas = run(chosen)
    finally:
        sweep._measured = measured
    seconds = time.perf_counter() - start
    return {
        "points": points,
        "replicas": replicas,
        "seconds": seconds,
        "seconds in batches": inside,
        "milliseconds of all else by point": 1000 * (seconds - inside) / points,
        "resident MiB": resident(),
    }


def run(chosen: MapSettings) -> tuple[int, int]:
    """A sweep as the command line does it, in a folder that is thrown away; its points and replicas."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "map.nc"
        checkpoint = Checkpoint(output, chosen, resume=False)
        results = dict(sweep.replicas(chosen, "auto", 1, None, checkpoint))
        data = map_dataset(chosen, results, {})
        write_dataset(data, output)
        checkpoint.close(finished=True)
    return data.status.size, len(results)


def soak(seconds: float) -> dict[str, list[float]]:
    """Resident memory after every sweep, until the time is over."""
    times, memory, start = [], [], time.monotonic()
    while time.monotonic() - start < seconds:
        run(settings(4, 4, 4))
        times.append((time.monotonic() - start) / 60)
        memory.append(resident())
    return {"minutes": times, "resident MiB": memory}


def resident() -> float:
    """Resident memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def draw(soaked: dict[str, list[float]]) -> Figure:
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(soaked["minutes"], soaked["resident MiB"], "k.", markersize=3)
    axes.set_xlabel("time (min)")
    axes.set_ylabel("resident memory (MiB)")
    axes.set_ylim(0, 1.15 * max(soaked["resident MiB"]))
    axes.set_title(f"{len(soaked['minutes'])} sweeps of 64 replicas in one process", fontsize="medium")
    return figure


if __name__ == "__main__":
    main()
