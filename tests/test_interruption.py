"""Ctrl-C ends what is computed at once, and leaves the numba engine as it was."""

import os
import signal
import threading
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS

from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.numba_engine import ffi
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
def ctrl_c():
    """Ctrl-C as a terminal has it: a shell ignores it for what it runs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="no signals to a thread")
def test_a_sample_of_hours_ends_within_a_second_of_ctrl_c(flowing, ctrl_c) -> None:
    state = flowing(0.7)
    _, before = sample(FLOW, state, 0.1)
    sent = []

    def interrupt() -> None:
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    timer = threading.Timer(0.5, interrupt)
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        sample(replace(FLOW, timestep=1e-5), state, 1e4)
    assert time.monotonic() - sent[0] < SECOND
    computing = time.process_time()
    time.sleep(0.2)
    assert time.process_time() - computing < 0.1  # nothing goes on beside
    _, after = sample(FLOW, state, 0.1)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.array_equal(a, b)), before, after))
