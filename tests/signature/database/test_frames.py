"""Where sessions lie in their buildings, on every engine: all or nothing, and kept with the sessions."""

from __future__ import annotations

from pathlib import Path

import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseError
from pc2grid.geometry import SE2
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame
from tests.helpers.databases import MONDAY, TUESDAY, assert_holds, make_entry, sql

HERE = BuildingFrame(name="monday", T_building_session=SE2(), covariance=((0.0,) * 3,) * 3)  # type: ignore[arg-type]
THERE = BuildingFrame(
    name="monday",
    T_building_session=SE2(1 / 3, -2.5, 3.0),
    covariance=((4e-4, 1e-5, 2e-6), (1e-5, 9e-4, -3e-6), (2e-6, -3e-6, 1 / 7e5)),
    bend=((1 / 3, -7.0, 0.02, -0.03, 1 / 300), (4.5, -7.0, 0.0, 0.0, 0.0)),
)
FRAMES = {"monday": HERE, "tuesday": THERE}


@pytest.fixture
def joined(place: str | Path) -> str | Path:
    """A database of two sessions that are joined, on each engine."""
    maintenance.place(place, FRAMES)
    return place


def frames(place: str | Path) -> dict[str, BuildingFrame]:
    with open_database(place) as database:
        return database.frames()


def test_what_is_stored_is_read_again_and_all_else_is_as_it_was(joined: str | Path) -> None:
    assert frames(joined) == FRAMES and maintenance.check(joined) == ()
    with open_database(joined) as database:
        assert database.frame("tuesday") == THERE
        assert_holds(database, MONDAY)
        assert_holds(database, TUESDAY)


def test_a_session_that_is_taken_apart_again_is_stored_as_before(path: Path) -> None:
    rows = "SELECT * FROM part ORDER BY session_id, name"
    before = sql(path, rows)
    maintenance.place(path, {"monday": HERE})
    assert frames(path) == {"monday": HERE}
    maintenance.place(path, {"monday": None})
    assert sql(path, rows) == before


def test_the_same_session_again_changes_nothing_and_another_one_has_no_frame(joined: str | Path) -> None:
    maintenance.store(joined, [TUESDAY], keep=True)
    assert frames(joined) == FRAMES
    maintenance.store(joined, [make_entry("tuesday", 7)], keep=True, overwrite=True)
    assert frames(joined) == {"monday": HERE}


def test_frames_go_with_their_sessions(joined: str | Path, tmp_path: Path) -> None:
    maintenance.rename(joined, "monday", "first")
    assert frames(joined) == {"first": HERE, "tuesday": THERE}
    maintenance.remove(joined, ["first"])
    maintenance.split(joined, ["tuesday"], tmp_path / "split.submaps")
    maintenance.copy(tmp_path / "split.submaps", tmp_path / "copy.submaps")
    maintenance.merge([tmp_path / "copy.submaps"], tmp_path / "merged.submaps")
    assert frames(tmp_path / "merged.submaps") == {"tuesday": THERE}


def test_a_name_that_is_not_there_changes_nothing(joined: str | Path) -> None:
    with pytest.raises(DatabaseError, match="no session 'friday'"):
        maintenance.place(joined, {"monday": THERE, "friday": HERE})
    assert frames(joined) == FRAMES


def test_damage_is_found_and_can_be_left_out(joined: str | Path, tmp_path: Path) -> None:
    sql(joined, "UPDATE part SET crc32 = crc32 + 1 WHERE session_id = 2 AND name = 'frame'")
    (problem,) = maintenance.check(joined)
    assert problem.where == "frame of session 'tuesday'"
    with open_database(joined) as database, pytest.raises(DatabaseCorrupt):
        database.frames()
    maintenance.copy(joined, tmp_path / "copy.submaps", recover=True)
    assert frames(tmp_path / "copy.submaps") == {"monday": HERE}
