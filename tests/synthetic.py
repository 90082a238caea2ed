"""Made-up tallies, replicas and snapshots, for tests of what follows after the flow."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax
import numpy as np
import pytest

from jaxgran.analysis.contacts import ForceNetwork
from jaxgran.contact.network import Contacts
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.dynamics.tally import TABLE, Tally
from jaxgran.maps.replica import Replica, ReplicaId
from jaxgran.maps.settings import MapSettings
from jaxgran.model.cell import minimum_image
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.model.state import State
from jaxgran.model.status import Status
from jaxgran.sampling.correlation_strain import mass_of_grains
from jaxgran.sampling.sample import BLOCKS, Sample

SNAPSHOTS = (
    1000  # a static choice, the same wherever snapshots of a flow are taken: one compilation
)


def random_tally(rng: np.random.Generator, *shape: int, status: int = 0) -> Tally:
    """Return a tally of positive sums, of whole steps and contacts, with any leading axes."""
    counts = {"steps", "solves", "iterations", "unconverged"}
    counts |= {"contacts", "loaded_contacts", "collisions"}
    values = {}
    for name in TABLE:
        tail = (2, 2) if name.endswith("moment") else ()
        values[name] = rng.gamma(20.0, 1.0, (*shape, *tail))
        if name in counts:
            values[name] = np.ceil(values[name])
    values |= {name: np.zeros(shape) for name in ("deep_contacts", "momentum_drift")}
    values["overlap"] *= 1e-4
    return Tally(**{**values, "status": np.full(shape, status, np.int32)})


def replica_id(settings: MapSettings, point: int, seed: int = 0) -> ReplicaId:
    """Return what identifies a replica by the number of its point and its seed from the first."""
    return ReplicaId(*settings.points[point], settings.first_seed + seed)


def random_replica(
    rng: np.random.Generator,
    settings: MapSettings,
    status: int = Status.ok,
    point: int = 0,
    seed: int = 0,
) -> Replica:
    """Return a replica of a map with random sums and a strain of 3 before the sample."""
    name = replica_id(settings, point, seed)
    flow = settings.flows[name.point]
    sample = sample_of_tally(random_tally(rng, BLOCKS, status=status), flow)
    return Replica(name, sample, int(status), 3.0)


def sample_of_tally(tally: Tally, flow: ShearFlow) -> Sample:
    """Return the sample of a tally, or of a batch of them, of grains of uniform diameters."""
    squares = flow.grains * (1 + flow.polydispersity**2 * (1 - flow.grains**-2) / 3)  # Σ d²
    area = np.pi / 4 * squares / flow.packing_fraction
    of_one = area, mass_of_grains(flow.packing_fraction, area), flow
    replicas = np.shape(tally.steps)[:-1]
    numbers = jax.tree.map(lambda x: np.full(replicas, x)[()], of_one)
    return Sample(tally, *numbers)


def random_instant(seed: int, grains: int = 20, pairs: int = 7) -> ForceNetwork:
    """Return grains at random places in a cell of side 10, with pairs of random forces."""
    rng = np.random.default_rng(seed)
    return ForceNetwork(
        positions=rng.uniform(-5, 5, (grains, 2)),
        radii=rng.uniform(0.3, 0.7, grains),
        speed=rng.gamma(2.0, 1.0, grains),
        pairs=np.sort(rng.permuted(np.tile(np.arange(grains), (pairs, 1)), axis=1)[:, :2], axis=1),
        force=rng.gamma(1.0, 30.0, pairs),
        clustered=rng.random(pairs) < 0.5,
        side=10.0,
        tilt=0.2,
    )


def random_state(seed: int, grains: int = 20, side: float = 10.0) -> State:
    """Return grains of random sizes and velocities at random places of a cell."""
    rng = np.random.default_rng(seed)
    radii = rng.uniform(0.3, 0.7, grains)
    positions = rng.uniform(-side / 2, side / 2, (grains, 2))
    velocities = rng.normal(size=(grains, 2))
    return State(
        Grains(radii, 4 * radii**2), positions, velocities, np.float64(side), np.float64(0.2)
    )


def one_sentence(message: str) -> bool:
    """Whether a message is one line that starts with a word and ends with a full stop."""
    return message.count("\n") == 0 and message.endswith(".") and not message.endswith("..")


@contextmanager
def refused(words: str = ".") -> Iterator[pytest.ExceptionInfo]:
    """An ``InputError`` of one sentence, in which the words are found, is raised."""
    with pytest.raises(InputError, match=words) as caught:
        yield caught
    assert one_sentence(str(caught.value))


def snapshot_of(
    positions, contacts=None, velocities=None, radii=0.5, side=40.0, tilt=0.0, shear_rate=1.0
) -> Snapshot:
    """Snapshots of (times, grains, 2), with contacts (i, j, impulse) of each, at unit time step."""
    positions = np.asarray(positions, float)
    times, grains = positions.shape[:2]
    radii = np.broadcast_to(np.asarray(radii, float), (times, grains))
    contacts = [[]] * times if contacts is None else contacts
    slots = max(1, *(len(c) for c in contacts))
    i, j = np.zeros((2, times, slots), int)
    impulses, used = np.zeros((times, slots)), np.zeros((times, slots), bool)
    for t, here in enumerate(contacts):
        for k, (a, b, p) in enumerate(here):
            i[t, k], j[t, k], impulses[t, k], used[t, k] = a, b, p, True
    time = np.arange(times)[:, None]
    apart = [r[a] - r[b] for r, a, b in zip(positions, i, j, strict=True)]
    branch = np.stack([minimum_image(x, side, tilt) for x in apart])
    branch = branch + np.where(used, 0, 1)[..., None]
    distances = np.linalg.norm(branch, axis=-1)
    every = np.ones(times)
    masses = 4 * radii**2
    normals, inverse = branch / distances[..., None], (1 / masses[time, k] for k in (i, j))
    network = Contacts(i, j, normals, distances, -impulses, *inverse, used)
    velocities = np.zeros_like(positions) if velocities is None else velocities
    state = State(Grains(radii, masses), positions, velocities, side * every, tilt * every)
    return Snapshot(
        state, network, impulses, every, shear_rate * every, 0.5 * every, 0 * time[:, 0]
    )
