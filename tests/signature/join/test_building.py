"""The sessions of a database become buildings with one frame each."""

import functools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import DatabaseError
from pc2grid.geometry import SE2
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, Precision, Trajectory
from signature.database import Label, SubmapDatabase, maintenance, open_database
from signature.database.protocol import BuildingFrame, Deformation
from signature.join.building import building_map, join_sessions, map_of
from signature.localization.answer import Answer, answer_in_building, covariance_in_building
from signature.localization.localizer import locate_map
from tests.helpers.databases import stored
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, part
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import OTHER, building, office, office_part

NONE: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3


MAPS = {"west": part(WEST), "elsewhere": OTHER, "east": in_frame(part(EAST), T_OFFICE_EAST)}
SESSIONS = {name: session(name, grid, way()) for name, grid in MAPS.items()}


@pytest.fixture
def database(tmp_path: Path) -> Iterator[SubmapDatabase]:
    with open_database(stored(tmp_path / "building.submaps", *SESSIONS.values())) as opened:
        yield opened


def apart(a: SE2, b: SE2) -> tuple[float, float]:
    off = a.inverse() @ b
    return math.hypot(off.x, off.y), abs(off.yaw)


def test_sessions_of_one_building_get_its_frame_and_others_none(database: SubmapDatabase) -> None:
    found = join_sessions(database)
    assert [(pair.names, pair.accepted) for pair in found.pairs] == [
        (("west", "elsewhere"), False),
        (("west", "east"), True),
        (("elsewhere", "east"), False),
    ]
    assert found.frames.keys() == {"west", "east"}
    assert found.frames["west"] == BuildingFrame(name="west", T_building_session=SE2(), covariance=NONE)  # type: ignore[arg-type]
    east = found.frames["east"]
    distance_m, turn_rad = apart(T_OFFICE_EAST, east.T_building_session)
    # As two maps are joined, see test_join.
    assert east.name == "west" and distance_m < 0.05 and turn_rad < 0.0072
    assert np.linalg.eigvalsh(np.array(east.covariance)).min() > 0.0
    # All is in the map of the building, and what was not joined is alone.
    whole, alone = map_of(database, "west", found.frames), map_of(database, "elsewhere", found.frames)
    assert np.array_equal(alone.cells, MAPS["elsewhere"].cells)
    # The whole office: 20 x 14 m, of which walls take some 18 m2.
    office_m2 = sum(MAPS[name].free_m2 for name in ("west", "east")) - part((6.0, 0.0, 13.0, 14.0)).free_m2
    assert whole.free_m2 == pytest.approx(office_m2, rel=0.03)
    # A room of the east, where only that session was, and the corridor, in the frame of the west.
    assert whole.is_free(19.0, 7.0) and whole.is_free(1.0, 7.0) and not whole.is_free(14.5, 10.0)


def test_the_frame_of_a_building_is_that_of_the_named_session(database: SubmapDatabase) -> None:
    frames = join_sessions(database, frame="east").frames
    assert {frame.name for frame in frames.values()} == {"east"}
    assert frames["east"].T_building_session == SE2()
    distance_m, turn_rad = apart(T_OFFICE_EAST.inverse(), frames["west"].T_building_session)
    # A lever of 9 m from where they meet to the origin: 0.0072 rad of it, and a cell.
    assert distance_m < 0.05 + 9.0 * 0.0072 and turn_rad < 0.0072
    with pytest.raises(DatabaseError, match="no session 'north'"):
        join_sessions(database, frame="north")


def drawn_bent(grid: OccupancyGrid) -> OccupancyGrid:
    """The map as a robot draws it whose heading drifts by 0.003 rad for each metre to the east."""
    height, width = grid.cells.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    off_m = 0.5 * 0.003 * (x * grid.resolution_m + grid.origin_m[0]) ** 2
    rows = np.floor(y - off_m / grid.resolution_m).astype(int)
    cells = grid.cells[rows.clip(0, height - 1), x.astype(int)]
    return replace(grid, cells=np.where((rows >= 0) & (rows < height), cells, UNKNOWN).astype(np.int8))


def test_a_session_that_drifts_is_straightened_by_one_that_does_not(tmp_path: Path) -> None:
    along = np.arange(1.0, 19.0, 0.2)
    poses = np.array([SE2(x, 7.0 + 0.0015 * x * x, 0.003 * x).lift() for x in along.tolist()])
    drive = Trajectory(stamps_ns=np.arange(len(along)), T_session_base=poses)
    # A local map each 4 m, as exact as tracking is.
    exact = Precision(stamps_ns=tuple(range(0, len(along), 20)), sigma_m=(0.1,) * 5)
    bent = replace(session("bent", drawn_bent(office()), drive), precision=exact)
    maps = (session("plan", office(), way()), bent)
    with open_database(stored(tmp_path / "x.submaps", *maps)) as opened:
        frames = join_sessions(opened).frames
        whole = map_of(opened, "plan", frames)
    rigid = frames["bent"].T_building_session
    true_m = np.column_stack((along, np.full(len(along), 7.0)))
    straight_m = frames["bent"].apply(poses[:, :2, 3])
    drawn, straight = (np.hypot(*(at - true_m).T).mean() for at in (rigid.apply(poses[:, :2, 3]), straight_m))
    # The plan is two pieces of 12 m wide, each of them bent by 5 cm itself: what lies beyond their middles is
    # straightened no further.
    assert straight < 0.5 * drawn
    assert frames["plan"].bend == () and len(frames["bent"].bend) == 5
    # One map of both has no wall twice.
    assert whole.occupied.sum() < 1.1 * office().occupied.sum()


def test_floors_stay_apart(tmp_path: Path) -> None:
    """The ground floor, and the same plan on the first: nothing but labels tells them apart."""
    labels = {"west": Label(building="A", floor="0"), "east": Label(building="A", floor="1")}
    path = stored(tmp_path / "x.submaps", *(SESSIONS[name] for name in labels), **labels)
    with open_database(path) as opened:
        found = join_sessions(opened)
    assert found.pairs == () and not found.frames


def test_what_is_added_joins_and_the_others_stay(tmp_path: Path) -> None:
    path = stored(tmp_path / "x.submaps", *SESSIONS.values())
    # The building's frame is some other one, whose session has been removed.
    T_building_west = SE2(100.0, -50.0, 2.0)
    west = BuildingFrame(name="gone", T_building_session=T_building_west, covariance=NONE)  # type: ignore[arg-type]
    maintenance.store_frames(path, {"west": west})
    with open_database(path) as opened:
        frames = join_sessions(opened, only=["east"]).frames
    assert frames.keys() == {"west", "east"} and frames["west"] == west and frames["east"].name == "gone"
    distance_m, _ = apart(T_building_west @ T_OFFICE_EAST, frames["east"].T_building_session)
    assert distance_m < 0.05


# --- One map of several: what the newest session that is sure of a cell says ---


_ = UNKNOWN


def grid(rows: list[list[int]]) -> OccupancyGrid:
    """Rows from the top down, cells of 1 m, the lower left corner at (0, 0)."""
    return OccupancyGrid(cells=np.array(rows[::-1], np.int8), resolution_m=1.0, origin_m=(0.0, 0.0))


def at(x: float = 0.0, y: float = 0.0, yaw: float = 0.0, bend: Deformation = ()) -> BuildingFrame:
    exact = ((0.0, 0.0, 0.0),) * 3
    return BuildingFrame(name="old", T_building_session=SE2(x, y, yaw), covariance=exact, bend=bend)


OLD = grid([[OCCUPIED, OCCUPIED, OCCUPIED], [FREE, FREE, OCCUPIED]])
NEW = grid([[_, FREE, _], [_, OCCUPIED, _]])


def test_the_newest_that_knows_a_cell_decides() -> None:
    whole = building_map([(OLD, at()), (NEW, at())])
    assert whole.cells[::-1].tolist() == [[OCCUPIED, FREE, OCCUPIED], [FREE, OCCUPIED, OCCUPIED]]


def test_maps_are_moved_and_turned_into_one_frame() -> None:
    """The new one, a quarter turn counterclockwise, stands left of the old one."""
    whole = building_map([(OLD, at()), (NEW, at(0.0, 0.0, math.pi / 2))])
    assert whole.origin_m == (-2.0, 0.0)
    assert whole.cells[::-1].tolist() == [
        [_, _, _, _, _],
        [FREE, OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED],
        [_, _, FREE, FREE, OCCUPIED],
    ]


def test_a_bent_map_is_straight_in_the_building() -> None:
    """A wall of 30 m, drawn with a step for every 10 m: it leaves its line by 2 cells."""
    cells = np.zeros((9, 300), np.int8)
    for begin, row in ((0, 4), (100, 5), (200, 6)):
        cells[row, begin : begin + 100] = OCCUPIED
    drawn = OccupancyGrid(cells=cells, resolution_m=0.1, origin_m=(0.0, 0.0))
    places = tuple((x, 0.45, 0.0, -0.1 * int(x / 10.0), 0.0) for x in np.arange(0.5, 30.0).tolist())
    whole = building_map([(drawn, at(5.0, bend=places))])
    rows, columns = np.nonzero(whole.occupied)
    x, y = whole.to_point(np.column_stack((rows, columns))).T
    # Where the bend changes, cells round to one beside the line.
    assert np.abs(y - 0.45).max() < 0.1 + 1e-6 and (np.histogram(x, np.arange(5.0, 35.1))[0] >= 10).all()
    # Nothing of the map was cut off that the bend moves beyond its edges.
    assert whole.free_m2 == pytest.approx(drawn.free_m2, rel=0.02)


# --- Poses in the maps of joined sessions, as they are in the frame of their building ---


FRAME = BuildingFrame(
    name="ground floor",
    T_building_session=SE2(30.0, -10.0, math.pi / 2),
    covariance=((4e-4, 1e-4, 0.0), (1e-4, 9e-4, 0.0), (0.0, 0.0, 1e-6)),
)


@functools.cache
def located() -> Answer:
    """A part of the office, found in it."""
    return locate_map(office_part((9.0, 7.0)), building({"monday": office()}))


def test_an_answer_is_moved_with_all_its_poses() -> None:
    answer = located()
    assert answer.status == "located" and answer.T_map_base is not None and answer.frame is None
    moved = answer_in_building(answer, {"monday": FRAME})
    # A quarter turn: (9, 7) becomes (-7, 9), and then the shift.
    assert moved.T_map_base is not None and moved.frame == "ground floor"
    assert (moved.T_map_base.x, moved.T_map_base.y) == pytest.approx((23.0, -1.0), abs=0.1)
    assert moved.T_map_base.yaw == pytest.approx(math.pi / 2, abs=0.02)
    assert moved.T_map_odom == moved.T_map_base == moved.hypotheses[0].T_map_query
    assert moved.history[-1].pose == moved.T_map_base
    document = moved.to_json()
    assert document["frame"] == document["hypotheses"][0]["frame"] == "ground floor"
    assert document["pose"] is not None and document["pose"]["x"] == moved.T_map_base.x


def test_an_answer_in_a_bent_map_moves_as_its_place_does() -> None:
    """East of x = 4 m the map lies 0.3 m too far north; in the west it is right."""
    bend = tuple((x, y, 0.0, -0.3 * (x > 4.0), 0.0) for x in (0.0, 8.0) for y in (2.0, 7.0, 12.0))
    answer = located()
    straight, bent = (
        answer_in_building(answer, {"monday": replace(FRAME, bend=rows)}) for rows in ((), bend)
    )
    assert straight.T_map_base is not None and bent.T_map_base is not None
    # South in the map is east in the building, which is turned by a quarter.
    assert bent.T_map_base.x - straight.T_map_base.x == pytest.approx(0.3, abs=0.02)
    assert bent.T_map_base.y == pytest.approx(straight.T_map_base.y, abs=0.02)
    assert bent.T_map_odom == bent.T_map_base == bent.hypotheses[0].T_map_query
    assert bent.history[-1].pose == bent.T_map_base


def test_an_answer_in_a_session_that_was_not_joined_stays() -> None:
    answer = located()
    moved = answer_in_building(answer, {"tuesday": FRAME})
    assert moved.T_map_base == answer.T_map_base and moved.covariance == pytest.approx(answer.covariance)
    assert moved.to_json()["frame"] is moved.to_json()["hypotheses"][0]["frame"] is None


def test_the_covariance_holds_how_exactly_the_session_lies_in_its_building() -> None:
    """Against 20,000 draws of both, which give a standard deviation to half a percent."""
    rng = np.random.default_rng(0)
    own, pose = np.diag([1e-2, 1e-4, 1e-4]), SE2(20.0, 5.0, 0.3)
    T = FRAME.T_building_session
    frames = rng.multivariate_normal((T.x, T.y, T.yaw), FRAME.covariance, 20_000)
    poses = rng.multivariate_normal((pose.x, pose.y, pose.yaw), own, 20_000)
    there = [SE2(*frame) @ SE2(*at) for frame, at in zip(frames.tolist(), poses.tolist(), strict=True)]
    expected = np.cov(np.array([(at.x, at.y, at.yaw) for at in there]).T)
    found = covariance_in_building(own, pose, FRAME)
    sigmas = np.sqrt(np.diag(expected))
    assert found / np.outer(sigmas, sigmas) == pytest.approx(expected / np.outer(sigmas, sigmas), abs=0.03)
