"""Two maps of one building are joined, and no others."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2
from pc2grid.model import FREE, OCCUPIED, Health, OccupancyGrid, Precision, Trajectory
from signature.database.protocol import BuildingFrame, Deformation, largest_m
from signature.join.building import RIGID, body_of, straighten
from signature.join.join import JOIN, Join, Link, Proposal, join_maps, proposals
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, joinable, part
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import OTHER, office, plan, with_tables

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
    heights = np.where(west.index.grid_of(0).occupied, 1, 0).astype(np.uint8)
    tells = joinable(replace(west.index.grid_of(0), heights=heights))
    assert len(tells.pieces) == len(west.pieces) > 1  # the map is larger than a piece
    for piece, same in zip(tells.pieces, west.pieces, strict=True):
        # Where walls meet, they are solid, and have no points inside.
        assert 0.9 * same.query.walls.weight < piece.query.walls.weight <= same.query.walls.weight


@pytest.mark.parametrize("lidar_asked", [True, False])
def test_tables_of_a_lidar_do_not_part_it_from_a_laser(lidar_asked: bool) -> None:
    """They contradict its free space if nothing tells at which heights they stand."""
    tables = with_tables(west.index.grid_of(0))
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


# --- Sessions of one corridor of 40 m: what one of them knows straightens the other, if that is soft ---


DRIFT = 0.002
"""Rad a metre: over a local map of 4 m as much as one standard deviation of tracking."""
S = np.arange(0.0, 40.05, 0.2)
EXACT = np.diag((0.025, 0.025, 0.002)) ** 2
T_PLAN_DRAWN = SE2(3.0, -2.0, 0.5)
"""How the session begins in the plan."""


def drawn(s: float, drift: float = DRIFT) -> SE2:
    """A pose of the session, which turns slowly where the corridor is straight."""
    return SE2(s, drift * s * s / 2, drift * s)


def true(s: float) -> SE2:
    return T_PLAN_DRAWN @ SE2(s)


def way(drift: float = DRIFT, health: tuple[Health, ...] = ()) -> Trajectory:
    poses = np.array([drawn(s, drift).lift() for s in S.tolist()])
    return Trajectory(stamps_ns=np.arange(len(S)) * 10**8, T_session_base=poses, health=health)


def exact_to(sigma_m: float) -> Precision:
    """Of a local map each 4 m."""
    return Precision(stamps_ns=tuple(range(0, 201 * 10**8, 20 * 10**8)), sigma_m=(sigma_m,) * 11)


SOFT = body_of(way(), (), exact_to(0.1))
"""About as soft as tracking is (`LoopParameters`): its drift is no surprise."""


def frame(T: SE2, bend: Deformation = ()) -> BuildingFrame:
    exact = ((0.0, 0.0, 0.0),) * 3
    return BuildingFrame(name="plan", T_building_session=T, covariance=exact, bend=bend)


def link(s: float, T_target_there: SE2, drift: float = DRIFT) -> Link:
    """A piece of the session, around the place that it passed after `s` metres."""
    at = drawn(s, drift)
    return Link(center_m=(at.x, at.y), T_target_source=T_target_there @ at.inverse(), covariance=EXACT)


FOUND = (4.0, 12.0, 20.0, 28.0, 36.0)


def off_m(at: BuildingFrame, drift: float = DRIFT) -> F64:
    """How far the way lies from the corridor, all along."""
    placed = [at.placed(drawn(s, drift)) for s in S.tolist()]
    errors = [true(s).inverse() @ pose for s, pose in zip(S.tolist(), placed, strict=True)]
    return np.array([math.hypot(error.x, error.y) for error in errors])


def test_a_session_that_drifts_is_straightened_by_a_map() -> None:
    links = {("plan", "drive"): [link(s, true(s)) for s in FOUND]}
    frames = {"plan": frame(SE2()), "drive": frame(T_PLAN_DRAWN)}
    found = straighten({"plan": RIGID, "drive": SOFT}, frames, links)
    assert found["plan"] == frames["plan"]
    # Drawn, its end is 1.6 m off. A piece is exact to 2.5 cm, and 4 m beyond the last one drift goes on for
    # 4 m: 1.6 cm.
    assert off_m(frame(T_PLAN_DRAWN)).max() > 1.5 and off_m(found["drive"]).max() < 0.05
    # About as many rows as there are metres of way in a square.
    assert 10 <= len(found["drive"].bend) <= 12


def test_a_stiff_session_straightens_a_soft_one_and_never_the_other_way() -> None:
    bodies = {"stiff": body_of(way(drift=0.0), (), exact_to(0.01)), "soft": SOFT}
    for names in (("stiff", "soft"), ("soft", "stiff")):
        begin = {"stiff": frame(T_PLAN_DRAWN), "soft": frame(T_PLAN_DRAWN @ SE2(0.0, 0.5, -0.04))}
        links = {("stiff", "soft"): [link(s, SE2(s)) for s in FOUND]}
        found = straighten(bodies, {name: begin[name] for name in names}, links)
        # Nothing that a map could show of it. A bow of 40 m is 0.4 m high: half of it to either side.
        assert found["stiff"].bend == () and largest_m(found["soft"].bend) > 0.2
        T_stiff = found["stiff"].T_building_session
        T_soft_true = [(T_stiff @ SE2(s)).inverse() @ found["soft"].placed(drawn(s)) for s in S.tolist()]
        assert max(math.hypot(error.x, error.y) for error in T_soft_true) < 0.05
        # The session that the frame is named after stays where it lies on an average.
        assert found[names[0]].T_building_session == begin[names[0]].T_building_session


def test_a_wrong_piece_bends_nothing() -> None:
    links = [link(s, true(s)) for s in FOUND]
    links[2] = link(20.0, true(20.0) @ SE2(0.0, 1.0, 0.1))
    found = straighten(
        {"plan": RIGID, "drive": SOFT},
        {"plan": frame(SE2()), "drive": frame(T_PLAN_DRAWN)},
        {("plan", "drive"): links},
    )
    # As without it: between the pieces beside it, tracking is exact enough to refuse it.
    assert off_m(found["drive"]).max() < 0.05


def test_sessions_that_were_joined_before_stay_bent_as_they_are() -> None:
    """The plan lies half a metre to the left of where it was drawn: what is found in it follows."""
    links = {("plan", "drive"): [link(s, true(s)) for s in FOUND]}
    plan = frame(SE2(), ((0.0, 0.0, 0.0, 0.5, 0.0),))
    frames = {"first": frame(SE2()), "plan": plan, "drive": frame(T_PLAN_DRAWN)}
    bodies = {"first": RIGID, "plan": RIGID, "drive": SOFT}
    found = straighten(bodies, frames, links, held=("first", "plan"))
    assert found["first"] == frames["first"] and found["plan"] == plan
    there = found["drive"].placed(drawn(20.0))
    wanted = SE2(0.0, 0.5, 0.0) @ true(20.0)
    assert (there.x, there.y) == pytest.approx((wanted.x, wanted.y), abs=0.05)
