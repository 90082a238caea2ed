"""A Dask cluster gives the numbers of one process, and what goes wrong with it is one sentence."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from synthetic import refused

from jaxgran.maps.cluster import run_on_cluster
from jaxgran.maps.results import open_map

MAP = "--restitution 0.5,0.9 --packing-fraction 0.6 --grains 16 --seeds 1 --timestep 1e-3 --equilibrate 0 --strain 0.32"
SCRIPT = Path(__file__).parents[1] / "docs" / "how-to" / "slurm_map.py"


def run(folder: Path, *words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": jax.config.values["jax_compilation_cache_dir"]}
    return subprocess.run([sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.environment
def test_a_map_on_a_cluster_is_that_of_one_process(tmp_path: Path) -> None:
    here = run(tmp_path, "-m", "jaxgran", "map", *MAP.split(), "--workers", "1", "--output", "here.nc")
    there = run(tmp_path, str(SCRIPT), "--workers", "2", "--", *MAP.split(), "--output", "there.nc")
    assert here.returncode == there.returncode, there.stderr
    assert open_map(tmp_path / "there.nc").equals(open_map(tmp_path / "here.nc"))
    assert "2/2 points" in there.stderr and "Traceback" not in there.stderr
    assert not list(tmp_path.glob("*.unfinished"))


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_a_scheduler_that_does_not_answer_is_one_sentence(address: str, monkeypatch) -> None:
    monkeypatch.setattr("jaxgran.maps.cluster._PATIENCE", "0.5s")
    with refused("no scheduler answers"):
        next(run_on_cluster(address, print, [()]))
