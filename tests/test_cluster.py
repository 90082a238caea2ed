"""A Dask cluster gives the numbers of one process, and what goes wrong with it is one sentence."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest
from dask import distributed
from distributed.comm import CommClosedError
from synthetic import refused

from jaxgran.maps.cluster import Provenance, run_on_cluster
from jaxgran.maps.provenance import made_with
from jaxgran.maps.results import open_map

MAP = (
    "--restitution 0.5,0.9 --packing-fraction 0.6 --grains 16 --seeds 1 --timestep 1e-3 "
    "--equilibrate 0 --strain 0.32"
)
SCRIPT = Path(__file__).parents[1] / "docs" / "how-to" / "slurm_map.py"


def run(folder: Path, *words: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir}
    command = [sys.executable, *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.mark.environment
def test_a_map_on_a_cluster_is_that_of_one_process(tmp_path: Path) -> None:
    here = ("-m", "jaxgran", "map", *MAP.split(), "--workers", "1", "--output", "here.nc")
    there = (str(SCRIPT), "--workers", "2", "--", *MAP.split(), "--output", "there.nc")
    one, other = run(tmp_path, *here), run(tmp_path, *there)
    assert one.returncode == other.returncode, other.stderr
    assert open_map(tmp_path / "there.nc").equals(open_map(tmp_path / "here.nc"))
    assert "2/2 points" in other.stderr and "Traceback" not in other.stderr
    assert not list(tmp_path.glob("*.unfinished"))


def test_a_scheduler_that_does_not_answer_is_one_sentence(monkeypatch) -> None:
    monkeypatch.setattr("jaxgran.maps.cluster._PATIENCE", "0.5s")
    with refused("no scheduler answers"):
        next(run_on_cluster("tcp://127.0.0.1:1", print, [()]))


class Done:
    """A future of a cluster, and the cluster that has just this one."""

    loop = None

    def __init__(self, outcome) -> None:
        self.outcome = outcome

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        pass

    def submit(self, *_, **__) -> "Done":
        return self

    def result(self):
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def outcome_of(outcome: Any, monkeypatch) -> tuple[list, Provenance]:
    """What comes from a cluster whose worker returns or raises this."""
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: Done(outcome))
    monkeypatch.setattr(distributed, "as_completed", lambda futures, loop: futures)
    made: Provenance = {}
    return list(run_on_cluster("tcp://x", print, [()], made)), made


def test_provenance_is_that_of_the_workers(monkeypatch) -> None:
    worker = made_with() | {"device": "gpu: one", "platform": "Linux, 1 cores"}
    outcome, made = outcome_of((worker, "result"), monkeypatch)
    assert outcome == [(0, "result")]
    assert {name: [*values] for name, values in made.items()} == {x: [worker[x]] for x in worker}


@pytest.mark.parametrize("name", ["code_digest", "version_jax"])
def test_a_worker_of_another_version_is_refused(name: str, monkeypatch) -> None:
    with refused("workers must have the versions of this process, and one has .* 'other', not "):
        outcome_of((made_with() | {name: "other"}, "result"), monkeypatch)


def test_a_task_that_kills_its_workers_is_given_up(monkeypatch) -> None:
    killed = distributed.KilledWorker("task", None, 3)
    assert outcome_of(killed, monkeypatch)[0] == [(0, None)]


@pytest.mark.parametrize("error", [distributed.CancelledError(), CommClosedError()])
def test_a_scheduler_that_has_gone_is_an_error_of_the_connection(error, monkeypatch) -> None:
    with pytest.raises(ConnectionError, match="the scheduler at tcp://x has gone"):
        outcome_of(error, monkeypatch)
