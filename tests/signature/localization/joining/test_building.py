"""The sessions of a database become buildings with one frame each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import DatabaseError
from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, OccupancyGrid, Precision, Trajectory
from signature.config import Config
from signature.database import Label, SubmapDatabase, maintenance, open_database
from signature.database.protocol import BuildingFrame
from signature.localization.joining.building import join_sessions, map_of
from signature.sessions import add_sessions, provenance
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, part
from tests.helpers.session_maps import session, way
from tests.helpers.simulated_drives import office, plan

OTHER = plan(16, 12, [(4, 0, 4, 7), (9, 5, 9, 12), (9, 5, 13, 5), (6, 9, 6, 12), (13, 2, 16, 2)])
NONE: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3


def store(path: Path, maps: dict[str, OccupancyGrid], labels: dict[str, Label] | None = None) -> None:
    config = Config()
    sessions = [
        (
            session(name, grid, way()),
            provenance(Path(f"{name}.mcap"), name, config, label=(labels or {}).get(name, Label())),
        )
        for name, grid in maps.items()
    ]
    add_sessions(path, sessions, config)


MAPS = {"west": part(WEST), "elsewhere": OTHER, "east": in_frame(part(EAST), T_OFFICE_EAST)}


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("joining") / "building.submaps"
    store(path, MAPS)
    return path


@pytest.fixture
def database(stored: Path) -> Iterator[SubmapDatabase]:
    with open_database(stored) as opened:
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
    path = tmp_path / "x.submaps"
    add_sessions(
        path, [(one, provenance(Path(one.session), one.session, Config())) for one in maps], Config()
    )
    with open_database(path) as opened:
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
    labels = {
        "west": Label(building="A", floor="0"),
        "east": Label(building="A", floor="1"),
    }
    store(tmp_path / "x.submaps", {name: MAPS[name] for name in labels}, labels)
    with open_database(tmp_path / "x.submaps") as opened:
        found = join_sessions(opened)
    assert found.pairs == () and not found.frames


def test_what_is_added_joins_and_the_others_stay(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, MAPS)
    # The building's frame is some other one, whose session has been removed.
    T_building_west = SE2(100.0, -50.0, 2.0)
    west = BuildingFrame(name="gone", T_building_session=T_building_west, covariance=NONE)  # type: ignore[arg-type]
    maintenance.place(path, {"west": west})
    with open_database(path) as opened:
        frames = join_sessions(opened, only=["east"]).frames
    assert frames.keys() == {"west", "east"} and frames["west"] == west and frames["east"].name == "gone"
    distance_m, _ = apart(T_building_west @ T_OFFICE_EAST, frames["east"].T_building_session)
    assert distance_m < 0.05


def test_the_map_of_a_building_holds_all_its_sessions(stored: Path) -> None:
    with open_database(stored) as opened:
        frames = join_sessions(opened).frames
        whole, alone = map_of(opened, "west", frames), map_of(opened, "elsewhere", frames)
        assert np.array_equal(alone.cells, opened.grid("elsewhere").cells)
    # The whole office: 20 x 14 m, of which walls take some 18 m2.
    office_m2 = sum(MAPS[name].free_m2 for name in ("west", "east")) - part((6.0, 0.0, 13.0, 14.0)).free_m2
    assert whole.free_m2 == pytest.approx(office_m2, rel=0.03)
    # A room of the east, where only that session was, and the corridor, in the frame of the west.
    assert whole.is_free(19.0, 7.0) and whole.is_free(1.0, 7.0) and not whole.is_free(14.5, 10.0)
