"""What a simulated drive could know of its building, and how much of it is in a map."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pc2grid.config import ProjectionConfig
from pc2grid.geometry import F64, SE2
from pc2grid.model import F32, FREE, I64, OCCUPIED, UNKNOWN, BoolGrid, OccupancyGrid
from pc2grid.projection import BODY_M
from pc2grid.simulate.passage import outline_mask
from pc2grid.visibility import isovist

if TYPE_CHECKING:
    from pc2grid.simulate import Session
    from pc2grid.simulate.session import Reading

LOOKS = 3
"""A wall cell counts as visible if it borders on open space that came in sight, and this many scans have a
return within a cell of it."""
_BEARINGS = 1440
_SIGHT_STEP_M, _SIGHT_STEP_RAD = 0.05, math.radians(2.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class GridQuality:
    """Shares of cells, 0..1.

    occupied_right : occupied cells of the map with something solid in the same or a neighbouring cell.
    walls_found : visible cells of true walls with an occupied cell of the map as near.
    free_wrong : cells that are free, more than a cell from anything solid, and occupied in the map; of all
        such cells that the map knows.
    unseen_free : free cells of the map more than a cell outside anything that was ever in sight.
    """

    occupied_right: float
    walls_found: float
    free_wrong: float
    unseen_free: float


class TrueFloor:
    """What a simulated drive could know: the solid cells in the height band, and all that came in sight
    or that the robot stood on.

    Fed with every scan by `look`. A laser's world is what stands at its height; for the others it is what
    reaches into the band, and only walls block their sight, for they look over and under things.
    """

    def __init__(self, session: Session, projection: ProjectionConfig) -> None:
        self._session = session
        self._projection = projection
        kind, plan = session.sensor.kind, session.grid
        height_m = float(session.sensor.T_base_sensor[2, 3])
        self._band = (
            (height_m, height_m) if kind == "laser" else (projection.band_min_m, projection.band_max_m)
        )
        self._walls: BoolGrid = plan.occupied
        self._solid: BoolGrid = self._walls | _standing(session, self._band)
        blocking = self._solid if kind == "laser" else self._walls
        # The simulator's unknown cells are empty space.
        self._open = OccupancyGrid(
            cells=np.where(blocking, OCCUPIED, FREE).astype(np.int8),
            resolution_m=plan.resolution_m,
            origin_m=plan.origin_m,
        )
        self._looks = np.zeros(plan.cells.shape, np.int32)
        self._seen: BoolGrid = np.zeros(plan.cells.shape, np.bool_)
        self._last: SE2 | None = None
        directions = session.sensor.directions @ session.sensor.T_base_sensor[:3, :3].T
        reach_m = session.sensor.config.max_range_m * _lengths(directions)
        self._reach_m = np.minimum(reach_m, projection.max_range_m)

    def look(self, reading: Reading) -> None:
        """Where the returns of one scan truly are, and what was in sight."""
        session, sensor = self._session, self._session.sensor
        kept = np.isfinite(reading.values_m)
        T = sensor.T_base_sensor
        points = (reading.values_m[kept, None] * sensor.directions[kept]) @ T[:3, :3].T + T[:3, 3]
        near = np.linalg.norm(points[:, :2] - T[:2, 3], axis=1) <= self._projection.max_range_m
        if sensor.kind != "laser":
            near &= (points[:, 2] >= self._band[0]) & (points[:, 2] <= self._band[1])
        poses = session.drive.at(reading.time_s + sensor.offsets_s[kept][near])
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x, y = points[near, 0], points[near, 1]
        cells = session.grid.to_cell(np.column_stack((c * x - s * y, s * x + c * y)) + poses[:, :2])
        cells = cells[_within(cells, self._open)]
        width = self._open.cells.shape[1]
        once = np.unique(cells[:, 0] * width + cells[:, 1])  # however many returns a scan has there
        self._looks[once // width, once % width] += 1
        pose = session.drive.pose(reading.time_s)
        step = (self._last or pose).inverse() @ pose
        if self._last and math.hypot(step.x, step.y) < _SIGHT_STEP_M and abs(step.yaw) < _SIGHT_STEP_RAD:
            return
        self._last = pose
        self._see(pose)

    def _see(self, pose: SE2) -> None:
        import cv2

        x, y = (float(v) for v in pose.apply(self._session.sensor.T_base_sensor[None, :2, 3])[0])
        view = isovist(self._open, (x, y), float(self._reach_m.max()), bearings=_BEARINGS)
        turned_m = np.roll(self._reach_m, round(pose.yaw * _BEARINGS / (2 * math.pi)))
        angles = 2 * np.pi * np.arange(_BEARINGS) / _BEARINGS
        reach = np.minimum(turned_m, view.ranges_m)[:, None]
        corners = (x, y) + reach * np.column_stack((np.cos(angles), np.sin(angles)))
        pixels = (corners - self._open.origin_m) / self._open.resolution_m - 0.5
        mask = np.zeros(self._seen.shape, np.uint8)
        cv2.fillPoly(mask, [np.rint(pixels * 16).astype(np.int32)], 1, shift=4)
        here = self._open.to_cell(np.array([(pose.x, pose.y)]))[0, ::-1]
        cv2.circle(mask, here.tolist(), round(BODY_M / self._open.resolution_m), 1, -1)
        self._seen |= mask.astype(bool)

    def judge(self, grid: OccupancyGrid, T_plan_map: SE2) -> GridQuality:
        """A map of the drive, placed in the plan, against what there was to be known."""
        plan = self._session.grid
        visible = self._walls & _grown(self._seen & ~self._walls) & (_around(self._looks) >= LOOKS)
        rows, columns = np.nonzero(grid.cells != UNKNOWN)
        known = np.column_stack((rows, columns))
        cells = plan.to_cell(T_plan_map.apply(grid.to_point(known)))
        inside = _within(cells, plan)
        occupied, free = grid.occupied[rows, columns], grid.free[rows, columns]
        near_solid = _look_up(_grown(self._solid), cells, inside)
        seen = _look_up(_grown(self._seen), cells, inside)
        found = np.zeros(plan.cells.shape, np.bool_)
        drawn = cells[occupied & inside]
        found[drawn[:, 0], drawn[:, 1]] = True
        return GridQuality(
            occupied_right=_share(near_solid[occupied]),
            walls_found=_share(_grown(found)[visible]),
            free_wrong=_share(occupied[inside & ~near_solid]),
            unseen_free=_share(~seen[free]),
        )


def _standing(session: Session, band_m: tuple[float, float]) -> BoolGrid:
    """Cells (H, W) where a part of the clutter reaches into the heights of the band."""
    plan = session.grid
    mask: BoolGrid = np.zeros(plan.cells.shape, np.bool_)
    for piece in session.pieces:
        for part in piece.parts:
            if part.bottom_m <= band_m[1] and part.top_m >= band_m[0]:
                outline = (piece.pose.apply(part.outline_m) - plan.origin_m) / plan.resolution_m
                mask |= outline_mask(outline, plan.cells.shape)
    return mask


def _lengths(directions: F64) -> F64:
    """For each of _BEARINGS in the base frame how far a sensor looks there, as a share of its range.

    directions : (R, 3) of its rays; a camera's, of depth 1, are longer at the edges of the image.
    """
    turns = np.rint(np.arctan2(directions[:, 1], directions[:, 0]) * _BEARINGS / (2 * np.pi)).astype(int)
    lengths = np.zeros(_BEARINGS)
    for step in range(-2, 3):  # rays are up to a degree apart
        np.maximum.at(lengths, (turns + step) % _BEARINGS, np.linalg.norm(directions[:, :2], axis=1))
    return lengths


def _grown(mask: BoolGrid) -> BoolGrid:
    """The cells and their eight neighbours."""
    import cv2

    grown: BoolGrid = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return grown


def _around(counts: NDArray[np.int32]) -> F32:
    """Sum over each cell and its eight neighbours."""
    import cv2

    return cv2.boxFilter(counts.astype(np.float32), -1, (3, 3), normalize=False).astype(np.float32)


def _within(cells: I64, grid: OccupancyGrid) -> BoolGrid:
    """Which cells (N, 2) exist."""
    height, width = grid.cells.shape
    row, column = cells[:, 0], cells[:, 1]
    inside: BoolGrid = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return inside


def _look_up(mask: BoolGrid, cells: I64, inside: BoolGrid) -> BoolGrid:
    """Values at cells (N, 2), False outside."""
    values: BoolGrid = np.zeros(len(cells), np.bool_)
    values[inside] = mask[cells[inside, 0], cells[inside, 1]]
    return values


def _share(values: BoolGrid) -> float:
    return float(values.mean()) if values.size else math.nan
