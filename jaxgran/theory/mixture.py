"""Mixtures of a few size classes."""

from typing import NamedTuple

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
    """A mixture of classes with given diameters, masses and number fractions, each (classes,).

    The contact value of a pair is that of equilibrium, χ_ij = 1/(1 − ν) + (9/8) d_i d_j/(d_i + d_j)
    ν⟨d⟩/⟨d²⟩/(1 − ν)²: for discs of one size it is Henderson's.

    Source: J. T. Jenkins and F. Mancini, J. Appl. Mech. 54, 27 (1987).
    """
    mean, mean_square = jnp.sum(fractions * diameters), jnp.sum(fractions * diameters**2)
    densities = fractions * nu / (jnp.pi / 4 * mean_square)
    d_i, d_j = diameters[:, None], diameters[None, :]
    crowding = 9 / 8 * d_i * d_j / (d_i + d_j) * nu * mean / mean_square
    chi = 1 / (1 - nu) + crowding / (1 - nu) ** 2
    return Mixture(diameters, masses, densities, densities[None, :] * (d_i + d_j) / 2 * chi)
