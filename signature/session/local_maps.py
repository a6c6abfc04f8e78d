"""Local maps of a session: a few metres of travel, drawn as one rigid map on which loops are closed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.estimation.line_map import LineMatch, PointGrid, best_placements, evenly
from pc2grid.geometry import F64, I64, SE2, SUBPIXEL_BITS, polygon_corners
from pc2grid.matching.evidence import LEFT, evidence_of, masses
from pc2grid.matching.score import score_fit
from pc2grid.matching.walls import Walls
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from signature.session.keyframes import Keyframe, Keyframes


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalMapParameters:
    """How a local map is drawn and matched. Chosen by hand; checked on the relations of fr079 and intel.

    range_m : hits farther from the sensor are left out: they are too sparse to match.
    cell_m : edge of a cell.
    radii_cells : neighbourhoods of the refinement, see `PointGrid.match`. The free border around the points
        is twice as wide as the widest.
    every_keyframe : every n-th keyframe is drawn; they are 0.2 m apart, so more of them add no new walls.
    cached : local maps that stay in memory.
    search_points : points of a local map that are compared with another one.
    """

    range_m: float = 12.0
    cell_m: float = 0.1
    radii_cells: tuple[int, ...] = (3, 2, 2, 1, 1, 1, 1, 1)
    every_keyframe: int = 2
    cached: int = 24
    search_points: int = 400


LOCAL_MAPS = LocalMapParameters()
CAMERA_LOCAL_MAPS = LocalMapParameters(cell_m=0.05, radii_cells=(6, 4, 4, 2, 2, 2, 2, 2))
"""For a depth camera: cells as in `CAMERA_MATCHING`, for the same reason, neighbourhoods as wide in metres.
Chosen on simulated drives (`docs/method.md`)."""


def pose_at(poses: F64, index: int) -> SE2:
    """Return one of poses (N, 3): x, y, yaw."""
    x, y, yaw = poses[index]
    return SE2(float(x), float(y), float(yaw))


class Overlap(NamedTuple):
    """The relative pose T_older_newer of two local maps that show the same place.

    information : (3, 3) on that. counts : weight, 0..1, which is already a factor of the information.
    """

    pose: SE2
    information: F64
    counts: float


class LocalMap:
    """The local map of a run of keyframes, in the frame of its anchor, the keyframe in the middle.

    walls : as it is compared with another one. points_m : (N, 2) obstacle points, thinned to one a cell.
    normal_rad : (N,) direction of the surface normal at each.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        T_anchor_base: Sequence[SE2],
        parameters: LocalMapParameters = LOCAL_MAPS,
    ) -> None:
        """Draw the keyframes at their poses in the anchor's frame."""
        hits, normals, outlines = [], [], []
        for keyframe, pose in zip(keyframes, T_anchor_base, strict=True):
            scan = keyframe.planar_scan
            near = ((scan.hits_m - scan.origin_m) ** 2).sum(axis=1) < parameters.range_m**2
            hits.append(pose.apply(scan.hits_m[near]))
            normals.append(scan.normal_rad[near] + pose.yaw)
            outlines.append(pose.apply(scan.free_polygon(parameters.range_m)))
        points, normal_rad = np.concatenate(hits), np.concatenate(normals)
        everything = np.concatenate((points, *outlines))
        self._parameters = parameters
        margin_m = 2 * max(parameters.radii_cells) * parameters.cell_m
        self._low_m = everything.min(axis=0) - margin_m
        self._grid = PointGrid(self._low_m, everything.max(axis=0) + margin_m, parameters.cell_m)
        self._grid.add(points, normal_rad)
        cells: I64 = np.floor((points - self._low_m) / parameters.cell_m).astype(np.int64)[:, ::-1]
        self.walls = Walls.of(self._drawn(cells, outlines))
        self._field = self.walls.field.values.astype(np.float32) * np.float32(1.0 / 255.0)
        _, first = np.unique(cells @ (self._grid.shape[1], 1), return_index=True)
        self.points_m: F64 = points[first]
        self.normal_rad: F64 = normal_rad[first]

    def _drawn(self, cells: I64, outlines: Sequence[F64]) -> OccupancyGrid:
        """Return the grid with obstacles in cells (N, 2), row and column, and free ground inside the outlines
        (B, 2)."""
        low_x, low_y = self._low_m.tolist()
        drawn = np.full(self._grid.shape, UNKNOWN, np.int8)
        for outline in outlines:
            corners = polygon_corners((outline - self._low_m) / self._parameters.cell_m)
            cv2.fillPoly(drawn, [corners], FREE, shift=SUBPIXEL_BITS)
        drawn[cells[:, 0], cells[:, 1]] = OCCUPIED
        return OccupancyGrid(cells=drawn, resolution_m=self._parameters.cell_m, origin_m=(low_x, low_y))

    def match(self, points_m: F64, normal_rad: NDArray[np.floating], guess: SE2) -> LineMatch:
        """Refine the pose of points (N, 2) with normals (N,) in this local map, from the points alone."""
        no_prior = np.zeros((3, 3))
        return self._grid.match(
            points_m, normal_rad, guess, guess, no_prior, radii=self._parameters.radii_cells
        )

    def sample(self) -> tuple[F64, F64]:
        """Return the points (S, 2) that are compared with another local map, and their normals (S,)."""
        chosen = evenly(len(self.points_m), self._parameters.search_points)
        return self.points_m[chosen], self.normal_rad[chosen]

    def overlap(self, newer: LocalMap, guess: SE2, window_m: float, window_rad: float) -> Overlap | None:
        """Match a newer local map with this one near a guess; None if they hardly show one place.

        Correlative scan matching over the window proposes poses. Of these the likeliest, by the evidence of
        the walls of both, counts as much as it is likely (`pc2grid.matching.evidence`).
        """
        points, normals = newer.sample()
        starts = best_placements(
            self._field, self._low_m, self._parameters.cell_m, points, guess, window_m, window_rad
        )
        matches = [self.match(points, normals, start) for _, start in starts]
        evidence = evidence_of([score_fit(self.walls, newer.walls, match.pose) for match in matches])
        counts = [float(masses([one])[0]) for one in evidence]
        if max(counts, default=0.0) < LEFT:
            return None
        best = int(np.argmax(counts))
        return Overlap(matches[best].pose, counts[best] * matches[best].information, counts[best])


class LocalMaps:
    """The local maps of a session: runs of its keyframes. Each is drawn when it is needed.

    runs : (N,) numbers of the keyframes of each. anchors : (N,) the keyframe in whose frame each is drawn.
    """

    def __init__(self, keyframes: Keyframes, parameters: LocalMapParameters = LOCAL_MAPS) -> None:
        self._keyframes = keyframes
        self._parameters = parameters
        self.runs: list[range] = []
        self.anchors: list[int] = []
        self._optimised: F64 | None = None
        self._drawn = lru_cache(parameters.cached)(self._draw)

    def complete(self) -> None:
        """Make a local map of the keyframes since the last one."""
        run = range(self.runs[-1].stop if self.runs else 0, len(self._keyframes))
        self.runs.append(run)
        self.anchors.append(run[len(run) // 2])

    def redraw(self, optimised: F64) -> None:
        """Draw from now on with optimised keyframe poses (K, 3), x, y, yaw, in place of the tracked ones."""
        self._optimised = optimised
        self._drawn.cache_clear()

    def __getitem__(self, number: int) -> LocalMap:
        return self._drawn(number)

    def keyframes(self, numbers: range, anchor: int) -> tuple[list[Keyframe], list[SE2]]:
        """Return keyframes, and their poses T_anchor_base in the frame of the keyframe `anchor`."""
        return [self._keyframes[k] for k in numbers], self.poses(numbers, anchor)

    def poses(self, numbers: Iterable[int], anchor: int) -> list[SE2]:
        """Return T_anchor_base of keyframes in the frame of the keyframe `anchor`."""
        T_anchor_session = self._pose(anchor).inverse()
        return [T_anchor_session @ self._pose(k) for k in numbers]

    def _draw(self, number: int) -> LocalMap:
        run, anchor = self.runs[number], self.anchors[number]
        every = self._parameters.every_keyframe
        keyframes, poses = self.keyframes(run[(anchor - run.start) % every :: every], anchor)
        return LocalMap(keyframes, poses, self._parameters)

    def _pose(self, number: int) -> SE2:
        """Return T_session_base of a keyframe: optimised, or as tracked if loops are not closed yet."""
        return self._keyframes.pose(number) if self._optimised is None else pose_at(self._optimised, number)
