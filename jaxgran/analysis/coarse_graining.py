"""Coarse-graining functions, which spread a grain over the plane and a contact along its branch.

Each is normalised in the plane and has a closed-form line integral. To add one, supply the four
fields of ``Kernel``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jaxtyping import Array, Float

from jaxgran.model.checks import require_number

_ON_CENTRE = 1e-100  # squared widths: a line with b² at or below this passes through the centre


class Kernel(NamedTuple):
    """A coarse-graining function of unit width, g(q), normalised in the plane; all lengths are in
    widths.

    =============  ==============  =================================================================
    field          signature       meaning
    =============  ==============  =================================================================
    value          q² → g          the function
    line           s, b² → ()      ∫₀ˢ g(√(b² + t²)) dt along a line at the distance b from the
                                   centre
    second_moment  number          ∫ g q_x² d²q
    reach          number          distance beyond which g is zero or negligible
    =============  ==============  =================================================================
    """

    value: Callable[[Array], Array]
    line: Callable[[Array, Array], Array]
    second_moment: float
    reach: float


def _root(square: Array) -> Array:
    """Square root with derivative zero at zero, for use in odd powers from the third."""
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _in_disc(s: Array, b2: Array) -> Array:
    """s clipped to the chord of the unit disc at the distance b from the centre; zero outside the
    disc.
    """
    half = jnp.sqrt(jnp.where(b2 < 1, 1 - b2, 1))
    return jnp.where(b2 < 1, jnp.clip(s, -half, half), 0)


def _lucy_value(q2: Array) -> Array:
    return jnp.where(q2 < 1, 5 / jnp.pi * (1 - 6 * q2 + 8 * q2 * _root(q2) - 3 * q2**2), 0)


def _lucy_line(s: Array, b2: Array) -> Array:
    s, off_centre = _in_disc(s, b2), b2 > _ON_CENTRE
    s2, b = s**2, jnp.sqrt(jnp.where(off_centre, b2, 1))
    q2 = b2 + s2
    cubic = s * _root(q2) * (2 * q2 + 3 * b2) + jnp.where(
        off_centre, 3 * b2**2 * jnp.arcsinh(s / b), 0
    )  # 8 ∫ q³
    return (
        5
        / jnp.pi
        * (s - s * (6 * b2 + 2 * s2) + cubic - s * (3 * b2**2 + 2 * b2 * s2 + 0.6 * s2**2))
    )


GAUSSIAN = Kernel(
    value=lambda q2: jnp.exp(-q2 / 2) / (2 * jnp.pi),
    line=lambda s, b2: jnp.exp(-b2 / 2) * erf(s / np.sqrt(2.0).item()) / (8 * jnp.pi) ** 0.5,
    second_moment=1.0,
    reach=6.0,
)
LUCY = Kernel(_lucy_value, _lucy_line, 5 / 56, 1.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CoarseGraining:
    """A coarse-graining function G of given width, made by ``gaussian`` or ``lucy``.

    ======  ======  ====  ======================================
    field   shape   unit  meaning
    ======  ======  ====  ======================================
    width   ()      σ     factor that scales the unit kernel
    kernel  static  –     the function at unit width
    ======  ======  ====  ======================================
    """

    width: float | Array
    kernel: Kernel = field(metadata={"static": True})

    def value(self, separations: Float[Array, "n 2"]) -> Float[Array, " n"]:
        """G at the separations of a point from the grains, in 1/σ²."""
        per_width, (x, y) = 1 / self.width, separations.T
        return self.kernel.value((x * x + y * y) * per_width**2) * per_width**2

    def segment(
        self,
        separations: Float[Array, "n 2"],
        normals: Float[Array, "n 2"],
        lengths: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """∫₀¹ G along branches, in 1/σ².

        ===========  ======  ====  =================================================
        argument     shape   unit  meaning
        ===========  ======  ====  =================================================
        separations  (n, 2)  σ     of one point from the middles of the branches
        normals      (n, 2)  –     unit vectors along the branches
        lengths      (n,)    σ     of the branches, positive
        ===========  ======  ====  =================================================
        """
        per_width, (x, y), (nx, ny) = 1 / self.width, separations.T, normals.T
        along, across, half = nx * x + ny * y, (nx * y - ny * x) * per_width, lengths / 2
        start, end, line, b2 = (
            (along - half) * per_width,
            (along + half) * per_width,
            self.kernel.line,
            across**2,
        )
        return (line(end, b2) - line(start, b2)) * (per_width / lengths)

    @property
    def second_moment(self) -> float | Array:
        """∫ G x² d²r = ∫ G y² d²r, in σ²."""
        return self.kernel.second_moment * self.width**2

    @property
    def reach(self) -> float | Array:
        """Distance beyond which G is zero or, for the Gaussian, negligible, in σ."""
        return self.kernel.reach * self.width


def gaussian(width: float | Array) -> CoarseGraining:
    """The Gaussian exp(−r²/2w²)/2πw² of standard deviation w (σ); smooth, not truncated within the
    cell.
    """
    return _of_width(width, GAUSSIAN)


def lucy(radius: float | Array) -> CoarseGraining:
    """Lucy's function 5/(πc²) (1 + 3r/c)(1 − r/c)³ inside a radius c (σ), with two continuous
    derivatives.
    """
    return _of_width(radius, LUCY)


def _of_width(width: float | Array, kernel: Kernel) -> CoarseGraining:
    require_number(
        "the width of the coarse-graining",
        width,
        lambda x: (x > 0) & np.isfinite(x),
        "positive and at most what fits into the cell",
    )
    return CoarseGraining(width, kernel)
