"""Mixtures of a few size classes."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Mixture(NamedTuple):
    """A size distribution represented by a few classes."""

    diameters: Float[Array, " classes"]
    masses: Float[Array, " classes"]
    number_densities: Float[Array, " classes"]  # grains per unit area
    # number density of the second class times the contact diameter and χ
    encounters: Float[Array, "classes classes"]

    @property
    def contact_diameters(self) -> Float[Array, "classes classes"]:
        return (self.diameters[:, None] + self.diameters[None, :]) / 2

    @property
    def reduced_masses(self) -> Float[Array, "classes classes"]:
        m_i, m_j = self.masses[:, None], self.masses[None, :]
        return m_i * m_j / (m_i + m_j)


def uniform_mixture(nu: Float[Array, ""], width: Float[Array, ""], size_classes: int) -> Mixture:
    """Diameters distributed uniformly in σ ± width."""
    nodes, weights = np.polynomial.legendre.leggauss(size_classes)
    diameters = 1 + width * jnp.asarray(nodes, nu.dtype)
    return mixture_of(nu, diameters, diameters**2, jnp.asarray(weights / 2, nu.dtype))


def mixture_of(nu: Float[Array, ""], diameters: Array, masses: Array, fractions: Array) -> Mixture:
    """A mixture of classes with given diameters, masses and number fractions, each (classes,)."""
    mean, mean_square = jnp.sum(fractions * diameters), jnp.sum(fractions * diameters**2)
    densities = fractions * nu / (jnp.pi / 4 * mean_square)
    d_i, d_j = diameters[:, None], diameters[None, :]
    chi = mixture_contact_value(d_i, d_j, nu, mean, mean_square)
    return Mixture(diameters, masses, densities, densities[None, :] * (d_i + d_j) / 2 * chi)


def mixture_contact_value(d_i: Any, d_j: Any, nu: Any, mean: Any, mean_square: Any) -> Any:
    """Contact value χ of discs of diameters d_i and d_j (broadcast) in an equilibrium mixture; of
    JAX or NumPy arrays.

    χ_ij = 1/(1 − ν) + (9/8) d_i d_j/(d_i + d_j) ν⟨d⟩/⟨d²⟩/(1 − ν)², with ν the packing fraction of
    the mixture and ⟨d⟩ and ⟨d²⟩ of its diameters. For discs of one size it is Henderson's value.

    Source: J. T. Jenkins and F. Mancini, J. Appl. Mech. 54, 27 (1987).
    """
    return 1 / (1 - nu) + 9 / 8 * d_i * d_j / (d_i + d_j) * nu * mean / mean_square / (1 - nu) ** 2
