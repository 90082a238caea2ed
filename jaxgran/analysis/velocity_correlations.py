"""Tests of the assumptions of kinetic theory on snapshots: velocity distribution and pairs at contact.

Enskog theory assumes that two grains about to collide have independent (molecular chaos), nearly Gaussian velocities,
and that the number of such pairs is that of equilibrium, χ times that of random points.

A snapshot is taken before its contacts act, so the pairs about to collide are those that approach each other. Their
density over the gap g is extrapolated to contact: the sum over approaching pairs with 0 ≤ g < ε, weighted by
W(g) = (9 − 36 g/ε + 30 g²/ε²)/ε, is the value at g = 0 of the least-squares parabola.

Overlapping pairs have no weight: a contact may act up to half a step's flight after touching, so they would be counted
twice. Receding pairs are excluded because they describe the previous collision, and because they are depleted within
a step's flight of contact.

Snapshots are analysed on the host; standard errors come from blocks of times, see ``series``.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from jaxgran.analysis.series import Measured, Sums, all_pairs, ratio, series, with_errors
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.theory.mixture import mixture_contact_value

SIZE_CLASSES = 3  # classes of equally many grains
WIDEST_SHELL = 0.1  # σ, largest range of gaps of an extrapolation to contact
_ANGLES = 32  # contact directions on the half circle; the integrand is smooth and periodic
_TINY = np.finfo(float).tiny  # avoids a division by zero


class VelocityDistribution(NamedTuple):
    """One-particle distribution of the peculiar velocities c, each scaled by its mass: w = √m c.

    ==================  =========  ======  ============================================================================
    field               shape      unit    meaning
    ==================  =========  ======  ============================================================================
    temperature         ()         mσ²γ̇²   T = ⟨w²⟩/2
    tensor              (2, 2)     mσ²γ̇²   ⟨w w⟩, of trace 2T
    anisotropy          ()         –       (T_xx − T_yy)/2T
    shear               ()         –       T_xy/T
    sonine              ()         –       a₂ of ⟨w⁴⟩ = 2⟨w²⟩²(1 + a₂)
    sonine_excess       ()         –       a₂ less that of an anisotropic Gaussian
    size_classes        (classes,) σ       mean diameters of classes of equally many grains
    size_temperatures   (classes,) mσ²γ̇²   T of each class; equal under equipartition
    size_tensors        (classes,  mσ²γ̇²   ⟨w w⟩ of each class
                        2, 2)
    ==================  =========  ======  ============================================================================

    An anisotropic Gaussian has ⟨w⁴⟩ = (tr S)² + 2 tr S² with S = ⟨w w⟩, hence a₂ = (anisotropy² + shear²)/2.
    If the temperature varies between grains or in time, its relative variance adds to a₂.
    """

    temperature: Measured
    tensor: Measured
    anisotropy: Measured
    shear: Measured
    sonine: Measured
    sonine_excess: Measured
    size_classes: Float[np.ndarray, " classes"]
    size_temperatures: Measured
    size_tensors: Measured


class NearContact(NamedTuple):
    """Approaching pairs at contact, measured and relative to Enskog theory at the measured temperatures.

    ====================  ======  =====  =========================================================================
    field                 shape   unit   meaning
    ====================  ======  =====  =========================================================================
    contact_value         ()      –      χ: approaching pairs over those of random points
    contact_ratio         ()      –      contact_value over the χ of an equilibrium mixture
    collision_rate        ()      –      collisions per grain and unit strain; each grain counts all its collisions
    rate_ratio            ()      –      collision_rate over Enskog's
    binary_stress         (2, 2)  mγ̇²    collisional stress of kinetic theory, summed over these pairs
    speed_ratio           ()      –      ⟨u_n²⟩ over that of independent Gaussian velocities
    velocity_correlation  ()      –      ⟨w_i·w_j⟩/2T, w = √m c; 0 for independent velocities
    ====================  ======  =====  =========================================================================

    The binary stress is Σ^{ab} = (1/A) Σ W r n^a n^b (1 + α) μ u_n², μ the reduced mass and u_n the normal velocity. It
    gives the stress of the binary forces without any contact (Σ_bc of Lois, Lemaître and Carlson). Enskog's rate
    assumes isotropic directions; the speed ratio uses the measured ones, so fabric does not enter. The collision rate
    counts encounters, not the steps in which a lasting contact continues to approach.

    Source for χ before, not after, the collision: R. Soto and M. Mareschal, Phys. Rev. E 63, 041303 (2001).
    """

    contact_value: Measured
    contact_ratio: Measured
    collision_rate: Measured
    rate_ratio: Measured
    binary_stress: Measured
    speed_ratio: Measured
    velocity_correlation: Measured


def velocity_distribution(snapshots: Snapshot) -> VelocityDistribution:
    """Temperature tensor, equipartition and kurtosis of the peculiar velocities of a series of snapshots."""
    state = series(snapshots).state
    w = np.sqrt(state.grains.masses)[..., None] * state.velocities
    square = np.sum(w**2, axis=-1)
    radii = state.grains.radii[0]
    members = np.array_split(np.argsort(radii), SIZE_CLASSES)
    class_sums = np.stack([np.einsum("tia,tib->tab", w[:, m], w[:, m]) for m in members], axis=1)
    sums = {
        "grains": np.ones((len(w), 1, 1, 1)) * np.array([len(m) for m in members])[:, None, None],
        "ww": class_sums,
        "fourth": np.sum(square**2, axis=1),
    }

    def estimate(s: Sums) -> Sums:
        tensors, grains = s["ww"] / s["grains"], s["grains"].sum(axis=-3)
        tensor = s["ww"].sum(axis=-3) / grains
        temperature = np.trace(tensor, axis1=-2, axis2=-1) / 2
        anisotropy = ratio(tensor[..., 0, 0] - tensor[..., 1, 1], 2 * temperature)
        shear = ratio(tensor[..., 0, 1], temperature)
        sonine = ratio(s["fourth"] / grains[..., 0, 0], 8 * temperature**2) - 1
        return {
            "temperature": temperature,
            "tensor": tensor,
            "anisotropy": anisotropy,
            "shear": shear,
            "sonine": sonine,
            "sonine_excess": sonine - (anisotropy**2 + shear**2) / 2,
            "size_temperatures": np.trace(tensors, axis1=-2, axis2=-1) / 2,
            "size_tensors": tensors,
        }

    diameters = np.array([2 * radii[m].mean() for m in members])
    return VelocityDistribution(**with_errors(estimate, sums), size_classes=diameters)


def contact_shell(packing_fraction: float) -> float:
    """Width ε (σ) of the shell of gaps around a grain that holds about one neighbour, (1 − ν)²/8ν, at most 0.1.

    The number of neighbours per unit gap is 8νχ at contact, and decays over about the gap that holds one neighbour.
    """
    return min(WIDEST_SHELL, (1 - packing_fraction) ** 2 / (8 * packing_fraction))


def near_contact(snapshots: Snapshot, shell: float | None = None) -> NearContact:
    """Contact value, collision rate, binary stress and velocity correlation of the pairs at contact.

    Args:
      snapshots: a series. Snapshots closer in time than a pair takes to cross the shell add little.
      shell: ε in σ, over which densities are extrapolated, by default ``contact_shell``. It should be several times the
        flight of a time step. If results keep changing as it narrows, as in clustering flows, the density has no limit
        at contact and the results are those of the pairs within ε.
    """
    frames = series(snapshots)
    state, velocities = frames.state, velocity_distribution(snapshots)
    radii, masses, side, shear_rate = state.grains.radii[0], state.grains.masses[0], state.side[0], frames.shear_rate[0]
    shell = shell or contact_shell(np.pi * np.sum(radii**2) / side**2)
    tensors = _grain_tensors(radii, velocities) / masses[:, None, None]  # of c
    rows = []
    for t, (i, j, separations) in enumerate(all_pairs(frames)):
        distances = np.linalg.norm(separations, axis=-1)
        gaps = distances - radii[i] - radii[j]
        near = (gaps >= 0) & (gaps < shell)
        i, j, distances, gaps = i[near], j[near], distances[near], gaps[near] / shell
        n = separations[near] / distances[:, None]
        c = state.velocities[t]
        sheared = shear_rate * distances * n[:, 0] * n[:, 1]
        u = np.sum((c[i] - c[j]) * n, axis=-1) + sheared
        weights = (u < 0) * (9 - 36 * gaps + 30 * gaps**2) / shell
        share, _, second = _approach_moments(sheared, _normal_variance(tensors, i, j, n))
        correlation = np.sqrt(masses[i] * masses[j]) * np.sum(c[i] * c[j], axis=-1)
        impulse = (1 + frames.restitution[t]) * masses[i] * masses[j] / (masses[i] + masses[j]) * -u
        moment = n.T @ ((weights * distances * impulse * -u)[:, None] * n)
        scalars = weights @ np.stack(
            [np.ones_like(u), -u, u**2, second / np.maximum(share, _TINY), correlation], axis=-1
        )
        temperature = np.sum(masses[:, None] * c**2) / (2 * len(masses))
        rows.append([*scalars, *moment.ravel(), temperature, 1.0])
    at_random, enskog, enskog_flux = _enskog(radii, masses, tensors, side, shear_rate)

    def estimate(s: Sums) -> Sums:
        mean = s["rows"] / s["rows"][..., -1:]
        pairs, flux, square, independent, correlation = np.moveaxis(mean[..., :5], -1, 0)
        temperature = mean[..., 9]
        heated = ratio(temperature, velocities.temperature.value)  # Enskog's rate goes as √T: common noise cancels
        return {
            "contact_value": ratio(pairs, at_random),
            "contact_ratio": ratio(pairs, enskog),
            "collision_rate": 2 * flux / (len(radii) * shear_rate),
            "rate_ratio": ratio(flux, enskog_flux * np.sqrt(heated)),
            "binary_stress": mean[..., 5:9].reshape(*mean.shape[:-1], 2, 2) / side**2,
            "speed_ratio": ratio(square, independent * heated),
            "velocity_correlation": ratio(correlation, 2 * temperature * pairs),
        }

    return NearContact(**with_errors(estimate, {"rows": np.array(rows)}))


def _grain_tensors(radii: np.ndarray, velocities: VelocityDistribution) -> Float[np.ndarray, "grains 2 2"]:
    """For each grain the temperature tensor of its size class, in mσ²γ̇²."""
    tensors = np.zeros((len(radii), 2, 2))
    classes = np.array_split(np.argsort(radii), SIZE_CLASSES)
    for members, tensor in zip(classes, velocities.size_tensors.value, strict=True):
        tensors[members] = tensor
    return tensors


def _normal_variance(tensors: np.ndarray, i: np.ndarray, j: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Variance of the relative velocity of independent grains along n (pairs, 2)."""
    x, y = n[..., 0], n[..., 1]
    relative = tensors[i] + tensors[j]
    return x * x * relative[:, 0, 0] + 2 * x * y * relative[:, 0, 1] + y * y * relative[:, 1, 1]


def _approach_moments(mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Averages of 1, −u and u² over the negative values of a Gaussian u."""
    deviation = np.sqrt(np.maximum(variance, _TINY))
    z = -mean / deviation
    share, bell = ndtr(z), np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    return share, deviation * (z * share + bell), variance * ((z**2 + 1) * share + z * bell)


def _enskog(
    radii: np.ndarray, masses: np.ndarray, tensors: np.ndarray, side: float, shear_rate: float
) -> tuple[float, float, float]:
    """Approaching pairs per gap at contact: for random points, with Enskog's χ, and the flux of the latter to contact.

    Each is a sum over all pairs of (d/A) ∮ dn, without or with χ, of a moment of Gaussian approach velocities.
    """
    i, j = np.triu_indices(len(radii), 1)
    contact_distances = radii[i] + radii[j]
    nu, mean, mean_square = np.pi * np.sum(radii**2) / side**2, 2 * radii.mean(), 4 * np.mean(radii**2)
    chi = mixture_contact_value(2 * radii[i], 2 * radii[j], nu, mean, mean_square)
    sums = np.zeros(3)
    for angle in (np.arange(_ANGLES) + 0.5) * np.pi / _ANGLES:
        n = np.array([np.cos(angle), np.sin(angle)])
        sheared = shear_rate * contact_distances * n[0] * n[1]
        share, first, _ = _approach_moments(sheared, _normal_variance(tensors, i, j, n))
        sums += contact_distances @ np.stack([share, chi * share, chi * first], axis=-1)
    at_random, enskog, flux = sums * 2 * np.pi / _ANGLES / side**2
    return at_random, enskog, flux
