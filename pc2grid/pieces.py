"""Pieces of a session: a few metres of travel, drawn as one rigid local map that loops are closed on."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.facing import facing
from pc2grid.geometry import F64, SE2
from pc2grid.matching import Match, PointGrid, best_placements
from pc2grid.model import I64
from pc2grid.sweep import Sweep

PIECE_TRAVEL_M = 4.0
RANGE_M = 12.0  # what is seen from farther away is too thin to match
CELL_M = 0.1
_FREE, _HIT = 1, 2
_RADII = (3, 2, 2, 1, 1, 1, 1, 1)
_CACHE = 64


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A sweep worth keeping: the robot had moved since the one before.

    index : number of its scan in the session. T_map_base : as tracked, before loops are closed.
    information : (3, 3) of that pose relative to the local map it was tracked on, in the map's axes.
    restart : the first after a lost stretch: its place relative to those before is a guess.
    """

    index: int
    sweep: Sweep
    T_map_base: SE2
    information: F64
    restart: bool = False


def cut(keyframes: Sequence[Keyframe]) -> list[range]:
    """Runs of keyframes of about `PIECE_TRAVEL_M` each; a lost stretch always starts a new one."""
    runs, first, travel = [], 0, 0.0
    for k in range(1, len(keyframes)):
        step = keyframes[k - 1].T_map_base.inverse() @ keyframes[k].T_map_base
        travel += math.hypot(step.x, step.y) + 0.3 * abs(step.yaw)
        if travel > PIECE_TRAVEL_M or keyframes[k].restart:
            runs.append(range(first, k))
            first, travel = k, 0.0
    runs.append(range(first, len(keyframes)))
    return runs


class Piece:
    """The local map of a run of keyframes, in the frame of its anchor, the keyframe in the middle.

    Made from the keyframes, which way the surfaces at their hits face (radians), and their poses.

    points_m : (N, 2) obstacle points, thinned to one a cell. facing_rad : (N,) which way each one faces.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        facings: Sequence[NDArray[np.floating]],
        T_anchor_base: Sequence[SE2],
    ) -> None:
        import cv2

        hits, faces, outlines = [], [], []
        for keyframe, face_rad, pose in zip(keyframes, facings, T_anchor_base, strict=True):
            sweep = keyframe.sweep
            near = np.linalg.norm(sweep.hits_m - sweep.origin_m, axis=1) < RANGE_M
            hits.append(pose.apply(sweep.hits_m[near]))
            faces.append(face_rad[near] + pose.yaw)
            outlines.append(pose.apply(sweep.free_polygon(RANGE_M)))
        points, face = np.concatenate(hits), np.concatenate(faces)
        everything = np.concatenate((points, *outlines))
        low, high = everything.min(axis=0) - 0.6, everything.max(axis=0) + 0.6
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


class PieceStore:
    """Pieces made on demand from keyframes and their poses; only the last used ones are kept."""

    def __init__(self, keyframes: Sequence[Keyframe], runs: Sequence[range], poses: F64) -> None:
        self.keyframes = keyframes
        self.runs = runs
        self.poses = poses
        self._made: OrderedDict[int, Piece] = OrderedDict()
        self._facing: dict[int, NDArray[np.float16]] = {}

    def anchor(self, piece: int) -> int:
        """The keyframe whose frame the piece lives in."""
        run = self.runs[piece]
        return run[len(run) // 2]

    def pose(self, keyframe: int) -> SE2:
        """Present estimate of a keyframe's T_map_base."""
        x, y, yaw = self.poses[keyframe]
        return SE2(float(x), float(y), float(yaw))

    def facing(self, keyframe: int) -> NDArray[np.float16]:
        """Which way the surfaces at the keyframe's hits face, radians in its frame; worked out once."""
        if keyframe not in self._facing:
            sweep = self.keyframes[keyframe].sweep
            self._facing[keyframe] = facing(sweep.hits_m, sweep.origin_m).astype(np.float16)
        return self._facing[keyframe]

    def __getitem__(self, piece: int) -> Piece:
        if piece not in self._made:
            T_anchor_map = self.pose(self.anchor(piece)).inverse()
            run = self.runs[piece]
            self._made[piece] = Piece(
                [self.keyframes[k] for k in run],
                [self.facing(k) for k in run],
                [T_anchor_map @ self.pose(k) for k in run],
            )
            if len(self._made) > _CACHE:
                self._made.popitem(last=False)
        self._made.move_to_end(piece)
        return self._made[piece]

    def move(self, poses: F64, *, redraw: bool) -> None:
        """New estimates; `redraw` also changes the shape of the pieces, else they move as they are."""
        self.poses = poses
        if redraw:
            self._made.clear()
