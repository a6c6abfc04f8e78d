"""The part of a building that a simulated drive has seen, and how much of it a map contains."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, BoolGrid
from pc2grid.config import ProjectionConfig
from pc2grid.geometry import SE2
from pc2grid.mapping.occupancy import OCCUPANCY
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.sensor_model import SENSOR_MODELS
from pc2grid.simulate import Session
from pc2grid.simulate.passage import outline_mask
from pc2grid.simulate.session import Reading
from pc2grid.submaps.isovist import isovist


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityParameters:
    """What counts as seen. All chosen by hand.

    scans : a wall cell is visible if it borders on open space that was in sight, and at least this many scans
        have a return within a cell of it.
    bearings : number of rays of the field of view.
    step_m, step_rad : the field of view is computed again after this motion.
    """

    scans: int = 3
    bearings: int = 1440
    step_m: float = 0.05
    step_rad: float = math.radians(2.0)


VISIBILITY = VisibilityParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class GridQuality:
    """Shares of cells, 0..1; NaN if there are no cells to count.

    occupied_right : of the occupied cells of the map, those with something solid in the same or a
        neighbouring cell.
    walls_found : of the visible cells of true walls, those with an occupied cell of the map as near.
    free_wrong : of the known cells of the map that are more than a cell from anything solid, those that are
        occupied.
    unseen_free : of the free cells of the map, those more than a cell outside everything that was in sight.
    """

    occupied_right: float
    walls_found: float
    free_wrong: float
    unseen_free: float


class TrueFloor:
    """The solid cells in the height band of a simulated drive, and the cells that were in sight.

    Cells under the robot count as seen.

    `add` takes in every scan. For a laser, what stands at its height is solid and blocks its sight. For the
    other sensors, what reaches into the height band is solid, but only walls block their sight, because they
    look over and under objects.
    """

    def __init__(self, session: Session, projection: ProjectionConfig) -> None:
        self._session = session
        self._projection = projection
        planar, plan = SENSOR_MODELS[session.sensor.kind].planar, session.grid
        height_m = float(session.sensor.T_base_sensor[2, 3])
        self._band = (height_m, height_m) if planar else (projection.band_min_m, projection.band_max_m)
        self._walls: BoolGrid = plan.occupied
        self._solid: BoolGrid = self._walls | _standing(session, self._band)
        blocking = self._solid if planar else self._walls
        # In the simulator unknown cells are empty space.
        self._open = OccupancyGrid(
            cells=np.where(blocking, OCCUPIED, FREE).astype(np.int8),
            resolution_m=plan.resolution_m,
            origin_m=plan.origin_m,
        )
        self._scans_with_return = np.zeros(plan.cells.shape, np.int32)
        self._seen: BoolGrid = np.zeros(plan.cells.shape, np.bool_)
        self._last: SE2 | None = None
        directions = session.sensor.directions @ session.sensor.T_base_sensor[:3, :3].T
        reach_m = session.sensor.config.max_range_m * _lengths(directions)
        self._reach_m = np.minimum(reach_m, projection.max_range_m)

    def add(self, reading: Reading) -> None:
        """Take in one scan: count the cells that its returns truly are in, and note what was in sight."""
        session, sensor = self._session, self._session.sensor
        kept = np.isfinite(reading.values_m)
        T = sensor.T_base_sensor
        points = (reading.values_m[kept, None] * sensor.directions[kept]) @ T[:3, :3].T + T[:3, 3]
        near = np.linalg.norm(points[:, :2] - T[:2, 3], axis=1) <= self._projection.max_range_m
        if not SENSOR_MODELS[sensor.kind].planar:
            near &= (points[:, 2] >= self._band[0]) & (points[:, 2] <= self._band[1])
        poses = session.drive.at(reading.time_s + sensor.offsets_s[kept][near])
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        x, y = points[near, 0], points[near, 1]
        cells = session.grid.to_cell(np.column_stack((c * x - s * y, s * x + c * y)) + poses[:, :2])
        cells = cells[_within(cells, self._open)]
        width = self._open.cells.shape[1]
        once = np.unique(cells[:, 0] * width + cells[:, 1])  # one count for each scan
        self._scans_with_return[once // width, once % width] += 1
        pose = session.drive.pose(reading.time_s)
        step = (self._last or pose).inverse() @ pose
        if (
            self._last
            and math.hypot(step.x, step.y) < VISIBILITY.step_m
            and abs(step.yaw) < VISIBILITY.step_rad
        ):
            return
        self._last = pose
        self._see(pose)

    def _see(self, pose: SE2) -> None:
        x, y = (float(v) for v in pose.apply(self._session.sensor.T_base_sensor[None, :2, 3])[0])
        view = isovist(self._open, (x, y), float(self._reach_m.max()), bearings=VISIBILITY.bearings)
        turned_m = np.roll(self._reach_m, round(pose.yaw * VISIBILITY.bearings / (2 * math.pi)))
        angles = 2 * np.pi * np.arange(VISIBILITY.bearings) / VISIBILITY.bearings
        reach = np.minimum(turned_m, view.ranges_m)[:, None]
        corners = (x, y) + reach * np.column_stack((np.cos(angles), np.sin(angles)))
        pixels = (corners - self._open.origin_m) / self._open.resolution_m - 0.5
        mask = np.zeros(self._seen.shape, np.uint8)
        cv2.fillPoly(mask, [np.rint(pixels * 16).astype(np.int32)], 1, shift=4)
        here = self._open.to_cell(np.array([(pose.x, pose.y)]))[0, ::-1]
        cv2.circle(mask, here.tolist(), round(OCCUPANCY.body_m / self._open.resolution_m), 1, -1)
        self._seen |= mask.astype(bool)

    def judge(self, grid: OccupancyGrid, T_plan_map: SE2) -> GridQuality:
        """Compare a map of the drive, whose frame lies at `T_plan_map` in the plan, with what was seen."""
        plan = self._session.grid
        visible = (
            self._walls
            & _grown(self._seen & ~self._walls)
            & (_sum_around(self._scans_with_return) >= VISIBILITY.scans)
        )
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
    """Mask (H, W) of the cells where a part of an object reaches into the height band."""
    plan = session.grid
    mask: BoolGrid = np.zeros(plan.cells.shape, np.bool_)
    for furniture in session.objects:
        for part in furniture.parts:
            if part.bottom_m <= band_m[1] and part.top_m >= band_m[0]:
                outline = (furniture.pose.apply(part.outline_m) - plan.origin_m) / plan.resolution_m
                mask |= outline_mask(outline, plan.cells.shape)
    return mask


def _lengths(directions: F64) -> F64:
    """For each bearing in the base frame, how far a sensor sees there, as a share of its range.

    directions : (R, 3) of its rays; those of a camera have depth 1 and are longer at the edges of the image.
    """
    turns = np.rint(
        np.arctan2(directions[:, 1], directions[:, 0]) * VISIBILITY.bearings / (2 * np.pi)
    ).astype(int)
    lengths = np.zeros(VISIBILITY.bearings)
    for step in range(-2, 3):  # neighbouring rays differ by up to a degree
        np.maximum.at(
            lengths, (turns + step) % VISIBILITY.bearings, np.linalg.norm(directions[:, :2], axis=1)
        )
    return lengths


def _grown(mask: BoolGrid) -> BoolGrid:
    """The cells of a mask and their eight neighbours."""
    grown: BoolGrid = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return grown


def _sum_around(counts: NDArray[np.int32]) -> F32:
    """Sum over each cell and its eight neighbours."""
    return cv2.boxFilter(counts.astype(np.float32), -1, (3, 3), normalize=False).astype(np.float32)


def _within(cells: I64, grid: OccupancyGrid) -> BoolGrid:
    """Which of the cells (N, 2) lie in the grid."""
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
