"""The map in space of a carried sensor whose height drifts: its columns stand on their own floor."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.clouds.ground import FloorBelow
from pc2grid.estimation.spatial import SpaceMap
from pc2grid.geometry import F64, SE2
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.model import OccupancyGrid
from pc2grid.settings import ProjectionConfig, RegistrationConfig
from tests.helpers.flat_by_hand import CORRIDOR, carried, images, rising

RISE = 0.02
"""Of the way: 0.38 m when the corridor has been passed twice."""


def mapped(rise: float) -> tuple[OccupancyGrid, F64, list[float | None]]:
    """The map of the corridor by rising poses, the way (N, 2), and the heights above the floor as seen."""
    projection = ProjectionConfig()
    poses = carried(CORRIDOR)
    space, builder, above_m = None, GridBuilder(projection), []
    for scan in images(poses, rising(poses, rise)):
        points, pose = scan.points_m, scan.T_odom_base
        assert pose is not None
        if space is None:
            space = SpaceMap(scan, points, RegistrationConfig(), projection)
        space.extend(scan, points, space.thin(scan, points), pose)
        planar_scan = space.cut(scan, pose)
        builder.add(planar_scan, SE2.from_matrix(pose))
        above_m.append(planar_scan.above_floor_m)
    return builder.grid(), np.array([pose[:2, 3] for pose in poses]), above_m


def on_things(grid: OccupancyGrid, way_m: F64) -> float:
    """The share of the way within 10 cm of what the map calls things."""
    rows, columns = np.nonzero(grid.things)
    things_m = grid.to_point(np.column_stack((rows, columns)))
    return float(np.mean([(np.abs(things_m - at_m) < 0.1).all(axis=1).any() for at_m in way_m]))


@pytest.mark.parametrize("rise", [0.0, RISE, -RISE])
def test_two_passes_at_other_heights_leave_the_way_free(rise: float) -> None:
    grid, way_m, above_m = mapped(rise)
    assert on_things(grid, way_m) == 0.0
    seen = np.array([np.nan if above is None else above for above in above_m])
    true_m = np.array([pose[2, 3] for pose in carried(CORRIDOR)])
    assert np.isfinite(seen).mean() > 0.8
    assert np.nanmax(np.abs(seen - true_m)) < 0.05


def test_without_their_own_floor_the_second_pass_stands_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """The control: the floor stays where it was seen first."""
    follow = FloorBelow.follow
    monkeypatch.setattr(FloorBelow, "follow", lambda self, *of: follow(self, *of) if not self.z_m else None)
    grid, way_m, _ = mapped(RISE)
    assert on_things(grid, way_m) > 0.05
