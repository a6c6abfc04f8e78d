"""Random subsets of a cloud, the same in every run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def random_subset(length: int, count: int) -> NDArray[np.intp]:
    """Return at most `count` of the indices below `length`, random and in increasing order.

    The seed is `length`, so that equal input gives equal output. The choice is random because a regular
    one, every n-th pixel of a camera or beam of a lidar, moves with the sensor and pulls ICP towards
    standing still.
    """
    if length <= count:
        return np.arange(length)
    return np.sort(np.random.default_rng(length).choice(length, count, replace=False, shuffle=False))
