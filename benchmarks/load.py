"""What many points cost besides their flows, and whether memory stays flat.

- 4096 replicas in one sweep: 32 × 32 points, 4 seeds, 16 grains.
- 10,000 points of tiny work: the time of a sweep, with its checkpoint and its dataset, less that spent in the batches.
- A soak: sweeps one after another in one process for a given time, with the resident memory of the process.

    python -m benchmarks load [--quick] [--soak MINUTES]    # about 4 minutes on one core, and the soak
"""

import json
import tempfile
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.output import Output
from jaxgran.maps import ratio_map as ratio_map_module
from jaxgran.maps.checkpoint import Checkpoint
from jaxgran.maps.dataset import map_dataset
from jaxgran.maps.results import write_dataset
from jaxgran.maps.settings import MapSettings


def run(output: Output, soak: float = 0.0) -> None:
    """Time the sweeps, or soak for so many minutes; print, and write into the JSON of an earlier run."""
    earlier = output.path("load", ".json")
    found = json.loads(earlier.read_text()) if earlier.exists() else {}
    found["hardware"] = output.hardware
    if soak:
        found["soak"] = memory_of_sweeps(60 * soak)
        output.write_picture(draw(found["soak"]), "soak")
    else:
        found["replicas"] = timed(settings(3, 3, 4) if output.quick else settings(32, 32, 4))
        found["points"] = timed(settings(10, 10, 1) if output.quick else settings(100, 100, 1))
    for name in ("replicas", "points"):
        if name in found:
            print(name, {key: f"{value:.3g}" for key, value in found[name].items()})
    output.write_json("load", found)


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
    inside, measured = 0.0, ratio_map_module._measured

    def counted(*arguments):
        nonlocal inside
        start = time.perf_counter()
        done = measured(*arguments)
        inside += time.perf_counter() - start
        return done

    swept(settings(2, 1, 2))  # compiles
    ratio_map_module._measured, start = counted, time.perf_counter()
    try:
        points, replicas = swept(chosen)
    finally:
        ratio_map_module._measured = measured
    seconds = time.perf_counter() - start
    return {
        "points": points,
        "replicas": replicas,
        "seconds": seconds,
        "seconds in batches": inside,
        "milliseconds of all else by point": 1000 * (seconds - inside) / points,
        "resident MiB": resident(),
    }


def swept(chosen: MapSettings) -> tuple[int, int]:
    """A sweep as the command line does it, in a folder that is thrown away; its points and replicas."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "map.nc"
        checkpoint = Checkpoint(output, chosen, resume=False)
        results = dict(ratio_map_module.replicas(chosen, "auto", 1, None, checkpoint))
        data = map_dataset(chosen, results, {})
        write_dataset(data, output)
        checkpoint.close(finished=True)
    return data.status.size, len(results)


def memory_of_sweeps(seconds: float) -> dict[str, list[float]]:
    """Resident memory after every sweep, until the time is over."""
    times, memory, start = [], [], time.monotonic()
    while time.monotonic() - start < seconds:
        swept(settings(4, 4, 4))
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
