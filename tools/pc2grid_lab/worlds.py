"""Simulated sessions in a plan whose doors and furniture differ from session to session."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from pc2grid import simulate
from pc2grid.geometry import F32, F64, I64, SE2, BoolGrid
from pc2grid.model import FREE, OccupancyGrid, SensorKind
from pc2grid.simulate import SimulationConfig
from pc2grid.simulate.plan import clearance_m
from pc2grid.simulate.scene import KINDS, Furniture, Prism, covered
from pc2grid.simulate.session import Session
from pc2grid.submaps.junction_graph import clearance_of, skeleton_of

_CHANGE = 6  # stream of random numbers beside those of `pc2grid.simulate.session`

_WIDTH_M = (0.6, 1.3)  # of a doorway: inner doors are 0.7 to 1.1 m wide
_BESIDE_M, _WIDER = 0.7, 1.25  # so far before and behind a doorway there is this many times the clearance
_APART_M = 1.0  # between two doorways
_LEAF_M, _HEIGHT_M = 0.05, 2.05  # thickness and height of a leaf
_CLOSED = 0.5  # share of the doors that are shut; the others stand open
_OPEN_RAD = (math.radians(60.0), math.radians(110.0))  # angles at which an open leaf is left
_KEPT_REACHABLE = 0.5  # share of the robot's space that closed doors leave in one part

_PIECE_M = (0.2, 1.8)  # shortest and longest side of a solid part that is furniture and not a wall
_STANDS_FREE = 0.5  # share of the cells around a piece that are free
_EXCHANGED = 0.3  # share of the changed furniture that is exchanged; the rest is moved
_MOVED_M, _TURNED_RAD, _TOP_M = 0.6, math.radians(25.0), 2.0  # standard deviations, and height of a piece


class WorldConfig(SimulationConfig):
    """One session in a world. The same configuration gives the same bytes."""

    change: float = Field(default=0.0, ge=0, le=1, description="share of doors and furniture that differ")


def prepare_session(*, sensor: SensorKind, grid: OccupancyGrid, config: WorldConfig) -> Session:
    """As `pc2grid.simulate.prepare_session`, in a plan that has changed."""
    plan, added = change_plan(grid, config)
    return simulate.prepare_session(sensor=sensor, grid=plan, config=config, added=added)


def change_plan(plan: OccupancyGrid, config: WorldConfig) -> tuple[OccupancyGrid, tuple[Furniture, ...]]:
    """The plan without the furniture that was moved, and what stands in it now: furniture and door leaves."""
    if not config.change:
        return plan, ()
    rng = np.random.default_rng([config.seed, _CHANGE])
    chosen = [piece for piece in _pieces(plan) if rng.random() < config.change]
    furniture = [_changed(_outline(piece, plan), rng) for piece in chosen]
    emptied = replace(plan, cells=np.where(np.any(chosen, axis=0), np.int8(FREE), plan.cells))
    doors: list[Furniture] = []
    for doorway in find_doorways(plan):
        if rng.random() >= config.change:
            continue
        leaf = doorway.leaf(0.0)
        if rng.random() >= _CLOSED or not _leaves_room(emptied, [*doors, leaf], config):
            angle_rad = float(rng.uniform(*_OPEN_RAD)) * (1.0 if rng.random() < 0.5 else -1.0)
            leaf = doorway.leaf(angle_rad, at_b=bool(rng.random() < 0.5))
        doors.append(leaf)
    return emptied, (*doors, *furniture)


def _pieces(plan: OccupancyGrid) -> list[BoolGrid]:
    """A mask (H, W) for each solid part that is small and stands free: furniture, not walls."""
    labels, _ = ndimage.label(plan.occupied, np.ones((3, 3), bool))
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        sides = sorted((s.stop - s.start) * plan.resolution_m for s in box)
        if sides[1] < _PIECE_M[0] or sides[1] > _PIECE_M[1]:
            continue
        around = tuple(slice(max(s.start - 2, 0), s.stop + 2) for s in box)
        part = labels[around] == number
        ring = ndimage.binary_dilation(part, np.ones((3, 3), bool)) & ~part
        if plan.free[around][ring].mean() >= _STANDS_FREE:
            mask = np.zeros(labels.shape, bool)
            mask[around] = part
            found.append(mask)
    return found


def _outline(mask: BoolGrid, plan: OccupancyGrid) -> F64:
    """Convex outline (N, 2) of the cells of a mask, map frame."""
    half = plan.resolution_m / 2
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    points = (plan.to_point(np.argwhere(mask))[:, None] + corners).reshape(-1, 2)
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


def _changed(outline_m: F64, rng: np.random.Generator) -> Furniture:
    """Something else in the place of a piece, or the piece as an upright prism, some decimetres away."""
    middle_m = outline_m.mean(axis=0)
    if rng.random() < _EXCHANGED:
        name = ("table", "box")[rng.integers(2)]
        outline, parts = KINDS[name][0](rng)
        x, y = middle_m.tolist()
        return Furniture(name, SE2(x, y, float(rng.uniform(-math.pi, math.pi))), outline, tuple(parts))
    x, y = (middle_m + rng.normal(0.0, _MOVED_M, 2)).tolist()
    outline = outline_m - middle_m
    prism = Prism(outline, 0.0, _TOP_M)
    return Furniture("moved", SE2(x, y, float(rng.normal(0.0, _TURNED_RAD))), outline, (prism,))


@dataclass(frozen=True, slots=True)
class Doorway:
    """A gap between two walls. a_m, b_m : (x, y) where it touches them, map frame."""

    a_m: tuple[float, float]
    b_m: tuple[float, float]

    def leaf(self, angle_rad: float, *, at_b: bool = False) -> Furniture:
        """A door leaf that hangs at one of the walls, turned by an angle from where it closes the gap."""
        hinge, other = (self.b_m, self.a_m) if at_b else (self.a_m, self.b_m)
        yaw = math.atan2(other[1] - hinge[1], other[0] - hinge[0]) + angle_rad
        half, w = _LEAF_M / 2, math.dist(hinge, other)
        outline = np.array([(0.0, -half), (w, -half), (w, half), (0.0, half)])
        return Furniture("door", SE2(*hinge, yaw), outline, (Prism(outline, 0.0, _HEIGHT_M),))


def find_doorways(plan: OccupancyGrid) -> tuple[Doorway, ...]:
    """The doorways of a plan, narrowest first: short gaps between walls with more room on both sides.

    They are looked for along the middle lines of the free space. A door that is drawn closed is a wall.
    """
    walls: I64 = np.argwhere(plan.occupied)
    if not len(walls) or not plan.free.any():
        return ()
    tree = cKDTree(plan.to_point(walls))
    clearance = clearance_of(~plan.occupied, plan.resolution_m)
    middle = skeleton_of(plan.free, plan.resolution_m, 0.5 * _WIDTH_M[0] - plan.resolution_m)
    cells = np.argwhere(middle & (clearance <= 0.5 * _WIDTH_M[1] + plan.resolution_m))
    cells = cells[np.argsort(clearance[cells[:, 0], cells[:, 1]], kind="stable")]
    found: list[tuple[F64, Doorway]] = []
    for point in plan.to_point(cells):
        beside = any(np.hypot(*(point - other)) < _APART_M for other, _ in found)
        if not beside and (doorway := _at(plan, clearance, tree, walls, point)) is not None:
            found.append((point, doorway))
    return tuple(doorway for _, doorway in found)


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


def _leaves_room(plan: OccupancyGrid, doors: list[Furniture], config: WorldConfig) -> bool:
    """Whether the part of the free space that the robot is in, or else the largest one, stays half of what
    it could reach without the doors."""

    def reach(free: BoolGrid, start_m: tuple[float, float] | None) -> int:
        labels, _ = ndimage.label(clearance_m(free, plan.resolution_m) >= config.drive.clearance_m)
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        if start_m is None or not sizes.any():
            return int(sizes.max())
        cells = np.argwhere(labels > 0)
        nearest = cells[np.argmin(np.hypot(*(plan.to_point(cells) - start_m).T))]
        return int(sizes[labels[nearest[0], nearest[1]]])

    closed = plan.free & ~covered(plan, tuple(doors))
    return reach(closed, config.start_m) >= _KEPT_REACHABLE * reach(plan.free.copy(), None)
