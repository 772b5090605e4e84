"""Measures of a fit: the shape of its weights, its model's errors, and its exam."""

import numpy as np
import numpy.typing as npt


def informative(noise: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Which footprints say something, by their `footprint_noise`, any shape; NaN says nothing.

    A footprint does not if the unweighted buffer is no farther from the policy's steps than two
    halves of these are from each other.
    """
    return np.abs(np.asarray(noise, np.float64)) < 1
