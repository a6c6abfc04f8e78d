"""Two maps of one building are joined, and no others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.model import FREE, OCCUPIED, OccupancyGrid
from signature.localization.joining.join import JOIN, Join, Proposal, join_maps, proposals
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, joinable, part
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import office, plan, with_tables

west, east = joinable(part(WEST)), joinable(in_frame(part(EAST), T_OFFICE_EAST))


def off(join: Join, T: SE2, at_m: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """Distance and turn between a join and the truth, at a point of the source."""
    apart = (T @ SE2(*at_m)).inverse() @ join.T_target_source @ SE2(*at_m)
    return math.hypot(apart.x, apart.y), abs(apart.yaw)


def test_two_halves_of_an_office_are_joined_by_their_common_strip() -> None:
    join = join_maps(west, east)
    assert join.status == "joined" and join.probability >= JOIN.accept
    distance_m, turn_rad = off(join, T_OFFICE_EAST)
    # The map of the east is drawn anew in cells of 5 cm that are turned: a cell, and one at each end of 14 m.
    assert distance_m < RESOLUTION_M and turn_rad < 2.0 * RESOLUTION_M / 14.0
    # The strip is 7 x 14 m, without its walls.
    assert 0.85 * 98.0 < join.common_m2 < 98.0
    sigmas = np.sqrt(np.diag(join.covariance))
    assert distance_m < 3.0 * sigmas[:2].max() < 0.3


def test_a_map_that_tells_heights_is_cut_in_the_same_pieces() -> None:
    heights = np.where(west.grid.occupied, 1, 0).astype(np.uint8)
    tells = joinable(replace(west.grid, heights=heights))
    assert len(tells.pieces) == len(west.pieces) > 1  # the map is larger than a piece
    for piece, same in zip(tells.pieces, west.pieces, strict=True):
        # Where walls meet, they are solid, and have no points inside.
        assert 0.9 * same.walls.weight < piece.walls.weight <= same.walls.weight


@pytest.mark.parametrize("lidar_asked", [True, False])
def test_tables_of_a_lidar_do_not_part_it_from_a_laser(lidar_asked: bool) -> None:
    """They contradict its free space if nothing tells at which heights they stand."""
    tables = with_tables(west.grid)
    flat = replace(tables, heights=None)
    told, untold = (
        join_maps(*((joinable(grid), east) if lidar_asked else (east, joinable(grid))))
        for grid in (tables, flat)
    )
    assert told.status == "joined" and told.agreement > 0.95 > 0.6 > untold.agreement


def test_pieces_propose_where_the_other_map_lies() -> None:
    """Among the likeliest: rooms along a corridor look alike, and the walls of all pieces decide."""

    def near(proposal: Proposal) -> bool:
        at = SE2(*proposal.at_m)
        apart = (T_OFFICE_EAST @ at).inverse() @ proposal.T_target_source @ at
        return math.hypot(apart.x, apart.y) < 0.1 and abs(apart.yaw) < math.radians(2.0)

    assert any(map(near, proposals(west.index, east.pieces)[:5]))


MIRRORED = OccupancyGrid(cells=office().cells[:, ::-1].copy(), resolution_m=RESOLUTION_M, origin_m=(0.0, 0.0))
OTHER = plan(16, 12, [(4, 0, 4, 7), (9, 5, 9, 12), (9, 5, 13, 5), (6, 9, 6, 12), (13, 2, 16, 2)])


@pytest.mark.parametrize("other", [MIRRORED, OTHER], ids=["mirrored", "another plan"])
def test_another_building_is_not_joined(other: OccupancyGrid) -> None:
    """The rooms north of the corridor are their own mirror image, but for the side of their doors."""
    assert join_maps(joinable(office()), joinable(other)).status != "joined"


def test_a_wing_that_comes_twice_is_ambiguous() -> None:
    """A hall with two equal wings; the other map is one of them and nothing else."""
    wing = [(0, 5, 3, 5), (4, 5, 9, 5), (3, 0, 3, 3), (6, 2, 6, 5), (2, 7, 5, 7)]
    width_m = 10.0
    both = plan(20, 9, [*wing, *((a + width_m, b, c + width_m, d) for a, b, c, d in wing), (10, 0, 10, 9)])
    single = part((0.0, 0.0, width_m, 9.0), both)
    assert join_maps(joinable(both), joinable(single)).status == "ambiguous"


def test_too_little_in_common_is_not_joined() -> None:
    """The west of the corridor, 2 m wide, and the east of the office: they share 1.5 m of the corridor."""
    left, right = part((0.0, 6.0, 10.5, 8.0)), part((9.0, 0.0, 20.0, 14.0))
    join = join_maps(joinable(right), joinable(left))
    assert join.common_m2 < JOIN.least_m2 and join.status != "joined"


def test_a_bent_map_is_joined_and_says_how_bent_it_is() -> None:
    """The office, bent sideways by 0.3 m at its far end: six cells, so its walls fit nowhere as a whole."""
    cells = np.full((300, 400), -1, np.int8)
    straight = office().cells
    for column in range(400):
        shift = round(6.0 * (column / 400.0) ** 2)
        cells[10 + shift : 10 + shift + 280, column] = straight[:, column]
    bent = OccupancyGrid(cells=cells, resolution_m=RESOLUTION_M, origin_m=(0.0, -0.5))
    join = join_maps(joinable(office()), joinable(bent))
    assert join.status == "joined"
    # The best line through the bend leaves 0.3 m / 12, and no end is farther off than half of the bend.
    assert off(join, SE2(), (10.0, 7.0))[0] < 0.15
    straight_join = join_maps(joinable(office()), joinable(office()))
    assert least_variance_m2(join) > 1.2 * least_variance_m2(straight_join)


def least_variance_m2(join: Join) -> float:
    """Variance of the position at the point of the source where it is least, which the graphs' choice of a
    first node does not change."""
    C = join.covariance
    return float(np.trace(C[:2, :2]) - C[:2, 2] @ C[:2, 2] / C[2, 2])


def test_an_empty_map_is_joined_with_nothing() -> None:
    room = np.full((60, 60), FREE, np.int8)
    room[[0, -1]], room[:, [0, -1]] = OCCUPIED, OCCUPIED
    empty = OccupancyGrid(cells=np.full((40, 40), -1, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    alone = OccupancyGrid(cells=room, resolution_m=0.05, origin_m=(0.0, 0.0))
    for target, source in ((west, joinable(empty)), (joinable(empty), west), (west, joinable(alone))):
        assert join_maps(target, source).status != "joined"
