"""Does a map agree with the scans it was drawn from?

Where a trajectory is bent, the robot draws a place a second time beside the first. Scans of one visit then
put walls on ground that scans of other visits saw free. A map of several scans keeps what most of them say,
so the figure is, for each scan, the share of its wall hits that lie on free ground of the final map, away
from every wall. No ground truth is needed. A place that was seen only once cannot disagree.

Only hits that end the view are taken as walls. People put hits on free ground as well, but they walk on: a
hit counts only if the keyframe before or after has seen it too. Doors and moved chairs stay for a while, in
one corner of the view, whereas a bent place shifts whole walls for metres of travel. So the share is averaged
over a few metres of travel, and only a large share counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, tee

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pc2grid.arrays import F64, I64, BoolGrid
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.mapping.keyframes import Keyframe
from pc2grid.model import Consistency, Contradiction, OccupancyGrid, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsistencyParameters:
    """Numbers of the check.

    reach_m : hits farther from the sensor are left out: there a small error of yaw moves them far. From the
        first trial on real logs.
    wall_m : a hit on free ground counts if it is farther than this from every wall; three cells of the
        default resolution. From the same trial.
    sectors, behind_m : a hit counts if no other hit in its sector of the view lies more than `behind_m`
        behind it: what a lidar sees over, or a floor taken for an obstacle, is no wall. Half a degree.
    same_m : a neighbouring keyframe has seen a hit if it has a hit within this distance; two cells of the
        default resolution.
    window_m : travel over which the share of contradicting hits is averaged.
    turn_m_per_rad : travel that a turn on the spot counts as, as in loop closure.
    fewest_hits : of a window; with fewer, the share is computed as if there were so many.
    contradicted_from : share of the hits of a window from which its middle contradicts the map.
    bent_from : share of the travel that contradicts a map from which the map is called bent.
    shown : stretches that are kept, the longest first.

    `window_m`, `contradicted_from` and `bent_from` were chosen on real logs and simulated drives, whose poses
    were the true ones, those with loops closed, those without loops, and true poses bent on purpose
    (`examples/recordings.md`).
    """

    reach_m: float = 12.0
    wall_m: float = 0.15
    sectors: int = 720
    behind_m: float = 0.3
    same_m: float = 0.1
    window_m: float = 5.0
    turn_m_per_rad: float = 0.3
    fewest_hits: int = 30
    contradicted_from: float = 0.2
    bent_from: float = 0.005
    shown: int = 20


CONSISTENCY = ConsistencyParameters()


def measure_consistency(
    keyframes: Iterable[Keyframe],
    grid: OccupancyGrid,
    trajectory: Trajectory,
    parameters: ConsistencyParameters = CONSISTENCY,
) -> Consistency:
    """Compare keyframes with the grid that was drawn from them.

    trajectory : the poses at which they were drawn; `Keyframe.index` is the number of a pose.
    The keyframes are read one after the other; of each, three numbers stay in memory.
    """
    clear = _clear_ground(grid, parameters.wall_m)
    drawn = (
        _drawn(keyframe, SE2.from_matrix(trajectory.T_session_base[keyframe.index]), grid, clear, parameters)
        for keyframe in keyframes
    )
    counts = [
        (scan.index, len(scan.hits_m), _confirmed(before, scan, after, parameters.same_m))
        for before, scan, after in _with_neighbours(drawn)
    ]
    if not counts:
        return Consistency()
    index, hits, contradicting = np.array(counts, dtype=np.int64).T
    poses = trajectory.planar()[index]
    shares = _window_shares(poses, hits, contradicting, parameters)
    contradicted = shares >= parameters.contradicted_from
    share_of_keyframes = float(contradicted.mean())
    return Consistency(
        hits_on_free=float(contradicting.sum() / max(hits.sum(), 1)),
        contradicted=share_of_keyframes,
        bent=share_of_keyframes >= parameters.bent_from,
        stretches=_stretches(contradicted, shares, poses, trajectory.stamps_ns[index])[: parameters.shown],
    )


def consistency_warning(
    consistency: Consistency,
    trajectory: Trajectory,
    *,
    with_odometry: bool = False,
) -> str | None:
    """One sentence that says where a map is bent and what to do; None if it is not bent.

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
    """(H, W) free cells whose centres are farther than `wall_m` from the centre of every occupied cell."""
    if not grid.cells.size:
        return np.zeros(grid.cells.shape, np.bool_)
    reach = math.floor(wall_m / grid.resolution_m)
    offsets = np.arange(-reach, reach + 1)
    disc = (np.hypot(*np.meshgrid(offsets, offsets)) * grid.resolution_m <= wall_m + 1e-9).astype(np.uint8)
    near_wall = cv2.dilate(grid.occupied.astype(np.uint8), disc)
    clear: BoolGrid = grid.free & (near_wall == 0)
    return clear


@dataclass(frozen=True, slots=True)
class _Drawn:
    """The hits of a keyframe in the session frame.

    index : number of its scan. hits_m : (M, 2) within reach. on_clear : (M,) which lie on clear ground.
    """

    index: int
    hits_m: F64
    on_clear: NDArray[np.bool_]


def _drawn(
    keyframe: Keyframe, pose: SE2, grid: OccupancyGrid, clear: BoolGrid, parameters: ConsistencyParameters
) -> _Drawn:
    """The hits that end the view, and which of them lie on clear ground."""
    rays_m = keyframe.planar_scan.hits_m - keyframe.planar_scan.origin_m
    range_m, bearing_rad = np.hypot(*rays_m.T), np.arctan2(rays_m[:, 1], rays_m[:, 0])
    sector = (
        np.floor(bearing_rad / (2.0 * math.pi) * parameters.sectors).astype(np.int64) % parameters.sectors
    )
    farthest_m = np.zeros(parameters.sectors)
    np.maximum.at(farthest_m, sector, range_m)
    ends_view = range_m > farthest_m[sector] - parameters.behind_m
    hits_m = pose.apply(keyframe.planar_scan.hits_m[ends_view & (range_m < parameters.reach_m)])
    cells = grid.to_cell(hits_m)
    inside = ((cells >= 0) & (cells < clear.shape)).all(axis=1)
    on_clear = np.zeros(len(hits_m), np.bool_)
    on_clear[inside] = clear[tuple(cells[inside].T)]
    return _Drawn(keyframe.index, hits_m, on_clear)


def _with_neighbours(scans: Iterable[_Drawn]) -> Iterator[tuple[_Drawn | None, _Drawn, _Drawn | None]]:
    """Each scan between the one before and the one after it; None at the two ends."""
    before, here, after = tee(scans, 3)
    next(after, None)
    return zip(chain((None,), before), here, chain(after, (None,)), strict=False)


def _confirmed(before: _Drawn | None, scan: _Drawn, after: _Drawn | None, same_m: float) -> int:
    """How many hits on clear ground a neighbouring scan has seen too, within `same_m`.

    Something that moves is elsewhere in the next keyframe; a wall in the wrong place is not.
    """
    doubtful_m = scan.hits_m[scan.on_clear]
    seen_again = np.zeros(len(doubtful_m), np.bool_)
    for neighbour in (before, after):
        if neighbour is not None and len(doubtful_m) and len(neighbour.hits_m):
            distance_m, _ = cKDTree(neighbour.hits_m).query(doubtful_m, distance_upper_bound=same_m)
            seen_again |= distance_m < same_m
    return int(np.count_nonzero(seen_again))


def _window_shares(poses: F64, hits: I64, contradicting: I64, parameters: ConsistencyParameters) -> F64:
    """Share of contradicting hits in the window of travel around each of the poses (K, 3)."""
    steps = np.diff(poses, axis=0)
    step_m = np.hypot(steps[:, 0], steps[:, 1]) + parameters.turn_m_per_rad * np.abs(wrap_angle(steps[:, 2]))
    travel_m = np.concatenate(([0.0], np.cumsum(step_m)))
    first = np.searchsorted(travel_m, travel_m - 0.5 * parameters.window_m, side="left")
    last = np.searchsorted(travel_m, travel_m + 0.5 * parameters.window_m, side="right")
    in_window = [np.concatenate(([0], np.cumsum(counts))) for counts in (hits, contradicting)]
    all_hits, all_contradicting = (total[last] - total[first] for total in in_window)
    shares: F64 = all_contradicting / np.maximum(all_hits, parameters.fewest_hits)
    return shares


def _stretches(contradicted: BoolGrid, shares: F64, poses: F64, stamps_ns: I64) -> tuple[Contradiction, ...]:
    """The runs of contradicting keyframes (K,), the longest in metres first."""
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
    return tuple(sorted(found, key=lambda stretch: (-stretch.length_m, stretch.from_ns)))
