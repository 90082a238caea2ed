"""Tally: running sums of one sample, and the averages that follow from them.

While a sample runs its sums are kept in a few small arrays (``Sums``), since a loop that carries two dozen scalars
spends its time on them; ``tally`` gives them their names in the end.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

EXTREMES = ("largest_overlap", "worst_residual", "momentum_drift", "status")  # joined by the larger one, not added
RESIDUAL_EDGES = np.logspace(-16, 0, 65)  # bounds of the bins in which relative residuals are counted

FLAT_SUMS = 5, 40, 43, 110, 112, 113  # where the fields of ``Sums`` after the first begin in its numbers, and its end


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Tally:
    """Sums over the steps of a sample of one replica; ``+`` joins two samples.

    =================  =======  ======  ==========================================================================
    field              shape    unit    sum of
    =================  =======  ======  ==========================================================================
    duration           ()       1/γ̇     time
    steps              ()       –       time steps, counted as a float (they exceed an int32)
    impulse            ()       mσγ̇     contact impulses p
    binary_impulse     ()       mσγ̇     (1+α) μ₁₂ max(0, −u⁻), the impulses if every collision were binary
    contact_moment     (2, 2)   mσ²γ̇    σ ⊗ p n over the contacts, σ the centre-to-centre vector
    binary_moment      (2, 2)   mσ²γ̇    the same with the binary impulses
    cluster_moment     (2, 2)   mσ²γ̇    the contact moment of clusters of three or more grains that push at once
    kinetic_moment     (2, 2)   mσ²γ̇    ∫ Σ m c ⊗ c dt, exact along the flights
    dissipation        ()       mσ²γ̇²   energy lost in contacts, −½ Σ p (u⁻ + u⁺)
    complementarity    ()       mσ²γ̇²   ½ Σ p (u⁺ + α u⁻), zero where a solve is exact
    energy_change      ()       mσ²γ̇²   growth of the kinetic energy ½ Σ m c²
    contacts           ()       –       contacts of the steps in which a network was solved
    loaded_contacts    ()       –       contacts that carry an impulse
    collisions         ()       –       contacts that approach
    solves             ()       –       networks solved
    iterations         ()       –       solver iterations
    unconverged        ()       –       solves that ended above the tolerance
    residual_counts    (64,)    –       solves by relative residual, in the bins between ``RESIDUAL_EDGES``
    overlap            ()       σ       overlaps of the contacts of solved networks
    largest_overlap    ()       σ       (the largest) overlap of a contact
    worst_residual     ()       –       (the largest) relative residual of a solve
    momentum_drift     ()       –       (the largest) |Σ m c| over Σ m |c|, at the end
    status             ()       –       (the worst) status
    =================  =======  ======  ==========================================================================
    """

    duration: Float[Array, "*b"]
    steps: Float[Array, "*b"]
    impulse: Float[Array, "*b"]
    binary_impulse: Float[Array, "*b"]
    contact_moment: Float[Array, "*b 2 2"]
    binary_moment: Float[Array, "*b 2 2"]
    cluster_moment: Float[Array, "*b 2 2"]
    kinetic_moment: Float[Array, "*b 2 2"]
    dissipation: Float[Array, "*b"]
    complementarity: Float[Array, "*b"]
    energy_change: Float[Array, "*b"]
    contacts: Float[Array, "*b"]
    loaded_contacts: Float[Array, "*b"]
    collisions: Float[Array, "*b"]
    solves: Float[Array, "*b"]
    iterations: Float[Array, "*b"]
    unconverged: Float[Array, "*b"]
    residual_counts: Float[Array, "*b 64"]
    overlap: Float[Array, "*b"]
    largest_overlap: Float[Array, "*b"]
    worst_residual: Float[Array, "*b"]
    momentum_drift: Float[Array, "*b"]
    status: Int[Array, "*b"]

    def __add__(self, other: "Tally") -> "Tally":
        return jax.tree.map(lambda *both: jnp.stack(both), self, other).total(axis=0)

    def total(self, axis: int | tuple[int, ...]) -> "Tally":
        """The tally of all that stands along leading axes: sums, and the larger of each of ``EXTREMES``."""
        return Tally(**{name: x.max(axis) if name in EXTREMES else x.sum(axis) for name, x in vars(self).items()})


def empty_tally(dtype: jnp.dtype) -> Tally:
    """The tally of no time at all."""
    zero = jnp.zeros((), dtype)
    return empty_sums(dtype).tally(zero, zero)


def flat_tally(tally: Tally, shape: tuple[int, ...]) -> np.ndarray:
    """All numbers of a tally with leading axes of the given shape, (*shape, numbers) in double precision."""
    leaves = [np.asarray(leaf, np.float64).reshape(*shape, -1) for leaf in jax.tree.leaves(tally)]
    return np.concatenate(leaves, axis=-1)


def tally_from_flat(numbers: np.ndarray, dtype: jnp.dtype) -> Tally:
    """The tally whose numbers ``flat_tally`` has put together, bit for bit."""
    leaves, structure = jax.tree.flatten(empty_tally(dtype))
    edges = np.cumsum([leaf.size for leaf in leaves])[:-1]
    parts = zip(np.split(numbers, edges, axis=-1), leaves, strict=True)
    shape = numbers.shape[:-1]
    return jax.tree.unflatten(structure, [x.reshape(*shape, *leaf.shape).astype(leaf.dtype) for x, leaf in parts])


class Sums(NamedTuple):
    """A tally in the making.

    ===============  =======  =====================================================================================
    field            shape    sum of
    ===============  =======  =====================================================================================
    flights          (5,)     time, steps, and the integrals of Σ m c_x c_x, Σ m c_x c_y, Σ m c_y c_y
    contacts         (7, 5)   over contacts: (1, l n_x n_x, l n_x n_y, l n_y n_y, loss per impulse, overlap,
                              (u⁺ + α u⁻)/2), l the distance, times (p, binary p, used, loaded, approaching)
    clusters         (3,)     (l n_x n_x, l n_x n_y, l n_y n_y) p over contacts in clusters
    solves           (67,)    networks solved, iterations, unconverged solves, and the counts by residual
    largest          (2,)     (the largest) overlap of a contact and relative residual of a solve
    status           ()       (the worst) status
    own              pytree   what an observer of the user's has found, see ``observer``; () where there is none
    ===============  =======  =====================================================================================
    """

    flights: Float[Array, "5"]
    contacts: Float[Array, "7 5"]
    clusters: Float[Array, "3"]
    solves: Float[Array, "67"]
    largest: Float[Array, "2"]
    status: Int[Array, ""]
    own: Any = ()

    def tally(self, energy_change: Array, momentum_drift: Array) -> Tally:
        """The tally with its named fields, two of which are known from the ends of the advance."""

        def tensor(components: Array) -> Array:
            return components[jnp.asarray([0, 1, 1, 2])].reshape(2, 2)

        return Tally(
            duration=self.flights[0],
            steps=self.flights[1],
            impulse=self.contacts[0, 0],
            binary_impulse=self.contacts[0, 1],
            contact_moment=tensor(self.contacts[1:4, 0]),
            binary_moment=tensor(self.contacts[1:4, 1]),
            cluster_moment=tensor(self.clusters),
            kinetic_moment=tensor(self.flights[2:]),
            dissipation=self.contacts[4, 0],
            complementarity=self.contacts[6, 0],
            energy_change=energy_change,
            contacts=self.contacts[0, 2],
            loaded_contacts=self.contacts[0, 3],
            collisions=self.contacts[0, 4],
            solves=self.solves[0],
            iterations=self.solves[1],
            unconverged=self.solves[2],
            residual_counts=self.solves[3:],
            overlap=self.contacts[5, 2],
            largest_overlap=self.largest[0],
            worst_residual=self.largest[1],
            momentum_drift=momentum_drift,
            status=self.status,
        )


def empty_sums(dtype: jnp.dtype) -> Sums:
    """The sums of no time at all."""
    return Sums(
        flights=jnp.zeros(5, dtype),
        contacts=jnp.zeros((7, 5), dtype),
        clusters=jnp.zeros(3, dtype),
        solves=jnp.zeros(3 + RESIDUAL_EDGES.size - 1, dtype),
        largest=jnp.zeros(2, dtype),
        status=jnp.int32(0),
    )
