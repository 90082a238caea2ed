"""A map that is killed again and again at random moments comes to the same bits."""

import random
import re
import time

import pytest
import xarray as xr
from fault_lab import MARKS, PATIENCE, Lab

from jaxgran.maps.results import read_dataset

pytestmark = MARKS


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


MANY = [pytest.param(1, 14, marks=pytest.mark.slow), pytest.param(2, 6, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("workers", "most_kills"), [(1, 3), (2, 1), *MANY])
def test_a_map_that_is_killed_at_random_moments_loses_and_doubles_nothing(
    lab: Lab, workers: int, most_kills: int
) -> None:
    rng, maps, kills, known = random.Random(workers), 1, 0, 0
    while kills < most_kills:
        output = f"killed{workers}-{most_kills}-{maps}.nc"
        process = lab.start(output, "--resume", "--batch", "1", workers=workers)
        if rng.random() < 0.6:  # in the middle of the work, else at any moment of the start
            lab.wait_for_work(output, process)
            time.sleep(rng.uniform(0, 1.0))
        else:
            time.sleep(rng.uniform(0, 3.0))
        process.kill()
        _, err = process.communicate(timeout=PATIENCE)
        begun = "Ran out of input" not in err  # what Python says of a worker that has only half been started
        assert "Warning" not in err and not (begun and "Traceback" in err), err
        for done in re.findall(r"continued: (\d+) of 8", err):
            assert int(done) >= known  # what is done stays done
            known = int(done)
        kills += process.returncode != 0
        folder = lab.folder / f"{output}.unfinished"
        if (lab.folder / output).exists() and not folder.exists():  # it was faster: the next map
            xr.testing.assert_equal(read_dataset(lab.folder / output), lab.whole)
            maps, known = maps + 1, 0
    done = lab.finish(lab.start(output, "--resume", workers=workers))
    assert done.returncode == 0, done.stderr
    lab.assert_whole(output)
