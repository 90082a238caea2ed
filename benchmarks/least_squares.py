"""Linear least squares of points with errors."""

import numpy as np


def weighted_fit(
    design: np.ndarray, y: np.ndarray, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Constants c of y = design @ c with the smallest χ², their covariance, and χ²; a row of the
    design is a point.
    """
    scaled = design / errors[:, None]
    constants, *_ = np.linalg.lstsq(scaled, y / errors, rcond=None)
    return (
        constants,
        np.linalg.inv(scaled.T @ scaled),
        np.sum((y / errors - scaled @ constants) ** 2),
    )
