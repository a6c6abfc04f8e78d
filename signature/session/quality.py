"""The quality of a map without ground truth: its consistency with its scans, and the precision of its poses.

Consistency. Where a trajectory is bent, the robot draws a place a second time beside the first. Scans of one
visit then put walls on ground that scans of other visits observed as free. A map of several scans keeps the
majority, so the measure is, for each scan, the share of its wall hits on free ground of the final map, away
from every wall. A place that was visited only once cannot contradict itself. People put hits on free ground
as well, but they walk on: a hit counts only if the keyframe before or after has it too, within a cell. Doors
and moved chairs stay for a while, in one corner of the view, whereas a bent trajectory shifts whole walls for
metres of travel. So the share is averaged over a few metres of travel, and only a large share counts.

Precision. A corridor that was driven once cannot contradict anything, but the covariance of the pose graph
grows along it, and shrinks wherever a loop ties it to the rest. The covariance of the poses is the inverse of
the information matrix (Thrun, Burgard and Fox, "Probabilistic Robotics", chapter 11). It is given relative to
the whole of the session, not to the first pose: the error of each position is that which remains after the
whole has been fitted to the truth (the S-transformation of Baarda, 1973, as free networks are adjusted in
geodesy).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, tee

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from pc2grid.geometry import F64, I64, SE2, BoolGrid, wrap_angle
from pc2grid.model import (
    MOST_LISTED,
    Consistency,
    Contradiction,
    OccupancyGrid,
    Precision,
    Trajectory,
    UncertainSegment,
)
from signature.session.graph import Edge, WallDirection, information_matrix
from signature.session.keyframes import TURN_M_PER_RAD, Keyframe
from signature.session.local_maps import LOCAL_MAPS


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsistencyParameters:
    """Numbers of the check.

    wall_m : a hit on free ground counts if it is farther than this from every wall; three cells of the
        default resolution. From the first trial on real logs.
    window_m : travel over which the share of contradicting hits is averaged.
    contradicted_from : share of the hits of a window from which its middle contradicts the map.
    bent_from : share of the travel that contradicts a map from which the map is called bent.
    shown : contradictions that are kept, the longest first.

    `window_m`, `contradicted_from` and `bent_from` were chosen on real logs and simulated drives, whose poses
    were the true ones, those with loops closed, those without loops, and true poses bent on purpose
    (`examples/recordings.md`).
    """

    wall_m: float = 0.15
    window_m: float = 5.0
    contradicted_from: float = 0.2
    bent_from: float = 0.005
    shown: int = MOST_LISTED


CONSISTENCY = ConsistencyParameters()


def measure_consistency(
    keyframes: Iterable[Keyframe],
    grid: OccupancyGrid,
    trajectory: Trajectory,
) -> Consistency:
    """Compare keyframes with the grid that was drawn from them.

    trajectory : the poses at which they were drawn; `Keyframe.index` is the number of a pose.
    The keyframes are read one after the other; of each, three numbers stay in memory.
    """
    clear = _clear_ground(grid, CONSISTENCY.wall_m)
    drawn = (
        _drawn(keyframe, SE2.from_matrix(trajectory.T_session_base[keyframe.index]), grid, clear)
        for keyframe in keyframes
    )
    before, here, after = tee(drawn, 3)
    next(after, None)
    with_neighbours = zip(chain((None,), before), here, chain(after, (None,)), strict=False)
    counts = [
        (scan.index, len(scan.hits_m), _confirmed(earlier, scan, later, grid.resolution_m))
        for earlier, scan, later in with_neighbours
    ]
    if not counts:
        return Consistency()
    index, hits, contradicting = np.array(counts, dtype=np.int64).T
    poses = trajectory.planar()[index]
    shares = _window_shares(poses, hits, contradicting)
    contradicted = shares >= CONSISTENCY.contradicted_from
    share_of_keyframes = float(contradicted.mean())
    return Consistency(
        hits_on_free=float(contradicting.sum() / max(hits.sum(), 1)),
        contradicted=share_of_keyframes,
        bent=share_of_keyframes >= CONSISTENCY.bent_from,
        stretches=_contradictions(contradicted, shares, poses, trajectory.stamps_ns[index])[
            : CONSISTENCY.shown
        ],
    )


def consistency_warning(
    consistency: Consistency,
    trajectory: Trajectory,
    *,
    with_odometry: bool = False,
) -> str | None:
    """Return a warning with the place where a map is bent and what to do; None if it is not bent.

    with_odometry : the recording has odometry, so that it need not be advised.
    """
    if not consistency.bent or not consistency.stretches:
        return None
    longest = consistency.stretches[0]
    start_ns = int(trajectory.stamps_ns[0])
    from_s, to_s = ((stamp - start_ns) * 1e-9 for stamp in (longest.from_ns, longest.to_ns))
    return (
        f"the map contradicts itself along {consistency.contradicted:.0%} of the travel and is probably "
        f"bent: near x {longest.x_m:.1f}, y {longest.y_m:.1f} m, {from_s:.0f} to {to_s:.0f} s after the "
        "first scan, walls stand on ground that other scans saw free; look there in the report, and record "
        f"that part again{'' if with_odometry else ' with odometry'}, or leave it out with --start and "
        "--duration"
    )


def _clear_ground(grid: OccupancyGrid, wall_m: float) -> BoolGrid:
    """Return the free cells (H, W) whose centres are farther than `wall_m` from the centre of every occupied
    cell."""
    if not grid.cells.size:
        return np.zeros(grid.cells.shape, np.bool_)
    reach = math.floor(wall_m / grid.resolution_m)
    offsets = np.arange(-reach, reach + 1)
    disc = (np.hypot(*np.meshgrid(offsets, offsets)) * grid.resolution_m <= wall_m + 1e-9).astype(np.uint8)
    near_wall = cv2.dilate(grid.occupied.astype(np.uint8), disc)
    return np.asarray(grid.free & (near_wall == 0))


@dataclass(frozen=True, slots=True)
class _Drawn:
    """The hits of a keyframe in the session frame.

    index : number of its scan. hits_m : (M, 2) within reach. on_clear : (M,) mask of those on clear ground.
    """

    index: int
    hits_m: F64
    on_clear: NDArray[np.bool_]


def _drawn(keyframe: Keyframe, pose: SE2, grid: OccupancyGrid, clear: BoolGrid) -> _Drawn:
    """Return the hits within reach, and which of them lie on clear ground."""
    scan = keyframe.planar_scan
    hits_m = pose.apply(scan.hits_m[np.hypot(*(scan.hits_m - scan.origin_m).T) < LOCAL_MAPS.range_m])
    return _Drawn(keyframe.index, hits_m, grid.look_up(clear, hits_m, outside=False))


def _confirmed(before: _Drawn | None, scan: _Drawn, after: _Drawn | None, cell_m: float) -> int:
    """Count the hits on clear ground that a neighbouring scan confirms within a cell.

    A moving object is elsewhere in the next keyframe; a wall in the wrong place is not.
    """
    doubtful_m = scan.hits_m[scan.on_clear]
    seen_again = np.zeros(len(doubtful_m), np.bool_)
    for neighbour in (before, after):
        if neighbour is not None and len(doubtful_m) and len(neighbour.hits_m):
            distance_m, _ = cKDTree(neighbour.hits_m).query(doubtful_m, distance_upper_bound=cell_m)
            seen_again |= distance_m < cell_m
    return int(np.count_nonzero(seen_again))


def _window_shares(poses: F64, hits: I64, contradicting: I64) -> F64:
    """Return the share of contradicting hits in the window of travel around each of the poses (K, 3)."""
    steps = np.diff(poses, axis=0)
    step_m = np.hypot(steps[:, 0], steps[:, 1]) + TURN_M_PER_RAD * np.abs(wrap_angle(steps[:, 2]))
    travel_m = np.concatenate(([0.0], np.cumsum(step_m)))
    first = np.searchsorted(travel_m, travel_m - 0.5 * CONSISTENCY.window_m, side="left")
    last = np.searchsorted(travel_m, travel_m + 0.5 * CONSISTENCY.window_m, side="right")
    in_window = [np.concatenate(([0], np.cumsum(counts))) for counts in (hits, contradicting)]
    all_hits, all_contradicting = (total[last] - total[first] for total in in_window)
    return np.asarray(all_contradicting / np.maximum(all_hits, 1))


def _contradictions(
    contradicted: BoolGrid, shares: F64, poses: F64, stamps_ns: I64
) -> tuple[Contradiction, ...]:
    """Return the runs of contradicting keyframes (K,), the longest in metres first."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], contradicted, [False]))))
    found = []
    for begin, end in edges.reshape(-1, 2).tolist():
        worst = begin + int(np.argmax(shares[begin:end]))
        length_m = np.hypot(*np.diff(poses[begin:end, :2], axis=0).T).sum()
        found.append(
            Contradiction(
                from_ns=int(stamps_ns[begin]),
                to_ns=int(stamps_ns[end - 1]),
                x_m=float(poses[worst, 0]),
                y_m=float(poses[worst, 1]),
                length_m=float(length_m),
                share=float(shares[worst]),
            )
        )
    return tuple(sorted(found, key=lambda one: (-one.length_m, one.from_ns)))


PROMISED_M = 0.5
"""Standard deviation of a position from which a place is called uncertain. Beyond it, an answer that is exact
to the walls around it is off in the map by more than that as often as one in three."""


LEAST_TRAVEL_M = 8.0
"""A part, or a loose stretch, with less travel is left out: later recordings are recognised by so much and
more."""


def position_sigmas(poses: F64, edges: Sequence[Edge], walls: Sequence[WallDirection] | None = None) -> F64:
    """Return the standard deviation (N,) of each position in metres, in its least certain direction.

    poses : (N, 3) x, y, yaw that agree best with the edges. edges : those that count; they connect all poses.
    walls : of each pose, if the building's axes constrain the headings.
    """
    if len(poses) < 2:
        return np.zeros(len(poses))
    # The first pose is fixed. Which one is does not matter, as the whole is placed afterwards.
    information = information_matrix(poses, edges, walls).tocsc()[3:, 3:]
    factors = splu(information, permc_spec="MMD_AT_PLUS_A")

    def with_covariance(columns: F64) -> F64:
        """Return the product of the covariance (3 N, 3 N) of all poses with columns (3 N, K)."""
        return np.concatenate((np.zeros((3, columns.shape[1])), factors.solve(columns[3:])))

    blocks = np.empty((len(poses), 2, 2))
    for k in range(len(poses)):
        unit = np.zeros((3 * len(poses), 2))
        unit[3 * k, 0] = unit[3 * k + 1, 1] = 1.0
        blocks[k] = with_covariance(unit)[3 * k : 3 * k + 2]
    # The whole is placed by least squares: its motion is `placement` (3, 3 N) times the errors.
    moved = _moved_by_whole(poses)
    by_pose = np.zeros((len(poses), 3, 3))
    by_pose[:, :2] = moved @ np.linalg.inv(np.einsum("nai,naj->ij", moved, moved))
    placement = by_pose.reshape(-1, 3)
    with_errors = with_covariance(placement)
    across = with_errors.reshape(-1, 3, 3)[:, :2] @ moved.transpose(0, 2, 1)
    covariance = blocks - across - across.transpose(0, 2, 1)
    covariance += moved @ (placement.T @ with_errors) @ moved.transpose(0, 2, 1)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0)))


def _moved_by_whole(poses: F64) -> F64:
    """Return the Jacobian (N, 2, 3) of each position in a motion x, y, yaw of the whole about its middle."""
    moved = np.zeros((len(poses), 2, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    away = poses[:, :2] - poses[:, :2].mean(axis=0)
    moved[:, 0, 2], moved[:, 1, 2] = -away[:, 1], away[:, 0]
    return moved


def precision_of(trajectory: Trajectory, scans: I64, sigma_m: F64) -> Precision:
    """Return the precision of a map, from the standard deviations (N,) at some of its scans (N,), in their
    order."""
    if not len(scans):
        return Precision()
    stamps_ns, xy, travel_m = trajectory.stamps_ns, trajectory.planar()[:, :2], trajectory.path_m()
    # Every local map stands for the travel up to the middle between it and the next.
    middles = (scans[1:] + scans[:-1]) // 2
    begins, ends = np.append(0, middles), np.append(middles, len(trajectory) - 1)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], sigma_m > PROMISED_M, [False]))))
    found = []
    for begin, end in edges.reshape(-1, 2).tolist():
        first, last = int(begins[begin]), int(ends[end - 1])
        worst = begin + int(np.argmax(sigma_m[begin:end]))
        length_m = float(travel_m[last] - travel_m[first])
        if length_m >= LEAST_TRAVEL_M:
            found.append(
                UncertainSegment(
                    from_ns=int(stamps_ns[first]),
                    to_ns=int(stamps_ns[last]),
                    x_m=float(xy[scans[worst], 0]),
                    y_m=float(xy[scans[worst], 1]),
                    length_m=length_m,
                    sigma_m=round(float(sigma_m[worst]), 3),
                )
            )
    return Precision(
        stamps_ns=tuple(stamps_ns[scans].tolist()),
        sigma_m=tuple(sigma_m.round(3).tolist()),
        loose=tuple(sorted(found, key=lambda one: (-one.sigma_m, one.from_ns))),
    )


def precision_warning(precision: Precision, trajectory: Trajectory) -> str | None:
    """Return a warning with the part of a map that is weakly tied to the rest and what to do; None if none
    is."""
    if not precision.loose:
        return None
    worst = precision.loose[0]
    start_ns = int(trajectory.stamps_ns[0])
    from_s, to_s = ((stamp - start_ns) * 1e-9 for stamp in (worst.from_ns, worst.to_ns))
    others = len(precision.loose) - 1
    more = f" (and {others} more such stretch{'es' if others > 1 else ''})" if others else ""
    return (
        f"no loop ties {worst.length_m:.0f} m of the travel, {from_s:.0f} to {to_s:.0f} s after the first "
        f"scan{more}, well to the rest: near x {worst.x_m:.1f}, y {worst.y_m:.1f} m the map may be off "
        f"by {worst.sigma_m:.1f} m (standard deviation), and no doubled wall would show it; come back from "
        "there to a place seen before, by another way if there is one"
    )
