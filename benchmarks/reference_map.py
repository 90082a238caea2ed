"""The reference map: averages of large systems over the plane of restitution and packing fraction,
at dt = 1e-4.

Packing fractions are 0.01 apart where averages change fast, and restitutions are close where grains
cluster. Loose flows depend on N and have 6400 grains, dense ones 1600. Every seed is a map of its
own, sampled over six correlation strains of each flow, and kept beside the results; all are merged.
So a run that was stopped goes on, and another seed makes errors smaller. Where these grains are too
few for long waves, maps of more take the place of the plane's: 6400 from ν = 0.72 to 0.77
(``--part between``), 3200 from 0.78 to 0.82 (``--part dense``), and 16,000 where collisions
dissipate most (``--part dissipative``). Flows of several sizes say how averages approach those of a
large system (``python -m benchmarks size_limits``), and a map at dt = 1e-3 what becomes of the
force ratio.

    python -m benchmarks reference_map --first-seed 2  # the committed seeds, two hours on two cores
    python -m benchmarks reference_map --first-seed 2 --seeds 4  # two more
    python -m benchmarks reference_map --first-seed 2 --part between  # 6400 grains, an hour
    python -m benchmarks reference_map --part dense  # 3200 grains, 50 minutes
    python -m benchmarks reference_map --part dissipative --seeds 1  # 16,000, three hours
    python -m benchmarks reference_map --part sizes  # flows of several sizes, 20 minutes
    python -m benchmarks reference_map --part check  # flows that check their law, 20 minutes
    python -m benchmarks reference_map --part coarse  # dt = 1e-3
    python -m benchmarks reference_map --quick       # 3 × 3 points of 64 and 100 grains, a minute
"""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr

import jaxgran as jg
from benchmarks.output import RESULTS, Output
from jaxgran.environment import usable_cores
from jaxgran.maps.results import write_dataset
from jaxgran.maps.schema import flattened
from jaxgran.maps.variables import NOT_RUN

PLANE = "reference.nc", "reference_between.nc", "reference_dense.nc", "reference_dissipative.nc"
KEPT = RESULTS / ".reference_map"  # the maps of single seeds
RESTITUTIONS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98)
LOOSE = (0.1, 0.2, 0.3, 0.4, 0.5, 0.56, 0.6, 0.65, 0.7)
BETWEEN = (0.72, 0.73, 0.74, 0.75, 0.76, 0.77)
DENSER = (0.78, 0.79, 0.8, 0.81, 0.82)
DENSE = (*BETWEEN, *DENSER, 0.83)


def grid(alphas: Any, nus: Any, grains: Any, timestep: float) -> dict[str, Any]:
    """The arguments of ``ratio_map`` for a grid of flows, all with the same numbers of grains."""
    axes = {"restitution": alphas, "packing_fraction": nus}
    return axes | {"grains": grains, "timestep": timestep}


def plane(alphas: Any, loose: Any, dense: Any, grains: Any, timestep: float) -> dict[str, Any]:
    """The same with one number of grains for loose and one for dense flows."""
    by_point = np.repeat(grains, [len(alphas) * len(nus) for nus in (loose, dense)]).tolist()
    axes = {"restitution": alphas, "packing_fraction": loose + dense}
    return axes | {"grains_by_point": by_point, "timestep": timestep}


Maps = dict[str, dict[str, Any]]  # arguments of ``ratio_map`` by the name of a map
SEVERAL_SEEDS: dict[str, Maps] = {  # parts of ``PLANE``: the maps of one seed
    "plane": {"plane": plane(RESTITUTIONS, LOOSE, DENSE, (6400, 1600), 1e-4)},
    "between": {"between": grid(RESTITUTIONS, BETWEEN, 6400, 1e-4)},
    "dense": {"dense": grid(RESTITUTIONS, DENSER, 3200, 1e-4)},
    "dissipative": {  # where long waves are strongest
        "dissipative": grid(RESTITUTIONS[:4], (*LOOSE, *BETWEEN[:2]), 16_000, 1e-4),
        "dissipative_dense": grid(RESTITUTIONS[:4], BETWEEN[2:4], 16_000, 1e-4),
        "dissipative_less": grid(RESTITUTIONS[4:7], (*LOOSE[4:], *BETWEEN[:3]), 16_000, 1e-4),
    },
}
CHECKED = (0.15, 0.35, 0.6, 0.85), (0.3, 0.5, 0.65, 0.76)  # that no law of the size was fitted to
SLOW = RESTITUTIONS[:10], (*LOOSE[2:], *DENSE[:8])  # enough for dt = 1e-3, with clusters
PARTS: dict[str, Maps] = {
    "sizes": {
        "sizes_loose": grid((0.1, 0.4, 0.7), (0.2, 0.4, 0.6), (400, 1600, 6400, 25_600), 5e-4),
        "sizes_dense": grid((0.1, 0.5, 0.9), (0.7, 0.74, 0.77, 0.8), (400, 1600, 6400), 2e-4),
    },
    "check": {
        "check_small": grid(*CHECKED, (256, 1024), 5e-4) | {"seeds": 8},
        "check_large": grid(*CHECKED, 25_600, 5e-4),
    },
    "coarse": {"coarse": grid(*SLOW, 1000, 1e-3)},
}
QUICK: dict[str, Maps] = {
    "plane": {"plane": plane((0.1, 0.5, 0.9), (0.5, 0.7), (0.8,), (100, 64), 5e-4)},
    "between": {"between": grid((0.1, 0.9), (0.72,), 100, 5e-4)},
    "dense": {"dense": grid((0.1, 0.9), (0.8,), 100, 5e-4)},
    "dissipative": {
        "dissipative": grid((0.1,), (0.5,), 144, 5e-4),
        "dissipative_less": grid((0.5,), (0.7,), 144, 5e-4),
    },
    "sizes": {
        "sizes_loose": grid((0.1, 0.7), (0.2, 0.6), (64, 256), 5e-4),
        "sizes_dense": grid((0.1, 0.9), (0.7, 0.8), (64, 256), 2e-4),
    },
    "check": {
        "check_small": grid(*CHECKED, (64, 100), 5e-4) | {"seeds": 8},
        "check_large": grid(*CHECKED, 200, 5e-4),
    },
    "coarse": {"coarse": grid((0.1, 0.5), (0.6,), 64, 1e-3)},
}
Part = Literal["plane", "between", "dense", "dissipative", "sizes", "check", "coarse"]


def reference_points() -> xr.Dataset:
    """The averages of the maps of ``PLANE`` at each packing fraction and restitution of the first:
    where several have a point, those of the last one that measured it, which has the most grains.
    """
    maps = [flattened(jg.open_map(RESULTS / name)) for name in PLANE]
    points, commits = with_points(maps[0]), [maps[0].attrs["commit"]]
    for data in maps[1:]:
        for name in ("timestep", "activation", "polydispersity", "tolerance"):
            if points.attrs[name] != data.attrs[name]:
                raise ValueError(f"{', '.join(PLANE)} must have the same {name}.")
        finer = with_points(data).reindex_like(points[["packing_fraction", "restitution"]])
        measured = finer.pressure.notnull()
        if int(measured.sum()) != int((data.status != NOT_RUN).sum()):
            raise ValueError(f"{PLANE[0]} lacks points of another map of {', '.join(PLANE)}.")
        points = finer.where(measured, points).assign_attrs(points.attrs)
        commits.append(data.attrs["commit"])
    numbers = {name: points[f"point_{name}"].astype(int) for name in ("grains", "seeds")}
    points = points.assign(status=points.status.astype(int)).assign_coords(
        {f"point_{name}": x for name, x in numbers.items()}
    )
    grains = numbers["grains"].values.ravel()
    seeds = " or ".join(str(x) for x in sorted(set(numbers["seeds"].values.ravel()), reverse=True))
    return points.assign_attrs(grains_by_point=grains, seeds=seeds, commit="; ".join(commits))


def with_points(data: xr.Dataset) -> xr.Dataset:
    """The averages of a map, and at each point its numbers of grains and of seeds."""
    grains = np.asarray(data.get("point_grains", data.attrs["grains"]))
    points = data.drop_dims([name for name in data.dims if name in ("seed", "observable")])
    points = points.drop_vars(["grains", "point_grains"], errors="ignore")
    ones = xr.ones_like(points.pressure)
    return points.assign(point_grains=ones * grains, point_seeds=ones * data.attrs["seeds"])


def run(
    output: Output, seeds: int = 2, first_seed: int = 0, part: Part = "plane", folder: Path = KEPT
) -> None:
    """Map what is missing of a part, and write it; all seeds of ``PLANE`` as one map."""
    if part not in SEVERAL_SEEDS and (seeds, first_seed) != (2, 0):
        raise SystemExit(f"--seeds and --first-seed belong to {', '.join(SEVERAL_SEEDS)}.")
    folder = folder.with_name(f"{folder.name}_quick") if output.quick else folder
    folder.mkdir(parents=True, exist_ok=True)
    maps = QUICK if output.quick else SEVERAL_SEEDS | PARTS
    command = "python -m benchmarks reference_map"

    def made(name: str, **chosen: Any) -> xr.DataTree:
        kept = {"output": folder / f"{name}.nc", "attributes": {"command": command}}
        ways = {"resume": True, "progress": True, "workers": usable_cores()}
        return jg.ratio_map(**{"seeds": 1, **chosen}, **kept, **ways)

    if part in SEVERAL_SEEDS:
        merged = jg.merge_maps(
            [
                made(f"{name}_{k}", **settings, first_seed=k)
                for k in range(first_seed, first_seed + seeds)
                for name, settings in maps[part].items()
            ]
        )
        merged.attrs["command"] = (
            f"{command} --part {part} --seeds {seeds} --first-seed {first_seed}"
        )
        write_dataset(merged, output.path("reference", ".nc" if part == "plane" else f"_{part}.nc"))
        return
    for name, chosen in maps[part].items():
        write_dataset(made(name, **chosen), output.path("reference", f"_{name}.nc"))
