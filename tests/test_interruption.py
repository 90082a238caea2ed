"""Ctrl-C ends what is computed at once, and leaves the numba engine as it was."""

import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from flows import GRAINS

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.numba_engine import ffi
from jaxgran.maps.batches import replica_ids
from jaxgran.maps.run import run_replicas
from jaxgran.maps.settings import MapSettings
from jaxgran.model.flow import ShearFlow
from jaxgran.model.status import Status
from jaxgran.sampling.sampler import sample

SECOND = 1.0
FLOW = ShearFlow(GRAINS, 0.7, 0.7, 1e-3)


def test_machine_code_that_is_stopped_ends_as_failed_and_runs_again(engines, flowing) -> None:
    advance, state = engines["numba"], flowing(0.7)
    end, whole = advance(FLOW, state, 1000, BarzilaiBorwein())
    with ffi.engines_stopped():
        _, cut = advance(FLOW, state, 1000, BarzilaiBorwein())
    assert cut.status == Status.failed and cut.steps < 1000
    again, tally = advance(FLOW, state, 1000, BarzilaiBorwein())
    assert tally.status == whole.status == Status.ok
    np.testing.assert_array_equal(again.positions, end.positions)


@pytest.fixture
def interrupted():
    """Calls a function, with Ctrl-C half a second later, which ends it within a second.

    A shell ignores Ctrl-C for what it runs in the background.
    """
    if not hasattr(signal, "pthread_kill"):
        pytest.skip("no signals to a thread")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def call(function) -> None:
        pressed = []

        def press() -> None:
            pressed.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGINT)

        threading.Timer(0.5, press).start()
        with pytest.raises(KeyboardInterrupt):
            function()
        assert time.monotonic() - pressed[0] < SECOND
        computing = time.process_time()
        time.sleep(0.2)
        assert time.process_time() - computing < 0.1  # nothing goes on beside

    yield call
    signal.signal(signal.SIGINT, before)


def test_a_sample_of_hours_ends_within_a_second_of_ctrl_c(flowing, interrupted) -> None:
    state = flowing(0.7)
    _, before = sample(FLOW, state, 0.1)
    interrupted(lambda: sample(replace(FLOW, timestep=1e-5), state, 1e4))
    _, after = sample(FLOW, state, 0.1)
    assert before == after


def test_replicas_of_hours_end_within_a_second_of_ctrl_c(interrupted) -> None:
    settings = MapSettings(
        (0.7,), (0.6,), grains=32, seeds=2, timestep=1e-3, equilibrate=0.0, strain=1e5
    )
    interrupted(lambda: list(run_replicas(settings, replica_ids(settings), workers=2)))
