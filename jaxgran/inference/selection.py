"""Which candidates are collisions that a fit may use: clear of the noise, of two discs alone, and each of them once.

The fit and the design of an experiment choose by the same rules, so that one predicts the error of the other.
"""

import numpy as np
from jaxtyping import Bool
from scipy.special import chdtri

from jaxgran.inference.collision_model import Collisions, Fitted
from jaxgran.inference.collisions import straight_drift

FEWEST = 4  # collisions from which a restitution is inferred
_UNLIKELY = 1e-3  # probability with which a true collision fits worse than the cut
_CLEAR = 4.0  # normal velocity of a collision that is used, over its error
_APART = 2.0  # windows within which a pair does not collide twice
_AT_ONCE = 1.0  # windows within which a disc does not collide twice, where it can be told


def largest_misfit(collisions: Collisions) -> np.ndarray:
    """χ² of each candidate, above which it is no collision of these two discs alone: (collisions,)."""
    return chdtri(collisions.freedom, _UNLIKELY)


def of_two_discs(collisions: Collisions, fitted: Fitted) -> Bool[np.ndarray, " collisions"]:
    """Which candidates are clear of the noise and took place in their window, with no third disc."""
    seen = collisions.seen
    clear = fitted.normal_velocity > _CLEAR * fitted.normal_error
    return clear & straight_drift(seen)


def without_repeats(collisions: Collisions, fitted: Fitted, chosen: np.ndarray) -> Bool[np.ndarray, " collisions"]:
    """Which of the chosen candidates are no repeats: one collision may be seen in several windows.

    Of these the one with the most frames is kept, and of those the one with the least misfit.
    """
    seen, kept = collisions.seen, np.zeros(len(chosen), bool)
    contact = seen.window + fitted.unknowns[:, 2] / seen.duration
    taken: dict[tuple, list] = {}
    for k in np.lexsort((fitted.misfit / collisions.freedom, -collisions.freedom)):
        others = taken.setdefault(tuple(seen.grains[k]), [])
        if chosen[k] and all(abs(contact[k] - other) > _APART for other in others):
            kept[k] = True
            others.append(contact[k])
    # A disc strikes one other at a time: where two pairs with a common disc fit one change, the better one is kept
    of_disc: dict[int, list] = {}
    for k in np.argsort((fitted.misfit + seen.drift) / (collisions.freedom + np.maximum(seen.drift_freedom, 0))):
        others = [of_disc.setdefault(int(disc), []) for disc in seen.grains[k]]
        if kept[k] and all(abs(contact[k] - other) > _AT_ONCE for times in others for other in times):
            for times in others:
                times.append(contact[k])
        else:
            kept[k] = False
    return kept


def struck_windows(
    collisions: Collisions, fitted: Fitted, used: np.ndarray, frames: int, grains: int
) -> Bool[np.ndarray, "windows grains"]:
    """In which windows each disc collides, by the collisions that are used."""
    struck, seen = np.zeros((frames - 1, grains), bool), collisions.seen
    contact = seen.window + fitted.unknowns[:, 2] / seen.duration
    windows = np.clip(np.floor(contact), 0, len(struck) - 1).astype(int)
    for disc in (0, 1):
        struck[windows[used], seen.grains[used, disc]] = True
    return struck
