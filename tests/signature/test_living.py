"""A living map is searched in the place of the sessions that it was made from, and all can be undone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import DatabaseError
from pc2grid.geometry import SE2
from pc2grid.model import FREE_BELOW, OCCUPIED_FROM, OccupancyGrid, PointMap
from signature import living
from signature.config import Config
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame, SessionRole
from signature.localization.joining.building import join_sessions
from signature.localization.joining.building_map import floors_of, map_of
from signature.localization.map_index import MapIndex
from signature.sessions import add_sessions, provenance
from tests.helpers import postgresql
from tests.helpers.joined_maps import EAST, T_OFFICE_EAST, WEST, in_frame, part
from tests.helpers.session_maps import LOOPS, session, way

EXACT = ((0.0, 0.0, 0.0),) * 3
T_WEST = {"west": SE2(), "east": T_OFFICE_EAST}
"""Where the sessions lie in the frame of the building, that of the west."""


def frame(T: SE2) -> BuildingFrame:
    return BuildingFrame(name="west", T_building_session=T, covariance=EXACT)


def store(target: str | Path, maps: dict[str, OccupancyGrid], frames: dict[str, BuildingFrame]) -> None:
    config = Config()
    sessions = [
        (session(name, grid, way(), LOOPS), provenance(Path(f"{name}.mcap"), name, config))
        for name, grid in maps.items()
    ]
    add_sessions(target, sessions, config, keep=False)
    maintenance.place(target, frames)


MAPS = {"west": part(WEST), "east": in_frame(part(EAST), T_OFFICE_EAST)}
FRAMES = {name: frame(T) for name, T in T_WEST.items()}


@pytest.fixture(params=["sqlite", "postgres"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """The two halves of an office, joined, on each engine."""
    target = tmp_path / "x.submaps" if request.param == "sqlite" else postgresql.new_database()
    store(target, MAPS, FRAMES)
    return target


def names(place: str | Path) -> dict[str, SessionRole | None]:
    with open_database(place) as database:
        return {name: at.role for name, at in database.frames().items()}


def test_the_living_map_alone_is_searched_and_is_the_map_of_the_building(place: str | Path) -> None:
    (made,) = living.update(place)
    assert made.name == "west.living" and made.frame == "west" and made.members == ("west", "east")
    assert maintenance.check(place) == ()
    with open_database(place) as database:
        frames = database.frames()
        whole = database.grid("west.living")
        assert frames["west.living"].T_building_session == SE2()
        assert floors_of(database, frames) == (("west.living", "west", "east"),)
        # A room that only the west knows, and one that only the east knows.
        assert whole.is_free(1.0, 7.0) and whole.is_free(19.0, 7.0)
        index = MapIndex.of(database, Config())
        assert index.sessions == ("west.living",)
        assert set(index.places.table.session_index.tolist()) == {0}
        assert len(index.places.table) == made.submaps > 0
        # For the search alone: the maps of all sessions are there as before.
    with open_database(place) as database:
        for name, grid in MAPS.items():
            assert np.array_equal(database.grid(name).cells, grid.cells)


def test_a_session_that_retires_keeps_its_map_and_a_pose_a_metre(place: str | Path) -> None:
    living.update(place)
    with open_database(place) as database:
        info = next(info for info in database.sessions() if info.name == "west")
        # 39 steps of 0.2 m: the poses at 0, 1, .. 7 m.
        assert database.trajectory("west").planar()[:, 0].tolist() == pytest.approx(
            [1.0 + k for k in range(8)]
        )
        assert info.scans == 8 and info.submaps == 0 and info.path_m == pytest.approx(7.8)
        assert database.loops("west") == () and len(database.graph("west")) == 0
        assert info.provenance.source == "west.mcap"


def test_undoing_makes_the_sessions_whole_and_leaves_no_living_map(place: str | Path) -> None:
    def searched() -> dict[str, list[np.ndarray]]:
        with open_database(place) as database:
            table = database.signatures()
            return {
                name: [
                    database.grid(name).cells,
                    database.seen_places(name).signatures,
                    np.array([at for _, at in database.graph(name).nodes(data="center_m")]),
                    table.boundary,
                    table.freespace,
                    table.symmetry,
                    table.center_m,
                ]
                for name in MAPS
            }

    before = searched()
    living.update(place)
    assert living.undo(place) == ("west", "east")
    assert names(place) == dict.fromkeys(MAPS, None)
    for name, arrays in searched().items():
        assert all(np.array_equal(a, b) for a, b in zip(arrays, before[name], strict=True))
    assert maintenance.check(place) == () and living.undo(place) == ()


def test_what_is_new_joins_the_living_map_and_the_next_one_is_made_of_all(place: str | Path) -> None:
    """The middle of the office, seen once more, with a piece of wall in its corridor."""
    living.update(place)
    middle = part((3.0, 0.0, 17.0, 14.0))
    cells = middle.cells.copy()
    row, column = middle.to_cell(np.array([[8.0, 7.0]]))[0]
    cells[row - 4 : row + 4, column : column + 10] = 100
    middle = OccupancyGrid(cells=cells, resolution_m=middle.resolution_m, origin_m=middle.origin_m)
    T_office_new = SE2(2.0, 3.0, -0.4)
    config = Config()
    new = session("new", in_frame(middle, T_office_new), way())
    add_sessions(place, [(new, provenance(Path("new.mcap"), "new", config))], config)
    with open_database(place) as database:
        found = join_sessions(database, only=["new"])
    # One comparison, however many sessions have retired.
    assert [pair.names for pair in found.pairs] == [("west.living", "new")] and found.pairs[0].accepted
    at = found.frames["new"].T_building_session
    # As two maps are joined, see test_join.
    assert np.hypot(at.x - T_office_new.x, at.y - T_office_new.y) < 0.05
    maintenance.place(place, found.frames)
    (made,) = living.update(place)
    assert made.members == ("west", "east", "new")
    assert names(place)["west.living"] is SessionRole.LIVING and names(place)["new"] is SessionRole.RETIRED
    with open_database(place) as database:
        whole = database.grid("west.living")
        # The search knows nothing of where it is; the map that is exported shows it, and the old one did not.
        wall = tuple(whole.to_cell(np.array([[8.25, 7.0]]))[0])
        assert FREE_BELOW <= whole.cells[wall] < OCCUPIED_FROM
        assert not map_of(database, "west", database.frames()).is_free(8.25, 7.0)
        assert database.grid("west").is_free(8.25, 7.0)
        assert join_sessions(database).frames == database.frames()
        with pytest.raises(DatabaseError, match="has living maps") as refused:
            join_sessions(database, frame="east")
        assert "db update --undo" in str(refused.value.hint)


def test_without_its_living_map_a_session_that_retired_is_no_longer_passed_over(place: str | Path) -> None:
    living.update(place)
    maintenance.remove(place, ["west.living"])
    with open_database(place) as database:
        database.keep_searched()
        assert [info.name for info in database.sessions()] == ["west", "east"]
        assert floors_of(database, database.frames()) == (("west", "east"),)


def test_there_is_one_living_map_and_no_other_session_is_replaced(tmp_path: Path) -> None:
    """The living map was renamed; then a recording got the name that the next one would have."""
    path = tmp_path / "x.submaps"
    store(path, MAPS, FRAMES)
    living.update(path)
    maintenance.rename(path, "west.living", "mine")
    living.update(path)
    assert [name for name, role in names(path).items() if role is SessionRole.LIVING] == ["west.living"]
    living.undo(path)
    maintenance.rename(path, "east", "west.living")
    before = path.read_bytes()
    with pytest.raises(DatabaseError, match="that is no living map") as refused:
        living.update(path)
    assert "db rename" in str(refused.value.hint) and path.read_bytes() == before


def test_nothing_joined_is_an_error_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, MAPS, {})
    before = path.read_bytes()
    with pytest.raises(DatabaseError, match="no two joined sessions") as refused:
        living.update(path)
    assert "db join" in str(refused.value.hint) and path.read_bytes() == before


def test_sessions_that_observe_different_planes_have_living_maps_of_their_own(tmp_path: Path) -> None:
    """A table is an obstacle at 0.7 m and free ground at 0.1 m: the lower laser must not erase it."""
    planes = {"a": 0.1, "b": 0.2, "c": 0.7, "d": 0.8, "e": None}
    west = part(WEST)
    maps = {
        name: OccupancyGrid(
            cells=west.cells, resolution_m=west.resolution_m, origin_m=west.origin_m, height_m=height_m
        )
        for name, height_m in planes.items()
    }
    store(tmp_path / "x.submaps", maps, {name: frame(SE2()) for name in maps})
    made = living.update(tmp_path / "x.submaps")
    assert [one.members for one in made] == [("a", "b"), ("c", "d")]
    with open_database(tmp_path / "x.submaps") as database:
        assert MapIndex.of(database, Config()).sessions == ("e", *(one.name for one in made))


def test_points_are_those_of_the_newest_session_that_knows_the_ground(tmp_path: Path) -> None:
    """A pillar at 3 m in the old map, gone in the new one, which has a point at 4 m; the old one, too,
    has one at 12 m, where the new map knows nothing."""
    path = tmp_path / "x.submaps"
    maps = {"old": part(WEST), "new": part((0.0, 0.0, 8.0, 14.0))}
    store(path, maps, {name: frame(SE2()) for name in maps})
    points = {"old": [[3.0, 7.0, 1.0], [12.0, 7.0, 1.0]], "new": [[4.0, 7.0, 1.0]]}
    with open_database(path) as database:
        stored = [database.stored(name) for name in maps]
    maintenance.replace_sessions(
        path,
        [replace(s, points=PointMap.of(np.array(points[s.info.name]), 0.1)) for s in stored],
    )

    def living_points() -> list[list[float]]:
        living.update(path)
        with open_database(path) as database:
            found = database.points("west.living")
        assert found is not None
        return np.sort(found.points_m().round(1)[:, 0]).tolist()

    # The second time from the first living map: its sessions have retired, and have none.
    assert living_points() == living_points() == [4.0, 12.0]
