"""Two maps brought together by features of their images, as the ROS package map_merge does.

Hoerner, "Map-merging for multi-robot system" (2016): the grids are images, ORB features are matched
each with its two nearest, and a similarity is found by RANSAC. Its confidence is that of Brown and Lowe,
"Automatic panoramic image stitching" (2007): inliers / (8 + 0.3 matches); from 1 on, the maps are joined. The
steps are those of OpenCV's stitching module, which map_merge calls, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid

CONFIDENT = 1.0
"""Confidence from which map_merge joins two maps (its `estimation_confidence`)."""
_FEATURES = 2000
"""At most so many of a map; more than any of the real maps has."""
_MATCH_CONFIDENCE = 0.3
"""Of a match beside the second best one; OpenCV's value for ORB."""


@dataclass(frozen=True, slots=True)
class Merge:
    """T_target_source with its confidence; None if no transform was found. scale : found, where 1 is true."""

    confidence: float
    T_target_source: SE2 | None
    scale: float = 1.0


def merge(target: OccupancyGrid, source: OccupancyGrid) -> Merge:
    """Bring two grids together; of two resolutions, the source is drawn in that of the target."""
    finder = cv2.ORB.create(nfeatures=_FEATURES)
    found = [
        cv2.detail.computeImageFeatures2(finder, image_of(grid, target.resolution_m))
        for grid in (source, target)
    ]
    if min(len(each.getKeypoints()) for each in found) < 6:
        return Merge(0.0, None)
    matcher = cv2.detail.AffineBestOf2NearestMatcher(False, False, _MATCH_CONFIDENCE)
    matched = matcher.apply(found[0], found[1])
    if matched.H is None or not np.size(matched.H):
        return Merge(float(matched.confidence), None)
    H = np.asarray(matched.H, np.float64)
    scale, yaw = math.hypot(H[0, 0], H[1, 0]), math.atan2(H[1, 0], H[0, 0])
    # Pixels are cells: rows grow with y, columns with x; the middle of the first one is half a cell inside.
    r = target.resolution_m
    half = np.array([0.5, 0.5]) * r
    from_m, to_m = np.array(source.origin_m) + half, np.array(target.origin_m) + half
    x, y = to_m + r * H[:2, 2] - H[:2, :2] @ from_m
    return Merge(float(matched.confidence), SE2(float(x), float(y), yaw), scale)


def image_of(grid: OccupancyGrid, resolution_m: float) -> NDArray[np.uint8]:
    """A grid as an image (H, W) of a resolution: occupied 0, unknown 205, free 254, as in map files."""
    image = np.where(grid.occupied, 0, np.where(grid.free, 254, 205)).astype(np.uint8)
    times = grid.resolution_m / resolution_m
    if times == 1.0:
        return image
    return np.asarray(cv2.resize(image, None, fx=times, fy=times, interpolation=cv2.INTER_AREA), np.uint8)
