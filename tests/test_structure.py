"""Structure of known networks is found again, and that of a flow obeys the laws of shear."""

import jax
import numpy as np
import pytest
from flows import GRAINS
from synthetic import SNAPSHOTS, refused, snapshot_of

from jaxgran.analysis.contacts import cluster_share, clusters, loaded_contacts
from jaxgran.analysis.series import series
from jaxgran.contact.projected_methods import BarzilaiBorwein
from jaxgran.dynamics.snapshot import Snapshot
from jaxgran.dynamics.snapshots import snapshot_series
from jaxgran.model.flow import ShearFlow


@pytest.fixture(scope="module")
def flow() -> ShearFlow:
    return ShearFlow(GRAINS, 0.5, 0.75, 1e-3)


@pytest.fixture(scope="module")
def seen(flow, flowing) -> Snapshot:
    return series(
        snapshot_series(flow, flowing(0.75), 200.0, SNAPSHOTS, solver=BarzilaiBorwein(1e-8))[1]
    )


CHAIN_AND_PAIR = [(0, 1, 2.0), (2, 1, 1.0), (3, 4, 1.0), (4, 5, 0.0)]
ROW = np.array([[1.0, 1], [2, 1], [3, 1], [1, 5], [1, 6], [1, 7], [20, 20]])


def test_a_chain_of_three_and_a_pair() -> None:
    seen = snapshot_of(ROW[None], [CHAIN_AND_PAIR])
    found = clusters(seen)
    np.testing.assert_array_equal(found.sizes, [[3, 3, 3, 2, 2, 1, 1]])
    assert (
        len(set(found.labels[0, :3])) == 1
        and found.labels[0, 3] == found.labels[0, 4] != found.labels[0, 0]
    )
    carried = cluster_share(seen)
    np.testing.assert_allclose(carried.contacts.value, 2 / 3)
    np.testing.assert_allclose([carried.force.value, carried.pressure.value], 3 / 4)


def test_shares_of_shear_stress_follow_the_directions_of_contacts() -> None:
    slanted = np.array([[1, 1], [1.6, 0.2], [2.2, -0.6], [5, 5], [5.6, 5.8]])
    share = cluster_share(snapshot_of(slanted[None], [[(0, 1, 1.0), (1, 2, 1.0), (3, 4, 0.5)]]))
    # the pair is loaded the other way
    np.testing.assert_allclose(share.shear_stress.value, 2 / 1.5)
    np.testing.assert_allclose(share.pressure.value, 2 / 2.5)


def test_times_are_apart_and_errors_come_from_their_blocks() -> None:
    both = snapshot_of(np.stack([ROW, ROW]), [CHAIN_AND_PAIR, [(0, 1, 1.0)]])
    np.testing.assert_array_equal(clusters(both).sizes[1], [2, 2, 1, 1, 1, 1, 1])
    assert np.isfinite(cluster_share(both).force.error)
    one = jax.tree.map(lambda x: x[0], both)
    batch = jax.tree.map(lambda x: np.stack([x, x]), both)
    with refused("those of one flow"):
        clusters(batch)
    share = cluster_share(one)
    assert share.force.value == 0.75 and np.isnan(share.force.error)


# A real flow: polydisperse, dense, with clusters


def test_clusters_of_two_are_binary_collisions(flow, seen) -> None:
    load, sizes = loaded_contacts(seen), clusters(seen).sizes
    slot = np.nonzero(seen.contacts.used & (seen.impulses > 0))
    contacts = seen.contacts
    reduced = 1 / (contacts.inverse_mass_i[slot] + contacts.inverse_mass_j[slot])
    binary = (1 + flow.restitution) * reduced * -contacts.approach[slot] / flow.timestep
    alone = sizes[load.time, load.i] == 2
    assert alone.sum() > 100 and (~alone).sum() > 100
    np.testing.assert_allclose(
        load.force[alone], binary[alone], rtol=1e-4, atol=1e-6 * binary.mean()
    )
    share = cluster_share(seen)
    excess = load.force[~alone].sum() / binary[~alone].sum() - 1
    assert excess > 0.1 and 0.2 < share.force.value < 0.95
