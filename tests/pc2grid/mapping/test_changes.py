"""What came, went and stands in both of two maps of a room that is 8 m by 6 m."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.mapping.changes import MapChanges, map_changes
from pc2grid.model import UNKNOWN, OccupancyGrid
from tests.helpers.rooms import RESOLUTION_M, grid_of, rectangle

EXACT = np.zeros((3, 3))
ROOM = rectangle(8.0, 6.0)


def draw(*boxes_m: tuple[float, float, float, float], percent: int = 100) -> OccupancyGrid:
    """The room with boxes in it: x, y of the middle, width, height."""
    cells = ROOM.copy()
    empty = grid_of(cells)
    for x, y, width, height in boxes_m:
        corners = np.array([(x - width / 2, y - height / 2), (x + width / 2, y + height / 2)])
        (r0, c0), (r1, c1) = empty.to_cell(corners)
        cells[r0:r1, c0:c1] = percent
    return grid_of(cells)


def kinds(changes: MapChanges) -> list[str]:
    return sorted(patch.kind for patch in changes.patches)


def test_a_box_that_moved_came_and_went() -> None:
    before, after = draw((-2.0, 1.0, 0.6, 0.4)), draw((2.0, -1.0, 0.6, 0.4))
    changes = map_changes(before, after, SE2(), EXACT)
    assert kinds(changes) == ["came", "went"]
    (came,), (went,) = changes.of("came"), changes.of("went")
    # Boxes begin and end at cells.
    assert came.center_m == pytest.approx((2.0, -1.0), abs=RESOLUTION_M)
    assert went.center_m == pytest.approx((-2.0, 1.0), abs=RESOLUTION_M)
    assert (came.length_m, came.width_m) == pytest.approx((0.6, 0.4), abs=RESOLUTION_M)
    assert came.area_m2 == pytest.approx(0.24, rel=0.2)
    # All that is left are the walls, one cell wide.
    assert changes.stood_m2 == pytest.approx(28.0 * RESOLUTION_M, rel=0.05)
    assert changes.common_m2 == pytest.approx(48.0, rel=0.05)


def test_the_same_room_has_not_changed() -> None:
    changes = map_changes(draw((1.0, 1.0, 0.6, 0.4)), draw((1.0, 1.0, 0.6, 0.4)), SE2(), EXACT)
    assert not changes.patches


def test_what_one_of_the_maps_does_not_know_says_nothing() -> None:
    before, after = draw(), draw((-2.0, 1.0, 0.6, 0.4), (2.0, 1.0, 0.6, 0.4))
    cells = before.cells.copy()
    cells[:, : cells.shape[1] // 2] = UNKNOWN
    known_right = replace(before, cells=cells)
    (came,) = map_changes(known_right, after, SE2(), EXACT).patches
    assert came.center_m[0] > 0.0
    (went,) = map_changes(after, known_right, SE2(), EXACT).patches
    assert (went.kind, went.center_m[0] > 0.0) == ("went", True)


def test_maps_in_frames_of_their_own() -> None:
    before, after = draw(), draw((2.0, -1.0, 0.6, 0.4))
    # Row 0 is the smallest y, so this turns the room to the left in its own frame.
    turned = replace(after, cells=np.rot90(after.cells, -1))
    (came,) = map_changes(before, turned, SE2(0.0, 0.0, -math.pi / 2), EXACT).patches
    assert came.center_m == pytest.approx((2.0, -1.0), abs=2 * RESOLUTION_M)
    moved = replace(before, origin_m=(before.origin_m[0] + 3.0, before.origin_m[1] - 2.0))
    (came,) = map_changes(moved, after, SE2(3.0, -2.0, 0.0), EXACT).patches
    assert came.center_m == pytest.approx((5.0, -3.0), abs=RESOLUTION_M)


@pytest.mark.parametrize("kind", ["came", "went"])
def test_errors_of_the_transform_are_no_changes(kind: str) -> None:
    """Walls that lie .15 m off are moved if the transform is good to .1 m, and a change if it is exact."""
    T, room, box = SE2(0.15, 0.0, 0.0), draw(), draw((0.0, 0.0, 0.6, 0.4))
    maps = (room, box) if kind == "came" else (box, room)
    unsure = np.diag([0.1**2, 0.1**2, 0.0])
    assert kinds(map_changes(*maps, T, unsure)) == [kind]
    assert len(map_changes(*maps, T, EXACT).patches) > 1


def test_a_wrong_heading_moves_far_walls_more() -> None:
    """One degree of yaw is .07 m at the walls of a room around the origin, and .35 m twenty metres away."""
    degree = np.diag([0.0, 0.0, math.radians(1.0) ** 2])
    shifted = SE2(0.25, 0.0, 0.0)
    far = replace(draw(), origin_m=(10.0, 10.0))
    assert map_changes(draw(), draw(), shifted, degree).patches
    assert not map_changes(far, far, shifted, degree).patches


def test_weak_evidence_is_no_change() -> None:
    """Of two misses a cell is free by 18 %, of one hit it is occupied by 82 %: one such cell may be an error.
    Of a whole side of a box, not all cells are."""
    glimpsed = replace(draw(), cells=np.where(draw().cells == 0, 18, draw().cells))
    leg, side = draw((0.0, 0.0, 0.05, 0.05)), draw((0.0, 0.0, 1.6, 0.05))
    assert not map_changes(glimpsed, leg, SE2(), EXACT).patches
    assert kinds(map_changes(draw(), leg, SE2(), EXACT)) == ["came"]
    assert kinds(map_changes(glimpsed, side, SE2(), EXACT)) == ["came"]
    (probable,) = map_changes(glimpsed, side, SE2(), EXACT).patches
    (sure,) = map_changes(draw(), side, SE2(), EXACT).patches
    assert probable.probability < sure.probability


def test_maps_that_do_not_overlap_or_are_empty() -> None:
    nothing = OccupancyGrid(cells=np.zeros((0, 0), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    for other in (nothing, replace(draw(), origin_m=(100.0, 100.0))):
        changes = map_changes(draw(), other, SE2(), EXACT)
        assert (changes.patches, changes.stood_m2, changes.common_m2) == ((), 0.0, 0.0)
