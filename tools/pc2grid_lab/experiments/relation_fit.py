"""Which relative pose do the scans support: that of a relation of the SLAM benchmark, or a trajectory's?

The relations (`slam_relations`) were made from the result of another program, and checked by people who
looked at scans laid over each other. That finds gross errors, but not centimetres: an error of a trajectory
below the noise of the relations says nothing about it. So both relative poses are applied to the raw scans
of a pair, and the walls that fit better tell which one is nearer to the truth.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.model import Scan, Trajectory
from pc2grid_lab.experiments.slam_relations import Relations, compared_poses


@dataclass(frozen=True, slots=True, kw_only=True)
class RelationFitParameters:
    """Numbers of the comparison, chosen by hand.

    range_m : points farther from the sensor are left out: they are too sparse to match.
    seen_m : a point with another one within this distance is seen in both scans.
    capped_m : distances count as at most this, so that what moved does not decide.
    least_overlap : share of the points of both scans that must be seen in the other, for both relative poses.
    """

    range_m: float = 20.0
    seen_m: float = 0.3
    capped_m: float = 0.1
    least_overlap: float = 0.5


RELATION_FIT = RelationFitParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class RelationFit:
    """Mean distance between the points of two scans, over all pairs that overlap.

    relations_m, trajectory_m : placed by the relation, and by the trajectory.
    better : share of the pairs that fit better by the trajectory, 0..1. pairs : how many overlap.
    """

    relations_m: float
    trajectory_m: float
    better: float
    pairs: int


def relation_fit(
    scans: Iterable[Scan],
    trajectory: Trajectory,
    relations: Relations,
    *,
    base_to_reference_m: tuple[float, float] = (0.0, 0.0),
    parameters: RelationFitParameters = RELATION_FIT,
) -> RelationFit:
    """Compare the relations with the trajectory on the scans (of a 2D laser) that both speak of.

    scans : all of the trajectory, in its order; only those that a relation names stay in memory.
    base_to_reference_m : as of `relation_error`.
    """
    first, second, by_relation, by_trajectory = compared_poses(
        trajectory, relations, base_to_reference_m=base_to_reference_m
    )
    needed = set(first.tolist()) | set(second.tolist())
    points_m: dict[int, F64] = {}
    for k, scan in enumerate(scans):
        if k in needed:
            points = scan.points_m[:, :2].astype(np.float64) - base_to_reference_m
            points_m[k] = points[np.hypot(points[:, 0], points[:, 1]) < parameters.range_m]
    found = []
    for a, b, relation, own in zip(first.tolist(), second.tolist(), by_relation, by_trajectory, strict=True):
        fits = [
            _distance(points_m[a], points_m[b], SE2(*pose.tolist()), parameters) for pose in (relation, own)
        ]
        if min(overlap for _, overlap in fits) >= parameters.least_overlap:
            found.append([distance_m for distance_m, _ in fits])
    if not found:
        return RelationFit(relations_m=float("nan"), trajectory_m=float("nan"), better=float("nan"), pairs=0)
    relations_m, trajectory_m = np.array(found).T
    return RelationFit(
        relations_m=float(relations_m.mean()),
        trajectory_m=float(trajectory_m.mean()),
        better=float((trajectory_m < relations_m).mean()),
        pairs=len(found),
    )


def _distance(a: F64, b: F64, T_a_b: SE2, parameters: RelationFitParameters) -> tuple[float, float]:
    """Mean distance of the points of each scan from the other one, and the smaller share seen there."""
    distances, shares = [], []
    for target, points in ((a, T_a_b.apply(b)), (b, T_a_b.inverse().apply(a))):
        if not len(target) or not len(points):
            return float("nan"), 0.0
        nearest_m, _ = cKDTree(target).query(points)
        seen = nearest_m < parameters.seen_m
        shares.append(float(seen.mean()))
        distances.append(
            float(np.minimum(nearest_m[seen], parameters.capped_m).mean()) if seen.any() else 0.0
        )
    return float(np.mean(distances)), min(shares)
