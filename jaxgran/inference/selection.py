"""Selection of candidates for a fit: above the noise, binary, and each collision once.

The fit and the design of experiments share these rules, so that the latter predicts the error of the former.
"""

import numpy as np
from jaxtyping import Bool
from scipy.special import chdtri

from jaxgran.inference.collision_model import Collisions, Fitted
from jaxgran.inference.collisions import straight_drift

FEWEST = 4  # collisions needed to infer a restitution
_UNLIKELY = 1e-3  # probability that a true collision misfits by more than the cut
_CLEAR = 4.0  # least normal velocity, in standard errors
_APART = 2.0  # windows within which a pair cannot collide twice
_AT_ONCE = 1.0  # windows within which a disc cannot collide twice


def largest_misfit(collisions: Collisions) -> np.ndarray:
    """χ² above which a candidate is not a binary collision, (collisions,)."""
    return chdtri(collisions.freedom, _UNLIKELY)


def of_two_discs(collisions: Collisions, fitted: Fitted) -> Bool[np.ndarray, " collisions"]:
    """Which candidates are above the noise, without a third disc."""
    clear = fitted.normal_velocity > _CLEAR * fitted.normal_error
    return clear & straight_drift(collisions.pairs)


def without_repeats(collisions: Collisions, fitted: Fitted, chosen: np.ndarray) -> Bool[np.ndarray, " collisions"]:
    """Which of the chosen candidates remain when each collision is counted once, though several windows may contain it.

    The candidate with the most frames remains, and among equals the one with the least misfit.
    """
    pairs, kept = collisions.pairs, np.zeros(len(chosen), bool)
    contact = pairs.window + fitted.unknowns[:, 2] / pairs.duration
    taken: dict[tuple, list] = {}
    for k in np.lexsort((fitted.misfit / collisions.freedom, -collisions.freedom)):
        others = taken.setdefault(tuple(pairs.grains[k]), [])
        if chosen[k] and all(abs(contact[k] - other) > _APART for other in others):
            kept[k] = True
            others.append(contact[k])
    # A disc collides with one other at a time: of two pairs with a common disc that fit one change, keep the better
    of_disc: dict[int, list] = {}
    for k in np.argsort((fitted.misfit + pairs.drift) / (collisions.freedom + np.maximum(pairs.drift_freedom, 0))):
        others = [of_disc.setdefault(int(disc), []) for disc in pairs.grains[k]]
        if kept[k] and all(abs(contact[k] - other) > _AT_ONCE for times in others for other in times):
            for times in others:
                times.append(contact[k])
        else:
            kept[k] = False
    return kept


def struck_windows(
    collisions: Collisions, fitted: Fitted, used: np.ndarray, frames: int, grains: int
) -> Bool[np.ndarray, "windows grains"]:
    """Windows in which each disc takes part in a used collision."""
    struck, pairs = np.zeros((frames - 1, grains), bool), collisions.pairs
    contact = pairs.window + fitted.unknowns[:, 2] / pairs.duration
    windows = np.clip(np.floor(contact), 0, len(struck) - 1).astype(int)
    for disc in (0, 1):
        struck[windows[used], pairs.grains[used, disc]] = True
    return struck
