"""Doorways of a floor plan, and door leaves that stand in them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.arrays import F32, F64, I64
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.clutter import Furniture, Prism
from pc2grid.submaps.skeleton import clearance_of, skeleton_of

_WIDTH_M = (0.6, 1.3)  # of a doorway: inner doors are 0.7 to 1.1 m wide
_BESIDE_M, _WIDER = 0.7, 1.25  # so far before and behind a doorway there is this many times the clearance
_APART_M = 1.0  # between two doorways
_LEAF_M, _HEIGHT_M = 0.05, 2.05  # thickness and height of a leaf
_OPEN_RAD = (math.radians(60.0), math.radians(110.0))  # angles at which an open leaf is left


@dataclass(frozen=True, slots=True)
class Doorway:
    """A gap between two walls. a_m, b_m : (x, y) where it touches them, map frame."""

    a_m: tuple[float, float]
    b_m: tuple[float, float]

    @property
    def width_m(self) -> float:
        """Distance between the walls."""
        return math.dist(self.a_m, self.b_m)

    def leaf(self, angle_rad: float, *, at_b: bool = False) -> Furniture:
        """A door leaf that hangs at one of the walls, turned by an angle from where it closes the gap."""
        hinge, other = (self.b_m, self.a_m) if at_b else (self.a_m, self.b_m)
        yaw = math.atan2(other[1] - hinge[1], other[0] - hinge[0]) + angle_rad
        half, w = _LEAF_M / 2, self.width_m
        outline = np.array([(0.0, -half), (w, -half), (w, half), (0.0, half)])
        return Furniture("door", SE2(*hinge, yaw), outline, (Prism(outline, 0.0, _HEIGHT_M),))


def open_angle(rng: np.random.Generator) -> float:
    """Angle of a door that stands open, to either side."""
    return float(rng.uniform(*_OPEN_RAD)) * (1.0 if rng.random() < 0.5 else -1.0)


def find_doorways(plan: OccupancyGrid) -> tuple[Doorway, ...]:
    """The doorways of a plan, narrowest first: short gaps between walls with more room on both sides.

    They are looked for along the middle lines of the free space. A door that is drawn closed is a wall.
    """
    walls: I64 = np.argwhere(plan.occupied)
    if not len(walls) or not plan.free.any():
        return ()
    tree = cKDTree(plan.to_point(walls))
    least_m, most_m = _WIDTH_M
    clearance = clearance_of(~plan.occupied, plan.resolution_m)
    middle = skeleton_of(plan.free, plan.resolution_m, 0.5 * least_m - plan.resolution_m)
    cells = np.argwhere(middle & (clearance <= 0.5 * most_m + plan.resolution_m))
    cells = cells[np.argsort(clearance[cells[:, 0], cells[:, 1]], kind="stable")]
    found: list[Doorway] = []
    middles: list[F64] = []
    for point in plan.to_point(cells):
        if any(np.hypot(*(point - other)) < _APART_M for other in middles):
            continue
        doorway = _at(plan, clearance, tree, walls, point)
        if doorway is not None:
            found.append(doorway)
            middles.append(point)
    return tuple(found)


def _at(plan: OccupancyGrid, clearance: F32, tree: Any, walls: I64, point: F64) -> Doorway | None:
    """The doorway whose middle is at a point (2,), None if there is none."""
    half_m, nearest = tree.query(point)
    a = plan.to_point(walls[[nearest]])[0]
    across = (point - a) / max(half_m, 1e-9)
    steps = np.arange(0.0, _WIDTH_M[1] - half_m + plan.resolution_m, plan.resolution_m / 2)
    beyond = plan.to_cell(point + steps[:, None] * across)
    height, width = plan.cells.shape
    inside = np.all((beyond >= 0) & (beyond < (height, width)), axis=1)
    beyond = beyond[inside]
    solid = np.flatnonzero(plan.occupied[beyond[:, 0], beyond[:, 1]])
    if not len(solid):
        return None
    b = point + steps[inside][solid[0]] * across
    if not _WIDTH_M[0] <= float(np.hypot(*(b - a))) <= _WIDTH_M[1]:
        return None
    along = np.array((-across[1], across[0])) * _BESIDE_M
    beside = plan.to_cell(np.array([point + along, point - along]))
    if (beside < 0).any() or (beside >= (height, width)).any():
        return None
    roomy = clearance[beside[:, 0], beside[:, 1]] > _WIDER * half_m
    if not (roomy & plan.free[beside[:, 0], beside[:, 1]]).all():
        return None
    return Doorway((float(a[0]), float(a[1])), (float(b[0]), float(b[1])))
