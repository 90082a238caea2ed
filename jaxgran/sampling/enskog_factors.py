"""Which assumption of kinetic theory fails: the contact stress over Enskog's, as a product of four factors.

Enskog's rate of momentum transfer assumes, one after the other, that velocities are isotropic, that the two velocities
of a collision are independent, that pairs at contact are as many as in equilibrium, and that collisions are binary.
Each factor is the stress with one more of these measured, over the stress before. So their product times Enskog's
stress is the measured contact stress, exactly.

===========  ========================================================================================================
factor       what is measured
===========  ========================================================================================================
anisotropy   the temperature tensor T: E(T)/E(T I), with E the stress of ``momentum_transfer`` and I the identity
chaos        the speed of approach: (V/V(T))², with V the mean of the speed over collisions weighted by the stress
             that they carry, and V(T) the same of independent grains
pairs        the pairs at contact: (B/E(T))/(V/V(T))², with B the binary stress
binary       the impulses: C/B, with C the contact stress
===========  ========================================================================================================

The binary stress is the density of pairs at contact times ⟨g²⟩, the mean square of the speed of approach g over these
pairs. A mean over pairs is a sum of 1/g over collisions. Where grains collapse onto each other this sum diverges, as
does the number of collisions, while those of g and g² stay finite. So the scale of the speed is Σ g² over Σ g, which
pairs that hardly move do not change. What the factor ``pairs`` counts are the pairs that carry the stress. It is the
contact value over that of equilibrium if the speeds have the shape of the theory's, whatever their scale.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.dynamics.tally import Tally
from jaxgran.model.flow import ShearFlow
from jaxgran.sampling.sample import Sample
from jaxgran.statistics import Estimates, standard_errors
from jaxgran.theory.enskog import momentum_transfer

STRESSES = {"pressure": "pressure", "shear_stress": "shear stress"}
FACTORS = {  # what is measured, and what is assumed in its place
    "anisotropy": ("the measured temperature tensor", "an isotropic one"),
    "chaos": ("the measured speed of approach", "that of independent velocities"),
    "pairs": ("the measured pairs at contact", "those of equilibrium"),
    "binary": ("the measured impulses", "those of binary collisions"),
}
_TOGETHER = 256  # tensors of one call: one compiled program serves samples of any number of blocks


def stress_factors(flow: ShearFlow, seeds: Sequence[Sample]) -> tuple[Estimates, Estimates]:
    """The four factors of pressure and shear stress, and Enskog's stress, with ``standard_errors``.

    Args:
      flow: parameters of the samples.
      seeds: samples of replicas of this flow.

    Returns:
      Values and errors by name: ``pressure_chaos`` and so on for each of ``STRESSES`` and ``FACTORS``, dimensionless;
      ``enskog_pressure`` and ``enskog_shear_stress``, in m/t², of isotropic Gaussian velocities at the measured
      granular temperature. A factor is NaN where a stress is zero.
    """
    sums = jax.tree.map(lambda *x: np.stack([np.asarray(one) for one in x]), *(seed.tally for seed in seeds))
    return standard_errors(partial(_losses, flow, np.asarray(seeds[0].area)), sums)


def _losses(flow: ShearFlow, area: np.ndarray, tally: Tally) -> dict[str, np.ndarray]:
    """Factors and Enskog's stresses of tallies with one leading axis."""
    volume = (area * tally.duration)[:, None, None]
    contact, binary = _parts(tally.contact_moment / volume), _parts(tally.binary_moment / volume)
    speed_binary = _parts(tally.binary_speed_moment / volume)
    tensor = tally.kinetic_moment / (flow.grains * tally.duration)[:, None, None]
    isotropic = np.trace(tensor, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(2)
    (enskog, _), (stress, speed_stress) = (_transfer(flow, one) for one in (isotropic, tensor))
    losses = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for name in STRESSES:
            chaos = (speed_binary[name] / binary[name] * stress[name] / speed_stress[name]) ** 2
            factors = {
                "anisotropy": stress[name] / enskog[name],
                "chaos": chaos,
                "pairs": binary[name] / stress[name] / chaos,
                "binary": contact[name] / binary[name],
            }
            losses |= {f"{name}_{factor}": np.where(np.isfinite(x), x, np.nan) for factor, x in factors.items()}
            losses[f"enskog_{name}"] = enskog[name]
    return losses


def _parts(stress: Array | np.ndarray) -> dict[str, Any]:
    """Pressure and shear stress of tensors (..., 2, 2)."""
    return {"pressure": np.trace(stress, axis1=-2, axis2=-1) / 2, "shear_stress": -stress[..., 0, 1]}


def _transfer(flow: ShearFlow, tensors: Array | np.ndarray) -> list[dict[str, Any]]:
    """Pressure and shear stress of ``momentum_transfer``, and the same times the speed, at tensors (rows, 2, 2)."""
    tensors, count = np.asarray(tensors, float), len(tensors)
    numbers = [np.asarray(x) for x in (flow.restitution, flow.packing_fraction, flow.shear_rate, flow.polydispersity)]
    filled = tensors[np.arange(-(-count // _TOGETHER) * _TOGETHER) % count].reshape(-1, _TOGETHER, 2, 2)
    found = [_momentum_transfer(part, *numbers) for part in filled]
    return [_parts(np.concatenate([np.asarray(one[k], np.float64) for one in found])[:count]) for k in range(2)]


@persistent_jit
def _momentum_transfer(tensors: Float[Array, "tensors 2 2"], *numbers: Array) -> Any:
    return jax.vmap(lambda tensor: momentum_transfer(tensor, *numbers))(tensors)
