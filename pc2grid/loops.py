"""Closing loops: the same place, seen again, makes the map agree with itself.

The session is cut into pieces of a few metres. Each new piece is held against older ones that it may
overlap: a correlative search over the uncertainty places it, and only placements that both pieces' free
space agrees with count. A robust pose graph of the pieces settles where each belongs (the scan-to-submap
constraints of Hess et al., "Real-time loop closure in 2D lidar SLAM", 2016, from piece to piece); between
their anchors the correction passes linearly, as the error of tracking grew.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2
from pc2grid.keyframes import Keyframe, Keyframes
from pc2grid.matching import Match, evenly
from pc2grid.model import I64, Loop
from pc2grid.pieces import Piece, Pieces, pose_at
from pc2grid.pose_graph import Edge, Solution, optimise

_PIECE_TRAVEL_M = 4.0
_SEARCH_POINTS = 400
_NEAR_M = 8.0
_MOST = 10
_SURE_M, _SURE_RAD = 0.3, math.radians(4.0)  # of the search, where nothing has drifted
_DRIFT_PER_M, _DRIFT_RAD_PER_M = 0.02, 0.006
_MAX_WINDOW_M = 3.0
_MAX_WINDOW_RAD = math.radians(20.0)
_LOST_M = 150.0  # of travel, the drift that a lost stretch counts as: the widest window
_MIN_SEEN = 0.35
_MIN_AGREEMENT = 0.8
_AGREE_M, _AGREE_RAD = 0.1, math.radians(1.0)
_REDRAWN = 2
_TIE_TRUST = 0.1  # of what a fit says of itself: the points on one wall err together
_BENT_M, _BENT_RAD = 0.01, math.radians(0.2)


@dataclass(frozen=True, slots=True)
class Closed:
    """Where the keyframes of a session belong.

    scans : (K,) number of each one's scan. poses : (K, 3) x, y, yaw of each in the map frame.
    loops : between scans in the middle of pieces found to overlap.
    tried : how many pairs of pieces were compared to get them.
    """

    scans: I64
    poses: F64
    loops: tuple[Loop, ...]
    tried: int


class LoopCloser:
    """Closes loops while the session goes on; of a keyframe it keeps no more than its place.

    keyframes : of the session, which pieces are made from when they are needed.
    """

    def __init__(self, keyframes: Keyframes) -> None:
        self._pieces = Pieces(keyframes)
        self._scans = array("q")
        self._poses = array("d")  # as tracked: x, y, yaw of one keyframe after the other
        self._begun = 0  # the keyframe that the next piece starts with
        self._travel_m = 0.0
        self._restarts: set[int] = set()
        self._nodes = np.empty((0, 3))  # settled poses of the pieces' anchors
        self._edges: list[Edge] = []
        self._drift_m = 0.0  # of travel since the pose was last sure
        self._tried = 0

    def extend(self, keyframe: Keyframe) -> None:
        """Take note of the keyframe that was appended last; every few metres that completes a piece."""
        number = len(self._scans)
        if number:
            step = SE2(*self._poses[-3:]).inverse() @ keyframe.T_map_base
            self._travel_m += math.hypot(step.x, step.y) + 0.3 * abs(step.yaw)
            if self._travel_m > _PIECE_TRAVEL_M or keyframe.restart:
                self._complete_piece()
        if keyframe.restart:
            self._restarts.add(number)
        self._scans.append(keyframe.index)
        self._poses.extend((keyframe.T_map_base.x, keyframe.T_map_base.y, keyframe.T_map_base.yaw))

    def finish(self) -> Closed:
        """What came of it. Without a loop everything stays as it was tracked."""
        if not self._scans:
            return Closed(np.empty(0, np.int64), np.empty((0, 3)), (), 0)
        self._complete_piece()
        solution = self._settle()
        loops = tuple(
            Loop(
                older=self._scans[self._pieces.anchor(edge.first)],
                newer=self._scans[self._pieces.anchor(edge.second)],
                T_older_newer=edge.T_first_second,
                information=edge.information,
                accepted=bool(believed),
            )
            for edge, believed in zip(self._edges, solution.believed, strict=True)
            if edge.loop
        )
        poses = self._settled() if loops else self._tracked()
        return Closed(np.array(self._scans, dtype=np.int64), poses, loops, self._tried)

    # --- as the session goes on ---------------------------------------------------------------------------

    def _complete_piece(self) -> None:
        """The last keyframes become a piece: put where tracking says, and compared with older ones."""
        self._pieces.append(range(self._begun, len(self._scans)))
        restart = self._begun in self._restarts
        self._begun, self._travel_m = len(self._scans), 0.0
        newest = len(self._nodes)
        tracked = self._tracked()
        pose = pose_at(tracked, self._pieces.anchor(newest))
        if newest > 0:
            step = pose_at(tracked, self._pieces.anchor(newest - 1)).inverse() @ pose
            length_m = math.hypot(step.x, step.y)
            self._drift_m += _LOST_M if restart else length_m
            self._edges.append(Edge(newest - 1, newest, step, _tracked_information(length_m, restart)))
            pose = pose_at(self._nodes, newest - 1) @ step
        self._nodes = np.vstack((self._nodes, (pose.x, pose.y, pose.yaw)))
        found = list(self._compare(newest))
        if found:
            self._edges += found
            self._drift_m = 0.0
            if not all(self._agrees(edge) for edge in found):
                self._nodes = optimise(self._nodes, self._edges).poses

    def _compare(self, newest: int) -> Iterator[Edge]:
        """Verified overlaps of the newest piece with older ones."""
        window_m = min(_SURE_M + _DRIFT_PER_M * self._drift_m, _MAX_WINDOW_M)
        window_rad = min(_SURE_RAD + _DRIFT_RAD_PER_M * self._drift_m, _MAX_WINDOW_RAD)
        # The one before shares its walls with the newest anyway: tracking held them together.
        distance_m = np.hypot(*(self._nodes[: newest - 1, :2] - self._nodes[newest, :2]).T)
        for older in _few_of_each_visit(distance_m, _NEAR_M + window_m):
            self._tried += 1
            edge = self._tie(older, newest, window_m, window_rad)
            if edge is not None:
                yield edge

    def _tie(self, older: int, newer: int, window_m: float, window_rad: float) -> Edge | None:
        """The measured relative pose of two pieces, near where they are thought to be."""
        guess = pose_at(self._nodes, older).inverse() @ pose_at(self._nodes, newer)
        match = _fit(self._pieces[older], self._pieces[newer], guess, window_m, window_rad)
        return (
            None
            if match is None
            else Edge(older, newer, match.pose, _TIE_TRUST * match.information, loop=True)
        )

    def _agrees(self, edge: Edge) -> bool:
        """Whether a loop leaves everything where it is: then settling can wait."""
        held = pose_at(self._nodes, edge.first).inverse() @ pose_at(self._nodes, edge.second)
        apart = edge.T_first_second.inverse() @ held
        return math.hypot(apart.x, apart.y) < _AGREE_M and abs(apart.yaw) < _AGREE_RAD

    # --- at its end -----------------------------------------------------------------------------------------

    def _settle(self) -> Solution:
        """The pose graph, solved.

        Where its solution bends pieces, what was measured between them was measured on a wrong shape: they
        are drawn again as they are now, and compared again.
        """
        drawn = self._tracked()
        for _ in range(_REDRAWN):
            self._nodes = optimise(self._nodes, self._edges).poses
            settled = self._settled()
            bent = [_bends(drawn[run], settled[run]) for run in self._pieces.runs]
            if not any(bent):
                break
            drawn = settled
            self._pieces.redraw(settled)
            for k, edge in enumerate(self._edges):
                if edge.loop and (bent[edge.first] or bent[edge.second]):
                    self._edges[k] = self._tie(edge.first, edge.second, _SURE_M, _SURE_RAD) or edge
        solution = optimise(self._nodes, self._edges)
        self._nodes = solution.poses
        return solution

    def _settled(self) -> F64:
        """(K, 3) keyframe poses that follow their pieces' anchors, gradually from one to the next; but no
        error grows gradually where tracking was lost, so there each piece keeps its shape to its end."""
        tracked = self._tracked()
        known: dict[int, SE2] = {}
        for piece, run in enumerate(self._pieces.runs):
            anchor = self._pieces.anchor(piece)
            correction = pose_at(self._nodes, piece) @ pose_at(tracked, anchor).inverse()
            ends = [k for k, at in ((run[0], run.start), (run[-1], run.stop)) if at in self._restarts]
            for k in sorted({anchor, *ends}):
                known[k] = correction @ pose_at(tracked, k)
        return spread(tracked, list(known), np.array([(p.x, p.y, p.yaw) for p in known.values()]))

    def _tracked(self) -> F64:
        """(K, 3) keyframe poses before loops were closed."""
        return np.array(self._poses).reshape(-1, 3)


def _bends(drawn: F64, settled: F64) -> bool:
    """Whether the shape of a piece, poses (N, 3) of its keyframes, has changed by more than its noise."""
    before = pose_at(drawn, 0).inverse() @ pose_at(drawn, -1)
    apart = before.inverse() @ pose_at(settled, 0).inverse() @ pose_at(settled, -1)
    return math.hypot(apart.x, apart.y) > _BENT_M or abs(apart.yaw) > _BENT_RAD


def _tracked_information(length_m: float, restart: bool) -> F64:
    """What tracking knows of a step between anchors; next to nothing if it was lost in between."""
    sigma_m, sigma_rad = 0.02 + 0.01 * length_m, math.radians(0.5 + 0.1 * length_m)
    if restart:
        sigma_m, sigma_rad = 1.5, math.radians(60.0)
    return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])


def _few_of_each_visit(distance_m: F64, near_m: float) -> list[int]:
    """Which of the older pieces, (N,) away from the newest, to compare it with.

    A robot that drives up and down sees a place dozens of times. The nearest piece of the first visit, of
    the last and of some in between tie the newest to all of them.
    """
    near = np.flatnonzero(distance_m < near_m)
    if not len(near):
        return []
    visits = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    chosen = [visits[k] for k in evenly(len(visits), _MOST)]
    nearest = [int(visit[np.argmin(distance_m[visit])]) for visit in chosen]
    others = [int(k) for k in near[np.argsort(distance_m[near], kind="stable")] if k not in nearest]
    return nearest + others[: _MOST - len(nearest)]


def _fit(older: Piece, newer: Piece, guess: SE2, window_m: float, window_rad: float) -> Match | None:
    """Where the newer piece lies in the older one, or None if they do not overlap or fit in several ways."""
    chosen = evenly(len(newer.points_m), _SEARCH_POINTS)
    points, face = newer.points_m[chosen], newer.facing_rad[chosen]
    back = older.points_m[evenly(len(older.points_m), _SEARCH_POINTS)]
    fits = []
    for _, start in older.search(points, guess, window_m, window_rad):
        match = older.match(points, face, start)
        seen, agree = older.agreement(points, match.pose)
        seen_back, agree_back = newer.agreement(back, match.pose.inverse())
        if max(seen, seen_back) > _MIN_SEEN and min(seen, seen_back) > 0.15:
            fits.append((min(agree, agree_back), match))
    if not fits:
        return None
    fits.sort(key=lambda fit: -fit[0])
    score, best = fits[0]
    if score < _MIN_AGREEMENT:
        return None
    for other_score, other in fits[1:]:
        apart = best.pose.inverse() @ other.pose
        if math.hypot(apart.x, apart.y) > 0.5 and other_score > score - 0.05:
            return None
    return best


# --- back to every scan ----------------------------------------------------------------------------------


def spread(tracked: F64, known: Sequence[int] | I64, corrected: F64) -> F64:
    """Poses (N, 3) of all scans, from the corrected poses (K, 3) of those of them that are `known`.

    Between two of them the correction passes linearly from one to the other, so the motion that was
    tracked between them stays smooth.
    """
    index = np.asarray(known)
    scans = np.arange(len(tracked))
    left = np.clip(np.searchsorted(index, scans, side="right") - 1, 0, len(index) - 1)
    right = np.minimum(left + 1, len(index) - 1)
    a, b = _moved(tracked, index, corrected, left), _moved(tracked, index, corrected, right)
    span = np.maximum(index[right] - index[left], 1)
    share = np.clip((scans - index[left]) / span, 0.0, 1.0)[:, None]
    turn = np.arctan2(np.sin(b[:, 2] - a[:, 2]), np.cos(b[:, 2] - a[:, 2]))
    mixed: F64 = a + share * np.column_stack((b[:, :2] - a[:, :2], turn))
    mixed[:, 2] = np.arctan2(np.sin(mixed[:, 2]), np.cos(mixed[:, 2]))
    return mixed


def _moved(tracked: F64, index: NDArray[np.integer], corrected: F64, which: NDArray[np.integer]) -> F64:
    """Every scan as if rigidly attached to keyframe number `which`."""
    old, new = tracked[index[which]], corrected[which]
    turn = new[:, 2] - old[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    d = tracked[:, :2] - old[:, :2]
    moved: F64 = np.column_stack(
        (new[:, 0] + c * d[:, 0] - s * d[:, 1], new[:, 1] + s * d[:, 0] + c * d[:, 1], tracked[:, 2] + turn)
    )
    return moved
