"""What is different between two maps of one place: what came, what went, and what stands in both.

An obstacle of one map on ground that the other map knows as free has changed, unless an error explains it:
the obstacle was never there, the ground was never free, or it is a wall of the other map that the errors of
the transform and of the cells moved. Connected cells make a patch, and each patch is tested against the three
explanations. Ground that one of the maps does not know says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64, cells_of, freeze
from pc2grid.geometry import SE2
from pc2grid.model import FREE_BELOW, UNKNOWN, OccupancyGrid

ChangeKind = Literal["came", "went"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeParameters:
    """What counts as a change. Chosen on four simulated offices, see `examples/changes.md`.

    accept : least probability that a patch has changed.
    independent_m : cells of a patch that lie so far apart are known by different scans. Nearer ones share
        their errors, and are no further evidence.
    surest : percent, of a cell that is occupied for sure; 100 less it, that is free. No cell is more certain.
    """

    accept: float = 0.9
    independent_m: float = 0.4
    surest: float = 99.0


CHANGES = ChangeParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangedPatch:
    """A connected part of an obstacle that stands in one of two maps only.

    came : it is in the later map; went : in the earlier one.
    points_m : (N, 2) centres of its cells, in the frame of the earlier map. area_m2 : of these cells.
    center_m : (x, y) of the smallest rectangle around the cells; length_m, width_m, yaw_rad : of this
        rectangle, `yaw_rad` being the direction of its longer side.
    probability : 0..1, of it having changed.
    """

    kind: ChangeKind
    points_m: F64
    area_m2: float
    center_m: tuple[float, float]
    length_m: float
    width_m: float
    yaw_rad: float
    probability: float

    def __post_init__(self) -> None:
        freeze(self, "points_m", np.float64, (None, 2))

    def __repr__(self) -> str:
        x, y = self.center_m
        size = f"{self.length_m:.2f} x {self.width_m:.2f} m"
        return f"ChangedPatch({self.kind} at ({x:.2f}, {y:.2f}) m, {size}, p {self.probability:.2f})"

    def corners_m(self) -> F64:
        """(4, 2) of the smallest rectangle around it, counter-clockwise."""
        signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        half = 0.5 * np.array([self.length_m, self.width_m])
        return SE2(*self.center_m, self.yaw_rad).apply(signs * half)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapChanges:
    """What is different between two maps, as far as both know the ground.

    patches : what came and went, the largest first.
    stood_m : (N, 2) centres of the earlier map's occupied cells that the later one has, too, in the frame of
        the earlier one. stood_m2 : their area.
    common_m2 : of all ground that both know.
    """

    patches: tuple[ChangedPatch, ...]
    stood_m: F64
    stood_m2: float
    common_m2: float

    def __post_init__(self) -> None:
        freeze(self, "stood_m", np.float64, (None, 2))

    def of(self, kind: ChangeKind) -> tuple[ChangedPatch, ...]:
        """The patches of a kind."""
        return tuple(patch for patch in self.patches if patch.kind == kind)

    def area_m2(self, kind: ChangeKind) -> float:
        """Of all cells that came or went."""
        return sum(patch.area_m2 for patch in self.of(kind))


def map_changes(
    before: OccupancyGrid,
    after: OccupancyGrid,
    T_before_after: SE2,
    covariance: F64,
    parameters: ChangeParameters = CHANGES,
) -> MapChanges:
    """What came, went, and stands in both of two maps.

    covariance : (3, 3) of x, y and yaw of `T_before_after`.

    >>> import numpy as np
    >>> room = np.pad(np.full((40, 40), 1, np.int8), 1, constant_values=99)
    >>> furnished = room.copy()
    >>> furnished[10:14, 20:26] = 99
    >>> monday = OccupancyGrid(cells=room, resolution_m=0.1, origin_m=(0.0, 0.0))
    >>> friday = OccupancyGrid(cells=furnished, resolution_m=0.1, origin_m=(0.0, 0.0))
    >>> map_changes(monday, friday, SE2(), np.zeros((3, 3))).patches
    (ChangedPatch(came at (2.30, 1.20) m, 0.60 x 0.40 m, p 1.00),)
    """

    def looked_up(
        there: OccupancyGrid, here: OccupancyGrid, T_there_here: SE2, T_before_here: SE2
    ) -> _Looked:
        cells = cells_of(here.occupied)
        variance_m2 = _variance_m2(T_before_here.apply(here.to_point(cells)), T_before_after, covariance)
        return _Looked.at(there, here, cells, T_there_here, variance_m2 + before.resolution_m**2)

    came = looked_up(before, after, T_before_after, T_before_after)
    went = looked_up(after, before, T_before_after.inverse(), SE2())
    patches = [
        *_patches("came", came, after, T_before_after, parameters),
        *_patches("went", went, before, SE2(), parameters),
    ]
    stood = cells_of(before.occupied)[went.explained <= math.log(2.0)]
    return MapChanges(
        patches=tuple(sorted(patches, key=lambda patch: -patch.area_m2)),
        stood_m=before.to_point(stood),
        stood_m2=len(stood) * before.resolution_m**2,
        common_m2=_common_m2(before, after, T_before_after),
    )


@dataclass(frozen=True, slots=True)
class _Looked:
    """The N occupied cells of one map, looked up in another one.

    cells : (N, 2) row and column. free (N,) : whether the other map is free there. occupied_here, free_there
    (N,) : log-odds. explained (N,) : the negative log-likelihood ratio of being the nearest wall of the other
    map, moved by the errors of the transform and of a cell; infinite without walls.
    """

    cells: I64
    free: NDArray[np.bool_]
    occupied_here: F64
    free_there: F64
    explained: F64

    @staticmethod
    def at(
        there: OccupancyGrid, here: OccupancyGrid, cells: I64, T_there_here: SE2, variance_m2: F64
    ) -> _Looked:
        """Cells (N, 2) of `here` in the map `there`. variance_m2 : (N,) of where they lie in it."""
        at = there.to_cell(T_there_here.apply(here.to_point(cells)))
        inside = ((at >= 0) & (at < there.cells.shape)).all(axis=1)
        at = at[inside]
        percent = np.full(len(cells), UNKNOWN, np.int8)
        percent[inside] = there.cells[at[:, 0], at[:, 1]]
        distance_m = np.full(len(cells), np.inf)
        distance_m[inside] = _wall_distance_m(there)[at[:, 0], at[:, 1]]
        return _Looked(
            cells=cells,
            free=(percent >= 0) & (percent < FREE_BELOW),
            occupied_here=_log_odds(here.cells[cells[:, 0], cells[:, 1]]),
            free_there=-_log_odds(percent),
            explained=0.5 * distance_m**2 / variance_m2,
        )


def _wall_distance_m(grid: OccupancyGrid) -> F64:
    """(H, W) from each cell to the nearest occupied one; infinite without any."""
    if not grid.occupied.any():
        return np.full(grid.cells.shape, np.inf)
    cells = cv2.distanceTransform((~grid.occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(cells, np.float64) * grid.resolution_m


def _variance_m2(points_m: F64, T_target_source: SE2, covariance: F64) -> F64:
    """(N,) of points (N, 2) of the target, in the direction in which the transform moves them most."""
    x, y = (points_m - (T_target_source.x, T_target_source.y)).T
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    x_yaw, y_yaw, yaw = covariance[0, 2], covariance[1, 2], covariance[2, 2]
    a = xx - 2.0 * y * x_yaw + y**2 * yaw
    b = xy + x * x_yaw - y * y_yaw - x * y * yaw
    d = yy + 2.0 * x * y_yaw + x**2 * yaw
    return np.asarray(0.5 * (a + d) + np.hypot(0.5 * (a - d), b))


def _log_odds(percent: NDArray[np.int8]) -> F64:
    share = np.clip(percent.astype(np.float64), 100.0 - CHANGES.surest, CHANGES.surest) / 100.0
    return np.asarray(np.log(share / (1.0 - share)))


def _patches(
    kind: ChangeKind, looked: _Looked, here: OccupancyGrid, T: SE2, parameters: ChangeParameters
) -> Iterator[ChangedPatch]:
    """The patches that have changed. T : the map `here` in the frame of the earlier map."""
    # A cell that is a moved wall of the other map rather than not would tie patches to walls.
    chosen = looked.free & (looked.explained > math.log(2.0))
    if not chosen.any():
        return
    cells = looked.cells[chosen]
    mask = np.zeros(here.cells.shape, np.uint8)
    mask[cells[:, 0], cells[:, 1]] = 1
    # Gaps of one cell are closed.
    count, labels = cv2.connectedComponents(cv2.dilate(mask, np.ones((3, 3), np.uint8)), connectivity=8)
    of_cell = labels[cells[:, 0], cells[:, 1]]
    sizes = np.bincount(of_cell, minlength=count)
    looks = np.maximum(sizes * here.resolution_m / parameters.independent_m, 1.0)

    def unchanged(evidence: F64, times: F64 | float = 1.0) -> F64:
        """Probability (count,) of an explanation that holds for all cells of a patch."""
        sums = np.bincount(of_cell, evidence[chosen], minlength=count)
        return np.asarray(np.exp(-np.minimum(sums / np.maximum(sizes, 1) * times, 700.0)))

    # The transform moves all cells of a patch alike: they are one piece of evidence against that.
    explained = unchanged(np.minimum(looked.explained, 700.0))
    no_change = unchanged(looked.occupied_here, looks) + unchanged(looked.free_there, looks) + explained
    for label in np.flatnonzero((sizes > 0) & (1.0 - no_change >= parameters.accept)).tolist():
        points_m = T.apply(here.to_point(cells[of_cell == label]))
        yield _patch(kind, points_m, here.resolution_m, 1.0 - float(no_change[label]))


def _patch(kind: ChangeKind, points_m: F64, cell_m: float, probability: float) -> ChangedPatch:
    middle = points_m.mean(axis=0)
    (x, y), (width, height), degrees = cv2.minAreaRect((points_m - middle).astype(np.float32))
    if height > width:
        width, height, degrees = height, width, degrees + 90.0
    return ChangedPatch(
        kind=kind,
        points_m=points_m,
        area_m2=len(points_m) * cell_m**2,
        center_m=(float(middle[0] + x), float(middle[1] + y)),
        length_m=width + cell_m,
        width_m=height + cell_m,
        yaw_rad=math.remainder(math.radians(degrees), math.pi),
        probability=probability,
    )


def _common_m2(before: OccupancyGrid, after: OccupancyGrid, T_before_after: SE2) -> float:
    """Ground that both maps know."""
    at = before.to_cell(T_before_after.apply(after.to_point(cells_of(after.cells >= 0))))
    at = at[((at >= 0) & (at < before.cells.shape)).all(axis=1)]
    return float((before.cells[at[:, 0], at[:, 1]] >= 0).sum()) * after.resolution_m**2
