"""Tally: running sums of one sample, and the averages that follow from them."""

from dataclasses import dataclass

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
    zero, moment = jnp.zeros((), dtype), jnp.zeros((2, 2), dtype)
    shapes = {name: moment if name.endswith("moment") else zero for name in Tally.__dataclass_fields__}
    return Tally(**{**shapes, "status": jnp.int32(0)})
