"""Pieces of a session: a few metres of travel, drawn as one rigid local map that loops are closed on."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pc2grid.facing import facing
from pc2grid.geometry import F64, SE2
from pc2grid.keyframes import Keyframe, Keyframes
from pc2grid.matching import Match, PointGrid, best_placements
from pc2grid.model import I64

RANGE_M = 12.0  # what is seen from farther away is too thin to match
CELL_M = 0.1
_FREE, _HIT = 1, 2
_RADII = (3, 2, 2, 1, 1, 1, 1, 1)
_CACHE = 24
_DRAWN_EVERY = 2  # keyframes, 0.2 m apart: more of them show the same walls again


def pose_at(poses: F64, index: int) -> SE2:
    """One of poses (N, 3): x, y, yaw."""
    x, y, yaw = poses[index]
    return SE2(float(x), float(y), float(yaw))


class Piece:
    """The local map of a run of keyframes, in the frame of its anchor, the keyframe in the middle.

    Made from the keyframes and where they are in that frame.

    points_m : (N, 2) obstacle points, thinned to one a cell. facing_rad : (N,) which way each one faces.
    """

    def __init__(self, keyframes: Sequence[Keyframe], T_anchor_base: Sequence[SE2]) -> None:
        import cv2

        hits, faces, outlines = [], [], []
        for keyframe, pose in zip(keyframes, T_anchor_base, strict=True):
            sweep = keyframe.sweep
            face_rad = facing(sweep.hits_m, sweep.origin_m)
            away = sweep.hits_m - sweep.origin_m
            near = np.einsum("ij,ij->i", away, away) < RANGE_M**2
            hits.append(pose.apply(sweep.hits_m[near]))
            faces.append(face_rad[near] + pose.yaw)
            outlines.append(pose.apply(sweep.free_polygon(RANGE_M)))
        points, face = np.concatenate(hits), np.concatenate(faces)
        x, y = np.concatenate((points, *outlines)).T
        low, high = np.array([x.min(), y.min()]) - 0.6, np.array([x.max(), y.max()]) + 0.6
        self._grid = PointGrid(low, high, CELL_M)
        self._grid.add(points, face)
        self._low_m = low
        shape = self._grid.shape
        free = np.zeros(shape, dtype=np.uint8)
        for outline in outlines:
            corners = np.rint(((outline - low) / CELL_M - 0.5) * 16).astype(np.int32)
            cv2.fillPoly(free, [corners], _FREE, shift=4)
        cells = self._cells(points)
        occupied = np.ones(shape, dtype=np.uint8)
        occupied[cells[:, 0], cells[:, 1]] = 0
        if not len(cells):
            occupied[0, 0] = 0  # an obstacle far off the corner, so that distances stay finite
        distance = cv2.distanceTransform(occupied, cv2.DIST_L2, 5) * CELL_M
        self._seen = np.where(distance < 0.25, _HIT, free)
        self._field = np.exp(-0.5 * (distance / 0.15) ** 2).astype(np.float32)
        _, keep = np.unique(cells[:, 0] * shape[1] + cells[:, 1], return_index=True)
        self.points_m: F64 = points[keep]
        self.facing_rad: F64 = face[keep]

    def match(
        self,
        points_m: F64,
        facing_rad: NDArray[np.floating],
        guess: SE2,
        *,
        radii: tuple[int, ...] = (3, 2, 2, 1, 1, 1, 1, 1),
    ) -> Match:
        """Refine where points (N, 2), facing (N,), lie in this piece, from the points alone."""
        return self._grid.match(points_m, facing_rad, guess, guess, np.zeros((3, 3)), radii=radii)

    def search(
        self, points_m: F64, guess: SE2, window_m: float, window_rad: float
    ) -> list[tuple[float, SE2]]:
        """The best few placements of points (N, 2) in a window around `guess`, with their scores 0..1."""
        return best_placements(self._field, self._low_m, CELL_M, points_m, guess, window_m, window_rad)

    def agreement(self, points_m: F64, pose: SE2) -> tuple[float, float]:
        """How well points (N, 2) placed at `pose` fit what this piece saw.

        Returns the share of the points that lie where the piece looked, and among those the share that
        meets an obstacle instead of free space.
        """
        cells = self._cells(pose.apply(points_m))
        inside = ((cells >= 0) & (cells < self._seen.shape)).all(axis=1)
        seen = self._seen[cells[inside, 0], cells[inside, 1]]
        looked = int((seen > 0).sum())
        return looked / max(len(points_m), 1), float((seen == _HIT).sum()) / max(looked, 1)

    def _cells(self, points: F64) -> I64:
        cells: I64 = np.floor((points - self._low_m) / CELL_M)[:, ::-1].astype(np.int64)
        return cells


class Pieces:
    """The pieces of a session, made on demand from their keyframes; only the last used ones are kept.

    runs : of each, the numbers of its keyframes.
    """

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        self.runs: list[range] = []
        self._settled: F64 | None = None
        self._made: OrderedDict[int, Piece] = OrderedDict()

    def append(self, run: range) -> None:
        """One more, as it was tracked."""
        self.runs.append(run)

    def anchor(self, number: int) -> int:
        """The keyframe whose frame a piece lives in."""
        run = self.runs[number]
        return run[len(run) // 2]

    def redraw(self, settled: F64) -> None:
        """From now on the keyframes are where they are settled, (K, 3) x, y, yaw, and no more as tracked."""
        self._settled = settled
        self._made.clear()

    def __getitem__(self, number: int) -> Piece:
        if number not in self._made:
            run, anchor = self.runs[number], self.anchor(number)
            drawn = run[(anchor - run.start) % _DRAWN_EVERY :: _DRAWN_EVERY]
            keyframes = [self._keyframes[k] for k in drawn]
            T_anchor_map = self._pose(self._keyframes[anchor], anchor).inverse()
            poses = [T_anchor_map @ self._pose(f, k) for f, k in zip(keyframes, drawn, strict=True)]
            self._made[number] = Piece(keyframes, poses)
            if len(self._made) > _CACHE:
                self._made.popitem(last=False)
        self._made.move_to_end(number)
        return self._made[number]

    def _pose(self, keyframe: Keyframe, number: int) -> SE2:
        """T_map_base of a keyframe, by now."""
        if self._settled is None:
            return keyframe.T_map_base
        return pose_at(self._settled, number)
