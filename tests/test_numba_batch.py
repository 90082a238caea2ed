"""A batch of the numba engine has the bits of its replicas alone, on any number of threads."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS

from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.numba_engine import ffi
from jaxgran.dynamics.numba_engine.layout import THREADS
from jaxgran.environment import usable_cores, usable_threads
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.sampler import sample

RESTITUTIONS, FRACTIONS, STEPS = (0.3, 0.7, 0.9), (0.6, 0.7), 500


@pytest.fixture(params=[1, 2, 8])
def threads(request) -> Iterator[int]:
    ffi.register()
    ffi.shared_words()[THREADS] = request.param
    yield request.param
    ffi.shared_words()[THREADS] = usable_threads()


def advanced(restitution, fraction, state):
    return advance(ShearFlow(GRAINS, restitution, fraction, 1e-3), state, jnp.int32(STEPS))


def test_a_grid_of_replicas_has_the_bits_of_each_alone(flowing, threads: int) -> None:
    one = jax.jit(advanced)
    over_restitutions = jax.vmap(advanced, (0, None, None))
    states = jax.tree.map(lambda *x: jnp.stack(x), *map(flowing, FRACTIONS))
    grid = jax.jit(jax.vmap(over_restitutions, (None, 0, 0)))(
        jnp.asarray(RESTITUTIONS), jnp.asarray(FRACTIONS), states
    )
    for k, fraction in enumerate(FRACTIONS):
        for n, restitution in enumerate(RESTITUTIONS):
            (end, tally), alone = (
                jax.tree.map(lambda x, p=(k, n): x[p], grid),
                one(restitution, fraction, flowing(fraction)),
            )
            # XLA's cosine of a batch
            np.testing.assert_allclose(tally.wave_kinetic, alone[1].wave_kinetic, rtol=1e-14)
            rest = end, replace(tally, wave_kinetic=alone[1].wave_kinetic)
            jax.tree.map(np.testing.assert_array_equal, rest, alone)


def test_what_is_observed_in_a_batch_has_the_bits_of_each_replica_alone(
    flowing, threads: int
) -> None:
    def coordination(snapshot):
        return jnp.sum(jnp.where(snapshot.impulses > 0, 2 / GRAINS, 0))

    def sampled(restitution, state):
        return sample(
            ShearFlow(GRAINS, restitution, 0.7, 1e-3), state, 0.2, blocks=2, observe=coordination
        )

    state = flowing(0.7)
    batch = jax.vmap(sampled, (0, None))(jnp.asarray(RESTITUTIONS), state)
    for n, restitution in enumerate(RESTITUTIONS):
        np.testing.assert_array_equal(
            batch[1].observed_sums[n], sampled(restitution, state)[1].observed_sums
        )


def test_a_batch_without_replicas_is_empty(flowing) -> None:
    _, tally = jax.jit(jax.vmap(advanced, (0, None, None)))(jnp.zeros(0), 0.7, flowing(0.7))
    assert tally.steps.shape == (0,)


@pytest.mark.parametrize(
    "asked, expected",
    [("3", 3), ("0", usable_cores()), ("", usable_cores()), ("all", usable_cores())],
)
def test_the_variable_of_numba_sets_the_number_of_threads(
    asked: str, expected: int, monkeypatch
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", asked)
    assert usable_threads() == expected


@pytest.mark.skipif(sys.platform != "linux", reason="no list of the threads of a process")
def test_no_thread_outlives_a_call_that_lacks_memory(tmp_path: Path) -> None:
    """With memory for one replica of six, no thread without any ends the call before others."""
    script = """
import os, resource
import jax, numpy as np
import jaxgran as jg
from jaxgran.model.status import Status

jax.config.update("jax_enable_x64", True)
count, replicas = 100_000, 6
across = int(np.ceil(np.sqrt(count)))
positions = 1.25 * np.stack(np.divmod(np.arange(count), across), axis=-1)
velocities = np.random.default_rng(0).normal(size=(count, 2))
grains = jg.Grains(np.full(count, 0.5), np.ones(count))
state = jg.State(grains, positions, velocities, 1.25 * across, 0.0)
flow = jg.ShearFlow(count, 0.9, float(state.packing_fraction), 1e-3)

def status(state, steps):
    return jg.advance(flow, state, steps, engine=jg.Numba())[1].status

over_steps = jax.jit(jax.vmap(status, (None, 0)))
arguments = jax.device_put((state, np.full(replicas, 20)))
advanced = over_steps.lower(*arguments).compile()
pages = int(open("/proc/self/statm").read().split()[0])
most = pages * resource.getpagesize() + 440 * 2**20
resource.setrlimit(resource.RLIMIT_AS, (most, most))
threads = len(os.listdir("/proc/self/task"))
statuses = np.asarray(advanced(*arguments)).tolist()
assert len(os.listdir("/proc/self/task")) <= threads, "a thread goes on"
# of a replica without memory nothing is written, which may be anything
assert set(statuses) <= {Status.ok, Status.capacity, Status.nonfinite}, statuses
"""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "6"}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
