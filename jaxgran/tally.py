"""Tally: running sums of one sample, and the averages that follow from them.

While a sample runs its sums are kept in a few small arrays (``Sums``), since a loop that carries two dozen scalars
spends its time on them; ``tally`` gives them their names in the end.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


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
    kinetic_moment     (2, 2)   mσ²γ̇    ∫ Σ m c ⊗ c dt, exact along the flights
    dissipation        ()       mσ²γ̇²   energy lost in contacts, −½ Σ p (u⁻ + u⁺)
    contacts           ()       –       contacts of the steps in which a network was solved
    loaded_contacts    ()       –       contacts that carry an impulse
    collisions         ()       –       contacts that approach
    solves             ()       –       networks solved
    iterations         ()       –       solver iterations
    unconverged        ()       –       solves that ended above the tolerance
    residual           ()       –       relative residuals of the solves
    largest_overlap    ()       σ       (the largest) overlap of a contact
    status             ()       –       (the worst) status
    =================  =======  ======  ==========================================================================
    """

    duration: Float[Array, "*b"]
    steps: Float[Array, "*b"]
    impulse: Float[Array, "*b"]
    binary_impulse: Float[Array, "*b"]
    contact_moment: Float[Array, "*b 2 2"]
    binary_moment: Float[Array, "*b 2 2"]
    kinetic_moment: Float[Array, "*b 2 2"]
    dissipation: Float[Array, "*b"]
    contacts: Float[Array, "*b"]
    loaded_contacts: Float[Array, "*b"]
    collisions: Float[Array, "*b"]
    solves: Float[Array, "*b"]
    iterations: Float[Array, "*b"]
    unconverged: Float[Array, "*b"]
    residual: Float[Array, "*b"]
    largest_overlap: Float[Array, "*b"]
    status: Int[Array, "*b"]

    def __add__(self, other: "Tally") -> "Tally":
        total = jax.tree.map(jnp.add, self, other)
        return Tally(
            **{
                **vars(total),
                "largest_overlap": jnp.maximum(self.largest_overlap, other.largest_overlap),
                "status": jnp.maximum(self.status, other.status),
            }
        )


def empty_tally(dtype: jnp.dtype) -> Tally:
    """The tally of no time at all."""
    return empty_sums(dtype).tally()


class Sums(NamedTuple):
    """A tally in the making.

    ===============  =======  =====================================================================================
    field            shape    sum of
    ===============  =======  =====================================================================================
    flights          (5,)     time, steps, and the integrals of Σ m c_x c_x, Σ m c_x c_y, Σ m c_y c_y
    contacts         (5, 5)   over contacts: (1, l n_x n_x, l n_x n_y, l n_y n_y, loss per impulse), l the distance,
                              times (p, binary p, used, loaded, approaching)
    solves           (4,)     networks solved, iterations, unconverged solves, relative residuals
    largest_overlap  ()       (the largest) overlap of a contact
    status           ()       (the worst) status
    ===============  =======  =====================================================================================
    """

    flights: Float[Array, "5"]
    contacts: Float[Array, "5 5"]
    solves: Float[Array, "4"]
    largest_overlap: Float[Array, ""]
    status: Int[Array, ""]

    def tally(self) -> Tally:
        """The tally with its named fields."""

        def tensor(components: Array) -> Array:
            return components[jnp.asarray([0, 1, 1, 2])].reshape(2, 2)

        return Tally(
            duration=self.flights[0],
            steps=self.flights[1],
            impulse=self.contacts[0, 0],
            binary_impulse=self.contacts[0, 1],
            contact_moment=tensor(self.contacts[1:4, 0]),
            binary_moment=tensor(self.contacts[1:4, 1]),
            kinetic_moment=tensor(self.flights[2:]),
            dissipation=self.contacts[4, 0],
            contacts=self.contacts[0, 2],
            loaded_contacts=self.contacts[0, 3],
            collisions=self.contacts[0, 4],
            solves=self.solves[0],
            iterations=self.solves[1],
            unconverged=self.solves[2],
            residual=self.solves[3],
            largest_overlap=self.largest_overlap,
            status=self.status,
        )


def empty_sums(dtype: jnp.dtype) -> Sums:
    """The sums of no time at all."""
    return Sums(
        flights=jnp.zeros(5, dtype),
        contacts=jnp.zeros((5, 5), dtype),
        solves=jnp.zeros(4, dtype),
        largest_overlap=jnp.zeros((), dtype),
        status=jnp.int32(0),
    )
