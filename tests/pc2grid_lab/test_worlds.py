"""Doors and furniture differ from session to session."""

from __future__ import annotations

import math

from pc2grid.model import OCCUPIED, OccupancyGrid
from pc2grid_lab.worlds import WorldConfig, change_plan, prepare_session
from tests.helpers.simulated_drives import office, plan


def with_block() -> OccupancyGrid:
    """A room of 8 x 6 m with a block of 0.8 x 0.6 m in its middle."""
    grid = plan(8.0, 6.0, [])
    cells = grid.cells.copy()
    cells[54:66, 72:88] = OCCUPIED
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))


def test_doors_differ_from_session_to_session_and_the_robot_drives_through_none() -> None:
    poses = []
    for seed in (1, 2, 1):
        config = WorldConfig(length_m=4.0, clutter=0, seed=seed, change=0.9)
        session = prepare_session(sensor="laser", grid=office(), config=config)
        leaves = [f for f in session.added if f.kind == "door"]
        poses.append({f.pose for f in leaves})
        for leaf in leaves:
            near = leaf.pose.inverse().apply(session.drive.poses[:, :2])
            low, high = leaf.outline_m.min(axis=0), leaf.outline_m.max(axis=0)
            assert not ((near > low) & (near < high)).all(axis=1).any()
    assert poses[0] == poses[2] != poses[1] and len(poses[0]) >= 3


def test_furniture_is_moved_or_exchanged() -> None:
    kinds = set()
    for seed in range(8):
        emptied, (block,) = change_plan(with_block(), WorldConfig(seed=seed, change=1.0))
        assert not emptied.occupied[54:66, 72:88].any()
        assert math.hypot(block.pose.x - 4.0, block.pose.y - 3.0) < 3.0
        kinds.add("moved" if block.kind == "moved" else "exchanged")
    assert kinds == {"moved", "exchanged"}
