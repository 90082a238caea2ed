"""What kinetic theory predicts for a batch of flows, as arrays of NumPy."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxgran.cache.persistent_jit import persistent_jit
from jaxgran.model.flow import ShearFlow
from jaxgran.model.grains import Grains
from jaxgran.theory.gaussian_moments import gaussian_moments, mixture_moments
from jaxgran.theory.steady_shear import SteadyShear

_TOGETHER = 16  # flows of one call: one compiled program serves batches of any size
_SIZE_CLASSES = 8  # of given grains; with more, averages of wide distributions hardly change
_LARGEST_RESTITUTION = 0.99  # the temperature diverges at α = 1


def kinetic_theory(
    restitution: ArrayLike,
    packing_fraction: ArrayLike,
    shear_rate: ArrayLike = 1.0,
    polydispersity: ArrayLike = 0.26,
    grains: Grains | None = None,
) -> SteadyShear:
    """``gaussian_moments`` of many flows, (replicas,) each; not finite where α is 1.

    Given grains, (grains,) or (replicas, grains), are taken as a mixture of ``size_classes``.
    """
    numbers = np.stack(
        np.broadcast_arrays(restitution, packing_fraction, shear_rate, polydispersity), axis=-1
    )
    count, given = len(numbers), () if grains is None else size_classes(grains)
    classes = [np.broadcast_to(x.astype(numbers.dtype), (count, _SIZE_CLASSES)) for x in given]
    places = np.arange(-(-count // _TOGETHER) * _TOGETHER).reshape(-1, _TOGETHER) % count
    parts = [_moments(numbers[some], *(x[some] for x in classes)) for some in places]
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


def predicted(flow: ShearFlow, grains: Grains | None = None) -> SteadyShear:
    """``kinetic_theory`` of every flow of a batch, with α at most 0.99, since T diverges at α =
    1.
    """
    numbers = (
        np.minimum(flow.restitution, _LARGEST_RESTITUTION),
        flow.packing_fraction,
        flow.shear_rate,
    )
    return kinetic_theory(*numbers, flow.polydispersity, grains)


@persistent_jit
def _moments(numbers: Float[Array, "flows 4"], *classes: Float[Array, "flows classes"]) -> Any:
    if not classes:
        return jax.vmap(gaussian_moments)(*numbers.T)
    alpha, nu, rate, _ = numbers.T
    return jax.vmap(mixture_moments)(alpha, nu, rate, *classes)


def size_classes(grains: Grains) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean diameters, mean masses and number fractions (..., 8) of classes of like grains, from
    grains (..., grains).

    From one class on, that one is divided by its diameters or its masses which lowers the variance
    within classes most. So up to eight species are the classes; of fewer the last is repeated,
    without grains.
    """
    radii, masses = np.asarray(grains.radii, float), np.asarray(grains.masses, float)
    discs = np.stack([radii / np.mean(radii, axis=-1, keepdims=True), masses], axis=-1)
    rows = [_classes_of(x) for x in discs.reshape(-1, *discs.shape[-2:])]
    columns = np.stack(rows).reshape(*radii.shape[:-1], _SIZE_CLASSES, 3)
    diameters, mean_masses, fractions = np.moveaxis(columns, -1, 0)
    return diameters, mean_masses, fractions


def _classes_of(discs: np.ndarray) -> np.ndarray:
    """Mean diameter, mean mass and number fraction (8, 3) of the classes of discs (grains, 2)."""
    species, counts = np.unique(discs, axis=0, return_counts=True)
    scaled = species / np.average(species, axis=0, weights=counts)
    parts = [_halves(scaled, counts, np.arange(len(counts)))]
    while len(parts) < _SIZE_CLASSES and any(part.halves for part in parts):
        widest = parts.pop(int(np.argmax([part.gain for part in parts])))
        parts += [_halves(scaled, counts, half) for half in widest.halves]
    rows = [
        (*np.average(species[x.whole], axis=0, weights=counts[x.whole]), counts[x.whole].sum())
        for x in parts
    ]
    rows += [(*rows[-1][:2], 0)] * (_SIZE_CLASSES - len(rows))
    return np.array(rows) / [1, 1, len(discs)]


class _Halves(NamedTuple):
    """A class of species by their numbers, its best division, and by how much this lowers the sum
    of squares within classes; 0 for a single species.
    """

    whole: np.ndarray
    halves: tuple[np.ndarray, ...]
    gain: float


def _halves(species: np.ndarray, counts: np.ndarray, whole: np.ndarray) -> _Halves:
    best = _Halves(whole, (), 0.0)
    for column in species[whole].T:
        order = whole[np.argsort(column, kind="stable")]
        number = np.cumsum(counts[order])[:, None]
        total = np.cumsum(counts[order, None] * species[order], axis=0)
        below, above = total[:-1] ** 2 / number[:-1], total[-1] - total[:-1]
        squares = below + above**2 / (number[-1] - number[:-1]) - total[-1] ** 2 / number[-1]
        gains = squares.sum(axis=1)
        if len(gains) and gains.max() > best.gain:
            cut = int(np.argmax(gains)) + 1
            best = _Halves(whole, (order[:cut], order[cut:]), float(gains[cut - 1]))
    return best
