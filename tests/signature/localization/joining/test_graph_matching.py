"""Pairs of nodes that agree on one transform."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from signature.localization.joining.graph_matching import (
    NodePairs,
    agreements,
    consistent_set,
)
from signature.localization.joining.landmarks import Landmarks

AT_M = np.array([(0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (0.0, 9.0)])
"""Four nodes of the source, no two of them equally far apart."""
T_TARGET_SOURCE = SE2(20.0, -3.0, math.radians(170.0))
"""A turn beyond half a circle for some pairs, whose headings are known to 15 degrees."""


def landmarks(at_m: F64) -> Landmarks:
    """Nodes with straight ways between them; what is visible there is not looked at."""
    count = len(at_m)
    return Landmarks(
        at_m=at_m,
        ranges_m=np.empty((count, 0), np.float32),
        seen=np.empty((count, 0), bool),
        signatures=np.empty((count, 0), np.float32),
        way_m=np.hypot(*(at_m[:, None] - at_m).transpose(2, 0, 1)).astype(np.float32),
    )


SOURCE, TARGET = landmarks(AT_M), landmarks(T_TARGET_SOURCE.apply(AT_M))


def node_pairs(rows: list[tuple[int, int, float]]) -> NodePairs:
    """From (target, source, error of the heading in degrees)."""
    target, source, off_deg = (np.array(column) for column in zip(*rows, strict=True))
    yaw_rad = np.mod(T_TARGET_SOURCE.yaw + np.radians(off_deg), 2.0 * math.pi)
    return NodePairs(target.astype(np.int64), source.astype(np.int64), yaw_rad, np.ones(len(rows)))


def test_pairs_agree_where_one_transform_explains_both() -> None:
    """Four true pairs, their headings up to 14 degrees apart; one at a wrong node; one at a wrong heading."""
    pairs = node_pairs([(0, 0, 14.0), (1, 1, 5.0), (2, 2, 12.0), (3, 3, 3.0), (2, 0, 8.0), (3, 3, 90.0)])
    agreement = agreements(TARGET, SOURCE, pairs).toarray()
    true = [0, 1, 2, 3]
    assert np.allclose(agreement, agreement.T) and not agreement.diagonal().any()
    # The distances are the same in both sessions: full agreement.
    assert np.allclose(agreement[np.ix_(true, true)], 1.0 - np.eye(4))
    assert not agreement[4:].any()
    assert sorted(consistent_set(agreements(TARGET, SOURCE, pairs))) == true
