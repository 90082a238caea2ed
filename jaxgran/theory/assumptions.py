"""What Enskog's kinetic theory assumes, in the order in which measurements replace the assumptions.

The contact pressure is calculated with one more of them measured, over that before: five factors,
by the names of the assumptions (``sampling.enskog_factors``).
"""

from typing import NamedTuple


class Assumption(NamedTuple):
    """An assumption in words."""

    label: str
    statement: str  # a clause
    measured: str  # what is measured, and what is assumed in its place
    assumed: str


ASSUMPTIONS = {
    "local_temperature": Assumption(
        "local temperature",
        "the granular temperature equals the local one",
        "the measured local temperature",
        "the granular temperature",
    ),
    "anisotropy": Assumption(
        "anisotropy",
        "velocities are isotropic",
        "the measured temperature tensor",
        "an isotropic one",
    ),
    "chaos": Assumption(
        "molecular chaos",
        "velocities of colliding grains are independent",
        "the measured speed of approach",
        "that of independent velocities",
    ),
    "pairs": Assumption(
        "pairs at contact",
        "as many pairs are at contact as in equilibrium",
        "the measured pairs at contact",
        "those of equilibrium",
    ),
    "binary": Assumption(
        "binary collisions",
        "collisions are binary",
        "the measured impulses",
        "those of binary collisions",
    ),
}

NEGLIGIBLE = 0.02
"""An assumption is not said to fail if the logarithm of its factor is within this of zero."""
