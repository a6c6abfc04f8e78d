"""What differs in a session from the building: doors, furniture, relief, glass and mirrors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from pc2grid.arrays import F32
from pc2grid.model import OCCUPIED, OccupancyGrid
from pc2grid.simulate import Building, office_floorplan
from pc2grid.simulate.scene import Mesh, Scene, extrude
from pc2grid_lab.worlds import ChangeConfig, WorldConfig, prepare_session
from pc2grid_lab.worlds.change import GLASS, MIRROR, NO_CHANGE, Change, change_building
from pc2grid_lab.worlds.doors import find_doorways
from pc2grid_lab.worlds.panes import Panes
from tests.helpers.building_clouds import ROOM_M, room_cloud
from tests.helpers.simulated_drives import office, plan


def changed(
    grid: OccupancyGrid, seed: int = 0, shell: Mesh | None = None, **settings: Any
) -> tuple[OccupancyGrid, Mesh | None, Change]:
    streams = np.random.default_rng(seed), np.random.default_rng(99)
    return change_building(grid, shell, ChangeConfig(**settings), *streams, robot_m=0.35)


def with_block() -> OccupancyGrid:
    """A room of 8 x 6 m with a block of 0.8 x 0.6 m in its middle."""
    grid = plan(8.0, 6.0, [])
    cells = grid.cells.copy()
    cells[54:66, 72:88] = OCCUPIED
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))


def test_doorways_are_found() -> None:
    doorways = find_doorways(office())
    # The gaps in the walls of the corridor, each 1 m wide.
    gaps = [(3.5, 6.0), (9.5, 6.0), (16.5, 6.0), (6.5, 8.0), (13.5, 8.0)]
    middles = [np.mean((d.a_m, d.b_m), axis=0) for d in doorways]
    for gap in gaps:
        assert min(np.hypot(*(m - gap)) for m in middles) < 0.2
    assert all(0.6 <= d.width_m <= 1.3 for d in doorways)
    assert find_doorways(plan(8.0, 6.0, [])) == ()


def test_nothing_changes_unless_asked_for() -> None:
    grid = office()
    same, shell, change = changed(grid)
    assert same is grid and shell is None and change is NO_CHANGE
    session = prepare_session(sensor="laser", grid=grid, config=WorldConfig(length_m=2.0))
    assert session.objects == session.clutter


def test_doors_differ_from_session_to_session() -> None:
    grid = office()
    _, _, one = changed(grid, 1, doors=0.8)
    _, _, two = changed(grid, 2, doors=0.8)
    assert one.doorways == two.doorways >= 5
    assert 0 < one.closed + one.ajar <= one.doorways
    assert {f.pose for f in one.added} != {f.pose for f in two.added}
    assert {f.pose for f in one.added} == {f.pose for f in changed(grid, 1, doors=0.8)[2].added}
    assert 0.0 < one.walls_changed < 0.5
    assert "doors closed" in one.describe()


def test_closed_doors_leave_the_robot_room() -> None:
    for seed in range(3):
        config = WorldConfig(length_m=4.0, clutter=0, seed=seed, change=ChangeConfig(doors=1.0, closed=1.0))
        session = prepare_session(sensor="laser", grid=office(), config=config)
        assert session.change.closed > 0
        leaves = [f for f in session.change.added if f.kind == "door"]
        for leaf in leaves:  # the robot drives through none of them
            near = leaf.pose.inverse().apply(session.drive.poses[:, :2])
            low, high = leaf.outline_m.min(axis=0), leaf.outline_m.max(axis=0)
            assert not ((near > low) & (near < high)).all(axis=1).any()


def test_furniture_is_moved_and_exchanged() -> None:
    grid = with_block()
    emptied, _, change = changed(grid, furniture=1.0, exchanged=0.0)
    assert (change.pieces, change.moved, change.exchanged) == (1, 1, 0)
    assert not emptied.occupied[54:66, 72:88].any()
    (block,) = change.added
    assert 0.05 < math.hypot(block.pose.x - 4.0, block.pose.y - 3.0) < 3.0
    _, _, swapped = changed(grid, furniture=1.0, exchanged=1.0)
    assert swapped.exchanged == 1 and swapped.added[0].kind in ("table", "box")


def test_furniture_of_a_real_building_is_cut_out() -> None:
    building = Building.of_cloud(room_cloud())
    ray = np.array([[3.0, 3.25, 1.0, 1.0, 0.0, 0.0]], np.float32)
    assert Scene(building.shell).cast(ray)[0] == pytest.approx(2.0, abs=0.1)
    emptied, shell, change = changed(building.plan, shell=building.shell, furniture=1.0)
    assert change.pieces >= 1 and shell is not None
    assert emptied.occupied.sum() < building.plan.occupied.sum()
    assert Scene(shell).cast(ray)[0] == pytest.approx(ROOM_M[0] - 3.0, abs=0.1)


def test_relief_belongs_to_the_building() -> None:
    grid = office()
    one, two = (
        prepare_session(
            sensor="laser",
            grid=grid,
            config=WorldConfig(length_m=2.0, seed=seed, clutter=0, change=ChangeConfig(relief_per_m=0.3)),
        )
        for seed in (1, 2)
    )
    assert one.change.relief > 10
    assert [f.pose for f in one.change.added] == [f.pose for f in two.change.added]


def walled(what: int) -> tuple[Panes, OccupancyGrid]:
    """A room of 8 x 6 m divided at x = 4 by a wall of glass or mirror."""
    grid = plan(8.0, 6.0, [(4, 0, 4, 6)])
    kind = np.zeros(grid.cells.shape, np.uint8)
    kind[:, 76:84] = what * grid.occupied[:, 76:84]
    return Panes(Scene(extrude(grid, 2.5)), grid, kind, 0.1), grid


def rays_from(x_m: float, degrees: float, count: int = 2000) -> F32:
    a = math.radians(degrees)
    return np.tile(np.array([x_m, 3.0, 1.0, math.cos(a), math.sin(a), 0.0], np.float32), (count, 1))


def test_glass_lets_most_rays_pass_and_is_seen_at_right_angles() -> None:
    panes, _ = walled(GLASS)
    at_an_angle = panes.cast(rays_from(2.0, 20.0), np.random.default_rng(0))
    near = at_an_angle < 2.5
    assert 0.05 < near.mean() < 0.15
    # The others reach the wall behind, 6 m ahead.
    assert np.median(at_an_angle[~near] * math.cos(math.radians(20.0))) == pytest.approx(5.9, abs=0.15)
    assert (panes.cast(rays_from(2.0, 1.0), np.random.default_rng(0)) < 2.1).all()


def test_mirror_shows_the_room_behind_itself() -> None:
    panes, grid = walled(MIRROR)
    distance = panes.cast(rays_from(2.0, 0.0, 10), np.random.default_rng(0))
    # 2 m to the mirror, then back to the wall at x = 0.
    assert distance == pytest.approx(5.9, abs=0.2)
    plain = Scene(extrude(grid, 2.5)).cast(rays_from(2.0, 0.0, 10))
    assert plain == pytest.approx(1.95, abs=0.1)


def test_panes_cover_about_the_share_asked_for() -> None:
    grid = office_floorplan(1)
    _, _, change = changed(grid, glass=0.1, mirrors=0.02)
    assert change.kind is not None
    assert change.glass_m > 3 * change.mirror_m > 0
    config = WorldConfig(length_m=2.0, clutter=0, change=ChangeConfig(glass=0.3))
    session = prepare_session(sensor="lidar", grid=grid, config=config)
    first = [scan.points_m for scan, _ in session.scans()]
    again = [scan.points_m for scan, _ in session.scans()]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
