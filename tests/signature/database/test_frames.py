"""Where sessions lie in their buildings, on every engine: all or nothing, and kept with the sessions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from pc2grid.geometry import SE2
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame
from signature.database.sqlite.database import SqliteRows
from tests.helpers import postgresql
from tests.helpers.databases import Content, assert_holds, craft, make_entry, sql

MONDAY, TUESDAY = make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)
HERE = BuildingFrame(name="monday", T_building_session=SE2(), covariance=((0.0,) * 3,) * 3)  # type: ignore[arg-type]
THERE = BuildingFrame(
    name="monday",
    T_building_session=SE2(1 / 3, -2.5, 3.0),
    covariance=((4e-4, 1e-5, 2e-6), (1e-5, 9e-4, -3e-6), (2e-6, -3e-6, 1 / 7e5)),
    bend=((1 / 3, -7.0, 0.02, -0.03, 1 / 300), (4.5, -7.0, 0.0, 0.0, 0.0)),
)
FRAMES = {"monday": HERE, "tuesday": THERE}


@pytest.fixture(params=["sqlite", "postgres"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """A database of two sessions that are joined, on each engine."""
    target = tmp_path / "x.submaps" if request.param == "sqlite" else postgresql.new_database()
    maintenance.store(target, [MONDAY, TUESDAY], keep=False)
    maintenance.place(target, FRAMES)
    return target


def frames(place: str | Path) -> dict[str, BuildingFrame]:
    with open_database(place) as database:
        return database.frames()


def test_what_is_stored_is_read_again_and_all_else_is_as_it_was(place: str | Path) -> None:
    assert frames(place) == FRAMES and maintenance.check(place) == ()
    with open_database(place) as database:
        assert database.frame("tuesday") == THERE
        assert_holds(database, MONDAY)
        assert_holds(database, TUESDAY)


def test_a_session_that_was_never_joined_is_stored_as_before(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    maintenance.store(path, [MONDAY], keep=False)
    before = sql(path, "SELECT document, crc32 FROM session")
    maintenance.place(path, {"monday": HERE})
    assert sql(path, "SELECT document, crc32 FROM session") != before
    maintenance.place(path, {"monday": None})
    assert sql(path, "SELECT document, crc32 FROM session") == before and frames(path) == {}


def test_the_same_session_again_changes_nothing_and_another_one_has_no_frame(place: str | Path) -> None:
    maintenance.store(place, [TUESDAY], keep=True)
    assert frames(place) == FRAMES
    maintenance.store(place, [make_entry("tuesday", 7)], keep=True, force=True)
    assert frames(place) == {"monday": HERE}


def test_frames_go_with_their_sessions(place: str | Path, tmp_path: Path) -> None:
    maintenance.rename(place, "monday", "first")
    assert frames(place) == {"first": HERE, "tuesday": THERE}
    maintenance.remove(place, ["first"])
    maintenance.split(place, ["tuesday"], tmp_path / "split.submaps")
    maintenance.copy(tmp_path / "split.submaps", tmp_path / "copy.submaps")
    maintenance.merge([tmp_path / "copy.submaps"], tmp_path / "merged.submaps")
    assert frames(tmp_path / "merged.submaps") == {"tuesday": THERE}


def test_a_name_that_is_not_there_changes_nothing(place: str | Path) -> None:
    with pytest.raises(DatabaseError, match="no session 'friday'"):
        maintenance.place(place, {"monday": THERE, "friday": HERE})
    assert frames(place) == FRAMES


def test_a_writer_that_fails_leaves_what_was_there(
    place: str | Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not isinstance(place, Path):
        pytest.skip("a server rolls back by itself")
    before, execute = place.read_bytes(), SqliteRows.execute

    def fails_second(rows: SqliteRows, statement: str, *values: Any) -> None:
        execute(rows, statement, *values)
        if "tuesday" in values:
            raise OSError("no space left")

    monkeypatch.setattr(SqliteRows, "execute", fails_second)
    with pytest.raises(OutputError, match="no space"):
        maintenance.place(place, {"monday": None, "tuesday": None})
    assert place.read_bytes() == before


@pytest.mark.parametrize("covariance", [[[1, 0, 0], [0, 1, 0]], [[1, 2, 0], [2, 1, 0], [0, 0, 1]], "none"])
def test_damage_is_found_and_can_be_left_out(covariance: Any, tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    maintenance.store(path, [MONDAY, TUESDAY], keep=False)
    maintenance.place(path, FRAMES)

    def change(content: Content) -> None:
        content.document["frame"]["covariance"] = covariance

    craft(path, change, session_id=2)
    (problem,) = maintenance.check(path)
    assert problem.where == "frame of session 'tuesday'"
    with open_database(path) as database, pytest.raises(DatabaseCorrupt):
        database.frames()
    maintenance.copy(path, tmp_path / "copy.submaps", recover=True)
    assert frames(tmp_path / "copy.submaps") == {"monday": HERE}
