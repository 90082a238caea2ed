"""A replica has the same results wherever its batch runs: on one device, on several, or on those of
several hosts.
"""

import os
import socket
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flows import GRAINS, of_state

from jaxgran.dynamics.batch import stack
from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.tally import TABLE
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains, own_grains
from jaxgran.model.state import State
from jaxgran.sampling.observe import advance_batch

PROGRAM = Path(__file__).with_name("devices.py")
RESTITUTIONS = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9)  # more than four devices, and not a multiple
STEPS = (120, 90, 60, 0, 120, 30)

# as NumPy names leaves
WAVES = f"arr_{len(fields(State)) + len(fields(Grains)) - 1 + list(TABLE).index('wave_kinetic')}"


def lattice(packing_fraction: float, seed: int) -> State:
    """Grains at rest on a square lattice, moved and thrown a little: they collide within some
    steps.
    """
    rng, grains = np.random.default_rng(seed), own_grains(np.ones(GRAINS))
    side = np.sqrt(np.pi / 4 * GRAINS / packing_fraction)
    rows = int(np.ceil(np.sqrt(GRAINS)))
    places = np.stack(np.divmod(np.arange(GRAINS), rows), axis=-1) * side / rows
    velocities = 3 * rng.normal(size=places.shape)
    return State(
        grains, jnp.asarray(places), jnp.asarray(velocities), jnp.asarray(side), jnp.asarray(0.0)
    )


@pytest.fixture
def batch(tmp_path: Path) -> Path:
    """A folder with the states of a batch and its results on the one device of this process."""
    states = [lattice(nu, seed) for seed, nu in enumerate((0.4, 0.5, 0.4, 0.5, 0.4, 0.5))]
    state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    flow = of_state(stack([ShearFlow(GRAINS, alpha, 0.6, 1e-3) for alpha in RESTITUTIONS]), state)
    assert jax.device_count() == 1
    numerics = Numerics()
    _save(tmp_path / "start.npz", (flow, numerics, state, np.asarray(STEPS, np.int32)))
    end, tally = advance_batch(flow, numerics, state, jnp.asarray(STEPS, jnp.int32))
    assert np.all(np.asarray(tally.collisions)[np.asarray(STEPS) > 0] > 0)
    _save(tmp_path / "one device.npz", (end, tally))
    return tmp_path


def test_results_on_four_devices_are_those_on_one_to_the_bit(batch: Path) -> None:
    _run(batch, "four devices.npz", 4)
    _assert_same(batch / "four devices.npz", batch / "one device.npz")


@pytest.mark.environment
def test_results_in_lockstep_on_four_devices_are_those_on_one_to_the_bit(batch: Path) -> None:
    """As on accelerators: ``vmap`` over the replicas of a device. Waves are equal to the rounding
    of a cosine.
    """
    _run(batch, "one.npz", 1, "lockstep")
    _run(batch, "four.npz", 4, "lockstep")
    _assert_same(batch / "four.npz", batch / "one.npz", rounded=WAVES)


@pytest.mark.environment
def test_results_on_two_hosts_are_those_on_one_to_the_bit_and_both_hold_all(batch: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    hosts = [_start(batch, f"host {k}.npz", 2, address, str(k)) for k in (0, 1)]
    for k, host in enumerate(hosts):
        _, error = host.communicate(timeout=300)
        assert host.returncode == 0, error
        _assert_same(batch / f"host {k}.npz", batch / "one device.npz")


def _save(path: Path, tree) -> None:
    np.savez(path, *[np.asarray(leaf) for leaf in jax.tree.leaves(tree)])


def _assert_same(one: Path, other: Path, rounded: str = "") -> None:
    with np.load(one) as these, np.load(other) as those:
        assert these.files == those.files
        for name in these.files:
            if name == rounded:
                np.testing.assert_allclose(
                    these[name], those[name], rtol=4 * np.finfo(float).eps, atol=0
                )
            else:
                np.testing.assert_array_equal(these[name], those[name])


def _start(folder: Path, output: str, devices: int, *words: str) -> subprocess.Popen:
    # The sums of the older emitter depend on what else is in an array; users have the newer one.
    flags = os.environ["XLA_FLAGS"].replace("fusion_emitters=false", "fusion_emitters=true")
    environment = os.environ | {
        "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count={devices}"
    }
    command = [sys.executable, str(PROGRAM), "start.npz", output, str(GRAINS), *words]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, env=environment, **streams)


def _run(folder: Path, output: str, devices: int, *words: str) -> None:
    process = _start(folder, output, devices, *words)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
