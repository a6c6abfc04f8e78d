"""Closing loops: the same place, seen again, makes the map agree with itself.

The session is cut into pieces of a few metres. Each new piece is held against older ones that may
overlap it, found by where it should be or proposed by whoever recognises places; a correlative search
over the uncertainty places it, and only placements that both pieces' free space agrees with count. Then
every keyframe is matched to every piece it overlaps, and a robust pose graph settles all of them (the
scan-to-submap constraints of Hess et al., "Real-time loop closure in 2D lidar SLAM", 2016).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2
from pc2grid.matching import evenly
from pc2grid.model import Loop
from pc2grid.pieces import Keyframe, PieceStore, cut
from pc2grid.pose_graph import Edge, optimise

_ROUNDS = 3
_SEARCH_POINTS = 400
_KEYFRAME_POINTS = 300
_NEAR_M = 8.0
_MAX_WINDOW_M = 3.0
_MAX_WINDOW_RAD = math.radians(20.0)
_MIN_SEEN = 0.35
_MIN_AGREEMENT = 0.8
_SAME_M, _SAME_RAD = 0.01, 0.002


@dataclass(frozen=True, slots=True)
class Proposal:
    """A claim that piece `newer` overlaps piece `older`, to be verified.

    T_older_newer : where the newer piece's anchor should be in the older one's frame, right to within the
        window (metres, radians).
    """

    older: int
    newer: int
    T_older_newer: SE2
    window_m: float
    window_rad: float


class LoopProposer(Protocol):
    """Whoever recognises places: by nearness here, by signatures elsewhere."""

    def propose(self, pieces: PieceStore, newest: int, drift_m: float) -> Iterable[Proposal]:
        """Overlaps of piece `newest` with older ones; `drift_m` metres since its pose was last sure."""


@dataclass(frozen=True, slots=True)
class Nearness:
    """Proposes the pieces that are close enough to overlap, given how far the pose may have drifted."""

    drift_per_m: float = 0.02
    drift_rad_per_m: float = 0.006
    most: int = 6

    def propose(self, pieces: PieceStore, newest: int, drift_m: float) -> Iterable[Proposal]:
        """Nearest first, at most `most`."""
        here = pieces.pose(pieces.anchor(newest))
        window_m = min(0.3 + self.drift_per_m * drift_m, _MAX_WINDOW_M)
        window_rad = min(math.radians(4.0) + self.drift_rad_per_m * drift_m, _MAX_WINDOW_RAD)
        found = []
        for older in range(newest - 1):
            relative = pieces.pose(pieces.anchor(older)).inverse() @ here
            distance = math.hypot(relative.x, relative.y)
            if distance < _NEAR_M + window_m:
                found.append((distance, Proposal(older, newest, relative, window_m, window_rad)))
        found.sort(key=lambda entry: entry[0])
        return [proposal for _, proposal in found[: self.most]]


@dataclass(frozen=True, slots=True)
class Closed:
    """poses (K, 3): x, y, yaw of each keyframe in the map frame. loops: between keyframes in the middle of
    pieces found to overlap, `older` and `newer` counting keyframes. proposals: how many were verified to get
    them."""

    poses: F64
    loops: tuple[Loop, ...]
    proposals: int


def close_loops(keyframes: Sequence[Keyframe], proposers: Sequence[LoopProposer] = (Nearness(),)) -> Closed:
    """Keyframe poses that agree with each other wherever the robot came back to a place."""
    tracked = np.array([(k.T_map_base.x, k.T_map_base.y, k.T_map_base.yaw) for k in keyframes])
    runs = cut(keyframes)
    store = PieceStore(keyframes, runs, tracked)
    found, proposals = _find_loops(store, proposers)
    if not found:
        return Closed(tracked, (), proposals)
    chain = _tracking_edges(keyframes, runs)
    poses = store.poses
    matched: dict[tuple[int, int], tuple[SE2, list[Edge]]] = {}
    for _ in range(_ROUNDS):
        loops: list[Edge] = []
        for older, newer in _overlapping(store):
            relative = store.pose(store.anchor(older)).inverse() @ store.pose(store.anchor(newer))
            at, edges = matched.get((older, newer), (None, []))
            if at is None or not _same(at.inverse() @ relative):
                edges = list(_match_keyframes(store, older, newer))
                matched[older, newer] = relative, edges
            loops += edges
        poses = optimise(poses, chain + loops).poses
        store.move(poses, redraw=True)
    return Closed(poses, found, proposals)


# --- finding overlaps, piece by piece ---------------------------------------------------------------------


def _find_loops(store: PieceStore, proposers: Sequence[LoopProposer]) -> tuple[tuple[Loop, ...], int]:
    """Verified overlaps, between anchors; on return `store` holds poses that honour them."""
    anchors = [store.anchor(piece) for piece in range(len(store.runs))]
    tracked = store.poses
    edges: list[Edge] = []
    believed: Sequence[bool] = ()
    nodes = tracked[anchors].copy()
    drift_m, proposals = 0.0, 0
    for newest in range(1, len(store.runs)):
        step = _pose(tracked, anchors[newest - 1]).inverse() @ _pose(tracked, anchors[newest])
        length = math.hypot(step.x, step.y)
        drift_m += length
        sigma_m, sigma_rad = 0.02 + 0.01 * length, math.radians(0.5 + 0.1 * length)
        edges.append(Edge(newest - 1, newest, step, np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])))
        arrived = _pose(nodes, newest - 1) @ step
        nodes[newest] = arrived.x, arrived.y, arrived.yaw
        store.move(_carry(tracked, store, anchors, nodes, newest), redraw=False)
        found = []
        for proposer in proposers:
            for proposal in proposer.propose(store, newest, drift_m):
                proposals += 1
                edge = _verify(store, proposal)
                if edge is not None:
                    found.append(edge)
        if found:
            edges += found
            solution = optimise(nodes[: newest + 1], edges)
            nodes[: newest + 1], believed = solution.poses, solution.believed.tolist()
            drift_m = 0.0
    store.move(_carry(tracked, store, anchors, nodes, len(store.runs) - 1), redraw=False)
    loops = (
        Loop(
            older=anchors[edge.first],
            newer=anchors[edge.second],
            T_older_newer=edge.T_first_second,
            information=edge.information,
            accepted=accepted,
        )
        # What came after the last loop is no loop.
        for edge, accepted in zip(edges, believed, strict=False)
        if edge.loop
    )
    return tuple(loops), proposals


def _carry(tracked: F64, store: PieceStore, anchors: list[int], nodes: F64, newest: int) -> F64:
    """Keyframe poses when each piece moves rigidly with its anchor."""
    poses = tracked.copy()
    for piece in range(newest + 1):
        correction = _pose(nodes, piece) @ _pose(tracked, anchors[piece]).inverse()
        run = store.runs[piece]
        part = tracked[run.start : run.stop]
        poses[run.start : run.stop, :2] = correction.apply(part[:, :2])
        poses[run.start : run.stop, 2] = part[:, 2] + correction.yaw
    return poses


def _verify(store: PieceStore, proposal: Proposal) -> Edge | None:
    """The measured relative pose of two pieces, or None if they do not overlap or fit in several ways."""
    older, newer = store[proposal.older], store[proposal.newer]
    chosen = evenly(len(newer.points_m), _SEARCH_POINTS)
    points, face = newer.points_m[chosen], newer.facing_rad[chosen]
    back = older.points_m[evenly(len(older.points_m), _SEARCH_POINTS)]
    fits = []
    for _, start in older.search(points, proposal.T_older_newer, proposal.window_m, proposal.window_rad):
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
    return Edge(proposal.older, proposal.newer, best.pose, 0.1 * best.information, loop=True)


# --- settling the keyframes ----------------------------------------------------------------------------


def _overlapping(store: PieceStore) -> list[tuple[int, int]]:
    """Pairs of pieces close enough to share walls, now that the map is roughly right."""
    anchors = [store.anchor(piece) for piece in range(len(store.runs))]
    places = store.poses[anchors][:, :2]
    pairs = []
    for older in range(len(anchors)):
        distance = np.linalg.norm(places[older + 2 :] - places[older], axis=1)
        pairs += [
            (older, older + 2 + int(n)) for n in np.argsort(distance, kind="stable")[:8] if distance[n] < 6.0
        ]
    return pairs


def _same(apart: SE2) -> bool:
    """Whether matching two pieces again would tell nothing new."""
    return math.hypot(apart.x, apart.y) < _SAME_M and abs(apart.yaw) < _SAME_RAD


def _match_keyframes(store: PieceStore, older: int, newer: int) -> Iterable[Edge]:
    """Each keyframe of either piece against the other piece as a whole."""
    for target, source in ((older, newer), (newer, older)):
        piece, anchor = store[target], store.anchor(target)
        T_anchor_map = store.pose(anchor).inverse()
        for k in store.runs[source]:
            guess = T_anchor_map @ store.pose(k)
            hits = store.keyframes[k].sweep.hits_m
            chosen = evenly(len(hits), _KEYFRAME_POINTS)
            points = hits[chosen].astype(np.float64)
            if len(points) < 30 or piece.agreement(points, guess)[0] < _MIN_SEEN:
                continue
            match = piece.match(points, store.facing(k)[chosen], guess)
            seen, agree = piece.agreement(points, match.pose)
            apart = guess.inverse() @ match.pose
            if (
                seen > _MIN_SEEN
                and agree > _MIN_AGREEMENT
                and math.hypot(apart.x, apart.y) < 0.4
                and abs(apart.yaw) < 0.1
            ):
                yield Edge(anchor, k, match.pose, _soften(match.information, 0.01, 0.003), loop=True)


def _tracking_edges(keyframes: Sequence[Keyframe], runs: Sequence[range]) -> list[Edge]:
    """What tracking said: each keyframe relative to the anchors of its own piece and of the one before."""
    edges = []
    for number, run in enumerate(runs):
        for anchor_run in runs[max(number - 1, 0) : number + 1]:
            anchor = anchor_run[len(anchor_run) // 2]
            T_anchor_map = keyframes[anchor].T_map_base.inverse()
            c, s = math.cos(T_anchor_map.yaw), math.sin(T_anchor_map.yaw)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            for k in run:
                if k == anchor or (keyframes[run.start].restart and anchor_run is not run):
                    continue
                relative = T_anchor_map @ keyframes[k].T_map_base
                information = turn @ keyframes[k].information @ turn.T
                distance = math.hypot(relative.x, relative.y)
                edges.append(Edge(anchor, k, relative, _soften(information, 0.01 + 0.003 * distance, 0.003)))
    for k in range(1, len(keyframes)):
        step = keyframes[k - 1].T_map_base.inverse() @ keyframes[k].T_map_base
        loose = 1e-3 if keyframes[k].restart else 1.0
        edges.append(Edge(k - 1, k, step, loose * np.diag([0.05**-2, 0.05**-2, math.radians(2.0) ** -2])))
    return edges


def _soften(information: F64, sigma_m: float, sigma_rad: float) -> F64:
    """Information after adding independent errors: what a match does not know about itself."""
    covariance = np.linalg.inv(information + 1e-3 * np.eye(3))
    softened: F64 = np.linalg.inv(covariance + np.diag([sigma_m**2, sigma_m**2, sigma_rad**2]))
    return 0.5 * (softened + softened.T)


def _pose(poses: F64, index: int) -> SE2:
    x, y, yaw = poses[index]
    return SE2(float(x), float(y), float(yaw))


# --- back to every scan ----------------------------------------------------------------------------------


def spread(tracked: F64, keyframe_index: Sequence[int], corrected: F64) -> F64:
    """Poses (N, 3) of all scans, from the corrected poses (K, 3) of the keyframes among them.

    Between two keyframes the correction passes linearly from one to the other, so the motion that was
    tracked between them stays smooth.
    """
    index = np.asarray(keyframe_index)
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
