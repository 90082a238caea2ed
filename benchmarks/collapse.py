"""What a time step does to an inelastic collapse: three and four equal discs in a row.

Alternate collisions of neighbours follow a linear law. Let x_k be the speed of approach of collision k. Then

    x_{k+2} = c (1 + r)/2 x_{k+1} − r x_k,    c = 1 for three discs, and √2 for four that move symmetrically,

because a collision passes the share (1 + r)/2 of its approach to the neighbours and turns the rest around. (Four discs in
symmetric motion are two discs and a wall. x of the middle pair is divided by √2 here.) The roots λ± of
λ² − c (1 + r)/2 λ + r = 0 are real below r_c = tan²(π/12) = 7 − 4√3 = 0.0718 for three discs (Zhou and Kadanoff 1996),
and below r_c = tan²(π/8) = 3 − 2√2 = 0.1716 for these four (Bernu and Mazighi 1990). What follows:

- Above r_c there are at most ⌈π/θ⌉ collisions, cos θ = c (1 + r)/(4√r), whatever the start.
- Below r_c some starts collapse. The time between collisions falls by λ₋/λ₊ and the speed by λ₊ at each. A time step
  ends the collapse with one collision of all, where that time is as short. So the steps with contacts grow by
  1/log₁₀(λ₊/λ₋) for each decade of dt, and the excess of the force ratio falls as dt^β, β = ln(1/λ₊)/ln(λ₊/λ₋).

The threshold belongs to the worst start. The starts here are of this kind: for three discs the outer ones come in at
equal speeds, and four discs keep their symmetry. Counts are averaged over many first gaps, as each is a staircase.

    python -m benchmarks collapse           # a minute
    python -m benchmarks collapse --quick   # fewer gaps and time steps, half a minute
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output

THRESHOLDS = {3: 7 - 4 * np.sqrt(3), 4: 3 - 2 * np.sqrt(2)}
RESTITUTIONS = {3: (0.02, 0.04, 0.06, 0.08, 0.1, 0.2), 4: (0.05, 0.1, 0.15, 0.18, 0.2, 0.3)}
GAP, DURATION = 0.1, 0.5  # σ, and σ over the first speed: the flight to the first collision is a tenth
GRAINS, SIDE = 16, 20.0  # the discs that are not in the row rest elsewhere


class Roots(NamedTuple):
    """λ₊ and λ₋ of a collapse, the steps with contacts that a decade of dt adds, and the exponent β of the excess."""

    larger: float
    smaller: float

    @property
    def steps_per_decade(self) -> float:
        return 1 / np.log10(self.larger / self.smaller)

    @property
    def exponent(self) -> float:
        return -np.log(self.larger) / np.log(self.larger / self.smaller)


def half_trace(discs: int, restitution: float) -> float:
    """Half the sum of the roots, c (1 + r)/4."""
    return {3: 1.0, 4: np.sqrt(2)}[discs] * (1 + restitution) / 4


def roots(discs: int, restitution: float) -> Roots:
    """The roots below the threshold."""
    half = half_trace(discs, restitution)
    width = np.sqrt(half**2 - restitution)
    return Roots(half + width, half - width)


def most_collisions(discs: int, restitution: float) -> int:
    """Alternate collisions that any start can have, above the threshold; for four discs both outer ones count once."""
    return int(np.ceil(np.pi / np.arccos(half_trace(discs, restitution) / np.sqrt(restitution))))


def row(discs: int, gap: float) -> jg.State:
    """Three or four discs in a row with a middle gap or gaps, that the outer ones approach."""
    gaps, velocities = {3: ((GAP, gap), (1, 0, -1)), 4: ((GAP, gap, GAP), (1, 0, 0, -1))}[discs]
    others = np.arange(GRAINS - discs)
    rest = np.stack([2.0 + 2 * (others % 8), 10 + 2 * (others // 8)], axis=-1)
    line = np.stack([5 + np.cumsum([0, *(1 + np.array(gaps))]), np.full(discs, 4.0)], axis=-1)
    peculiar = np.zeros((GRAINS, 2))
    peculiar[:discs, 0] = velocities
    grains = jg.Grains(jnp.full(GRAINS, 0.5), jnp.ones(GRAINS))
    return jg.State(
        grains, jnp.asarray(np.concatenate([line, rest])), jnp.asarray(peculiar), jnp.asarray(SIDE), jnp.asarray(0.0)
    )
