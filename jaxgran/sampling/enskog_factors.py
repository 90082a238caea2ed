"""Which assumption of kinetic theory fails: contact stresses and dissipation rate over Enskog's, as
five factors.

Enskog's rates of transfer and loss assume, one after the other, that all peculiar motion is
relative to the neighbours, that velocities are isotropic, that the two velocities of a collision
are independent, that pairs at contact are as many as in equilibrium, and that collisions are
binary. Each factor is the rate with one more of these measured, over the rate before. So their
product times Enskog's rate is the measured one, exactly.

=================  =================================================================================
factor             what is measured
=================  =================================================================================
local_temperature  the local granular temperature: E(T_l I)/E(T I), with E the rate of
                   ``collisional_transfer``, T the
                   granular temperature, T_l the local one and I the identity
anisotropy         the temperature tensor, scaled to T_l: E(T)/E(T_l I)
chaos              the speed of approach: (V/V(T))² of a stress and (V/V(T))³ of the dissipation
                   rate, with V the mean of the speed over collisions weighted by the stress that
                   they carry (by the pressure, for the dissipation rate), and V(T) the same of
                   independent grains
pairs              the pairs at contact: B/E(T) over the factor chaos, with B the rate of the same
                   approaches as binary collisions
binary             the impulses: C/B, with C the measured rate
=================  =================================================================================

The local temperature is relative to the mean velocity of boxes of about 25 grains. In larger
systems it hardly changes. The granular temperature, to which long waves add, still grows at 25,600
grains (page "System size").

A binary stress is the density of pairs at contact times ⟨g²⟩, the mean square of the speed of
approach g over these pairs. A mean over pairs is a sum of 1/g over collisions. Where grains
collapse onto each other this sum diverges, as does the number of collisions, while those of g, g²
and g³ stay finite. So the scale of the speed is Σ g² over Σ g, which pairs that hardly move do not
change. What the factor ``pairs`` counts are the pairs that carry the stress. It is the contact
value over that of equilibrium if the speeds have the shape of the theory's, whatever their scale.

The correlation length of extended kinetic theory is L = Γ_E/Γ in mean diameters, with Γ_E = E(T) of
the dissipation rate Γ. In L′ = (Γ_E/p_E)/(Γ/p), with the contact pressure p and Enskog's p_E, the
contact values cancel. Both follow from the factors: for discs of one size L′ is chaos^(−1/2) of the
pressure times its factor ``binary`` over that of Γ.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxgran.dynamics.tally import Tally
from jaxgran.model.checks import InputError
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.sampling.correlation_strain import mass_of_grains
from jaxgran.sampling.prediction import size_classes
from jaxgran.sampling.sample import Sample, lengths
from jaxgran.statistics import Estimates, standard_errors
from jaxgran.theory.enskog import Collisions, collisional_transfer, enskog_collisions
from jaxgran.theory.mixture import mixture_of

RATES = {  # the stress that weights the speed of approach, and the power of this speed
    "pressure": ("pressure", 2),
    "shear_stress": ("shear_stress", 2),
    "dissipation_rate": ("pressure", 3),
}
LENGTHS = {
    "correlation_length": "Enskog's dissipation rate over the measured one, at the local "
    "temperature",
    "correlation_length_from_pressure": "the same quotient of the dissipation rates over the "
    "contact pressures",
}
_TOGETHER = 256  # tensors of one call: one compiled program serves samples of any number of blocks


def measured_over_enskog(
    flow: ShearFlow, seeds: Sequence[Sample], grains: Grains | None = None
) -> tuple[Estimates, Estimates]:
    """The factors of contact stresses and dissipation rate, and Enskog's rates, with
    ``standard_errors``.

    Args:
      flow: parameters of the samples.
      seeds: samples of replicas of this flow.
      grains: discs in the proportions of those of the flow; None where their diameters are uniform
        and their masses the squares of these.

    Raises:
      InputError: (a ValueError) ``grains`` is None, and size or mass of the discs is not that of
        uniform diameters; or the masses of ``grains`` are not proportional to the squares of their
        diameters: heavy and light grains then have temperatures of their own, which Enskog's rates
        at one temperature would count among the other factors.

    Returns:
      Values and errors by name: ``pressure_chaos`` and so on for each of ``RATES`` and
        ``theory.assumptions.ASSUMPTIONS``, dimensionless; ``enskog_pressure`` and
        ``enskog_shear_stress`` in m/t² and ``enskog_dissipation_rate`` in m/t³, of isotropic
        Gaussian velocities at the measured granular temperature; ``correlation_length`` L and
        ``correlation_length_from_pressure`` L′ in σ. What would be a quotient by zero is NaN, such
        as a factor without collisions or of the dissipation rate of elastic grains.
    """
    if grains is None:
        _require_uniform(flow, seeds[0])
    else:
        _require_one_material(grains)
    classes = None if grains is None else size_classes(grains)
    sums = jax.tree.map(
        lambda *x: np.stack([np.asarray(part) for part in x]), *(seed.tally for seed in seeds)
    )
    return standard_errors(
        partial(_factors, flow, classes, np.asarray(seeds[0].area)), sums, *lengths(seeds)
    )


def _require_uniform(flow: ShearFlow, sample: Sample) -> None:
    """Raise an InputError if the mean d² or the mean mass is not within 1e-3 that of
    ``polydisperse`` discs.
    """
    uniform = 1 + flow.polydispersity**2 * (1 - 1 / flow.grains**2) / 3
    mass = mass_of_grains(flow.packing_fraction, sample.area)
    if not np.allclose([mass, sample.mass], flow.grains * uniform, rtol=1e-3):
        raise InputError(
            "grains must be given, as those of the samples have no uniform diameters d or not the "
            "masses d²."
        )


def _require_one_material(grains: Grains) -> None:
    """Raise an InputError unless masses are proportional to the squares of the diameters."""
    density = np.asarray(grains.masses) / np.square(grains.radii)
    if not np.allclose(density, density[0], rtol=1e-3):
        raise InputError(
            "grains must have masses proportional to the squares of their diameters: heavy and "
            "light grains have temperatures of their own, and the factors are of one for all."
        )


def _factors(
    flow: ShearFlow, classes: Any, area: np.ndarray, tally: Tally
) -> dict[str, np.ndarray]:
    """Factors, Enskog's rates and correlation lengths of tallies with one leading axis."""
    volume = area * tally.duration
    measured = _rates(tally.contact_moment / volume[:, None, None], tally.dissipation / volume)
    binary = _rates(tally.binary_moment / volume[:, None, None], tally.binary_dissipation / volume)
    speeds = _stresses(tally.binary_speed_moment / volume[:, None, None])
    tensor = tally.kinetic_moment / (flow.grains * tally.duration)[:, None, None]
    granular = np.trace(tensor, axis1=1, axis2=2)[:, None, None] / 2
    local = (tally.local_kinetic / tally.duration)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        temperatures = granular * np.eye(2), local * np.eye(2), local / granular * tensor
        (enskog, _), (isotropic, _), (chaotic, chaotic_speeds) = (
            _enskog(flow, classes, tensor) for tensor in temperatures
        )
        factors = {}
        for name, (weight, power) in RATES.items():
            speed = speeds[weight] / binary[weight] * chaotic[weight] / chaotic_speeds[weight]
            of_rate = {
                "local_temperature": isotropic[name] / enskog[name],
                "anisotropy": chaotic[name] / isotropic[name],
                "chaos": speed**power,
                "pairs": binary[name] / chaotic[name] / speed**power,
                "binary": measured[name] / binary[name],
            }
            factors |= {f"{name}_{factor}": x for factor, x in of_rate.items()} | {
                f"enskog_{name}": enskog[name]
            }
        length = chaotic["dissipation_rate"] / measured["dissipation_rate"]
        factors["correlation_length"] = length
        factors["correlation_length_from_pressure"] = (
            length * measured["pressure"] / chaotic["pressure"]
        )
    return {name: np.where(np.isfinite(x), x, np.nan) for name, x in factors.items()}


def _rates(stress: Array | np.ndarray, dissipation_rate: Array | np.ndarray) -> dict[str, Any]:
    """The rates by the names of ``RATES``, from stresses (..., 2, 2) and dissipation rates
    (...).
    """
    return {**_stresses(stress), "dissipation_rate": dissipation_rate}


def _stresses(stress: Array | np.ndarray) -> dict[str, Any]:
    """Pressure and shear stress of tensors (..., 2, 2)."""
    return {
        "pressure": np.trace(stress, axis1=-2, axis2=-1) / 2,
        "shear_stress": -stress[..., 0, 1],
    }


def _enskog(
    flow: ShearFlow, classes: Any, tensors: Array | np.ndarray
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Rates of ``collisional_transfer`` at tensors (rows, 2, 2), and its stresses times the speed
    of approach.
    """
    tensors, count = np.asarray(tensors, float), len(tensors)
    numbers = [
        np.asarray(x)
        for x in (flow.restitution, flow.packing_fraction, flow.shear_rate, flow.polydispersity)
    ]
    filled = tensors[np.arange(-(-count // _TOGETHER) * _TOGETHER) % count].reshape(
        -1, _TOGETHER, 2, 2
    )
    parts = [_collisional_transfer(part, classes, *numbers) for part in filled]
    collisions = jax.tree.map(
        lambda *x: np.concatenate([np.asarray(part, np.float64) for part in x])[:count], *parts
    )
    return _rates(collisions.stress, collisions.dissipation_rate), _stresses(
        collisions.speed_stress
    )


@jax.jit
def _collisional_transfer(
    tensors: Float[Array, "tensors 2 2"], classes: Any, *numbers: Array
) -> Collisions:
    if classes is None:
        return jax.vmap(lambda tensor: collisional_transfer(tensor, *numbers))(tensors)
    alpha, nu, rate, _ = numbers
    mixture = mixture_of(nu, *classes)
    return jax.vmap(lambda tensor: enskog_collisions(tensor, alpha, rate, mixture))(tensors)
