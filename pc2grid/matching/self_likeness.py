"""How well a map fits onto itself, slid along: high in a bare corridor, low among rooms.

What fits onto itself elsewhere fits into other places of its kind as well: the walls that agree then say "a
corridor", not which one or where in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy import fft

from pc2grid.arrays import F64, U8
from pc2grid.matching.walls import Walls


@dataclass(frozen=True, slots=True, kw_only=True)
class LikenessParameters:
    """Which slides are compared. All chosen by hand.

    nearest_m, farthest_m : lengths of a slide, in any direction: farther than two hypotheses that are one,
        and about as far as a robot sees.
    cell_m : slides are multiples of about this, the spacing of wall points.
    overlap : at least this share of the walls lies on known ground, by weight, slid there and slid back. What
        a single scan knows hardly overlaps with itself, and is compared with nothing.
    """

    nearest_m: float = 1.0
    farthest_m: float = 8.0
    cell_m: float = 0.1
    overlap: float = 0.5


LIKENESS = LikenessParameters()


def self_likeness(walls: Walls, parameters: LikenessParameters = LIKENESS) -> float:
    """The best agreement of a map with itself, 0..1, over all slides; 0 if none overlaps enough.

    As of two maps (`two_way_score`): the geometric mean, forward and backward, of the mean likelihood of the
    wall points on known ground. All slides at once, as correlations by the fast Fourier transform.
    """
    total = walls.weight
    if total <= 0.0:
        return 0.0
    n = max(round(parameters.cell_m / walls.field.resolution_m), 1)
    cell_m = n * walls.field.resolution_m
    drawn = _drawn(walls, n)
    reach = round(parameters.farthest_m / cell_m)
    shape = [cv2.getOptimalDFTSize(n + reach) for n in drawn[0].shape]
    points, *grounds = (fft.rfft2(image, shape) for image in drawn)
    slides = np.arange(-reach, reach + 1)
    fits, overlap = (
        fft.irfft2(np.conj(points) * ground, shape)[np.ix_(slides, slides)] for ground in grounds
    )
    there = np.where(overlap > 1e-6, fits / np.maximum(overlap, 1e-6), 0.0)
    length_m = cell_m * np.hypot(slides[:, None], slides)
    enough = overlap >= parameters.overlap * total
    compared = (length_m >= parameters.nearest_m) & (length_m <= parameters.farthest_m)
    compared &= enough & enough[::-1, ::-1]
    both_ways = np.clip(there * there[::-1, ::-1], 0.0, 1.0)[compared]
    return math.sqrt(float(both_ways.max())) if len(both_ways) else 0.0


def _drawn(walls: Walls, n: int) -> tuple[F64, F64, F64]:
    """(H, W) each, in squares of n by n cells: weight of the wall points, mean likelihood of the known
    ground, and whether at least half of it is known."""
    field = walls.field
    height, width = (-(-side // n) for side in field.values.shape)

    def mean(values: U8) -> F64:
        short = ((0, height * n - values.shape[0]), (0, width * n - values.shape[1]))
        padded = np.pad(values, short)
        cells = (padded[row::n, column::n].astype(np.float64) for row in range(n) for column in range(n))
        return np.asarray(sum(cells) / n**2)

    share = mean(field.known.view(np.uint8))
    known = share >= 0.5
    on_known = mean(field.values * field.known) / 255.0
    likelihood = np.where(known, on_known / np.maximum(share, 0.5), 0.0)
    cells = np.floor((walls.points_m - np.asarray(field.origin_m)) / (n * field.resolution_m)).astype(np.intp)
    weights = np.zeros((height, width))
    np.add.at(weights, (cells[:, 1], cells[:, 0]), walls.weights)
    return weights, likelihood, known.astype(np.float64)
