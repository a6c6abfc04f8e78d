"""Sessions renamed, removed and split off, on every engine; all or nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pc2grid.errors import DatabaseError, NotADatabase, OutputError
from signature.database import maintenance, open_database
from tests.helpers.databases import MONDAY, TUESDAY, assert_holds, everything, make_entry


def names(place: str | Path) -> list[str]:
    with open_database(place) as database:
        return [info.name for info in database.sessions()]


def test_a_renamed_session_is_the_same_in_all_else(place: str | Path) -> None:
    maintenance.rename(place, "monday", "first floor")
    assert names(place) == ["first floor", "tuesday"]
    assert maintenance.check(place) == ()
    with open_database(place) as database:
        assert_holds(database, (replace(MONDAY[0], session="first floor"), *MONDAY[1:]))
        assert_holds(database, TUESDAY)
    maintenance.rename(place, "first floor", "monday")
    maintenance.rename(place, "monday", "monday")
    with open_database(place) as database:
        assert_holds(database, MONDAY)


def test_a_removed_session_is_gone_and_its_name_is_free(place: str | Path) -> None:
    small = place.stat().st_size if isinstance(place, Path) else 0
    maintenance.store(place, [make_entry("large", 3, submaps=100)], keep=True)
    maintenance.remove(place, ["large", "tuesday", "large"])
    assert names(place) == ["monday"]
    assert maintenance.check(place) == ()
    if isinstance(place, Path):
        assert place.stat().st_size <= small
    other = make_entry("tuesday", 7)
    maintenance.store(place, [other], keep=True)
    with open_database(place) as database:
        assert_holds(database, MONDAY)
        assert_holds(database, other)
    maintenance.remove(place, ["monday", "tuesday"])
    assert names(place) == []


def test_a_session_split_off_is_as_it_was(place: str | Path, tmp_path: Path) -> None:
    before, alone = everything(place), tmp_path / "tuesday.submaps"
    assert maintenance.split(place, ["tuesday"], alone) == 1
    assert names(alone) == ["tuesday"]
    with open_database(alone) as database:
        assert_holds(database, TUESDAY)
    assert everything(place) == before
    with pytest.raises(OutputError, match="exists already"):
        maintenance.split(place, ["monday"], alone)
    assert maintenance.split(place, ["monday", "tuesday"], alone, overwrite=True) == 2
    assert everything(alone) == before


def test_what_is_refused_changes_nothing(place: str | Path, tmp_path: Path) -> None:
    before = everything(place)
    with pytest.raises(DatabaseError, match="holds a session 'tuesday' already"):
        maintenance.rename(place, "monday", "tuesday")
    with pytest.raises(DatabaseError, match="the name of a session is empty"):
        maintenance.rename(place, "monday", " ")
    with pytest.raises(DatabaseError, match="named twice"):
        maintenance.split(place, ["monday"], place, overwrite=True)
    for act in (
        lambda: maintenance.rename(place, "friday", "sunday"),
        lambda: maintenance.remove(place, ["monday", "friday"]),
        lambda: maintenance.split(place, ["monday", "friday"], tmp_path / "no.submaps"),
    ):
        with pytest.raises(DatabaseError, match="no session 'friday'") as caught:
            act()
        assert caught.value.hint == "there are: 'monday', 'tuesday'"
    assert everything(place) == before
    assert not (tmp_path / "no.submaps").exists()


def test_what_is_no_database_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "x.submaps").write_text("text")
    for path in (tmp_path / "x.submaps", tmp_path / "none.submaps"):
        with pytest.raises(NotADatabase):
            maintenance.remove(path, ["monday"])
        with pytest.raises(NotADatabase):
            maintenance.rename(path, "monday", "friday")
    assert [file.name for file in tmp_path.iterdir()] == ["x.submaps"]


def test_a_recording_that_is_replaced_takes_its_other_parts_along(place: str | Path) -> None:
    """Only those that were made from the same recording; a session that merely has such a name stays."""
    parts = [(replace(MONDAY[0], session=f"monday#{k}"), *MONDAY[1:]) for k in (2, 3)]
    unrelated = (replace(TUESDAY[0], session="monday#4"), *TUESDAY[1:])
    maintenance.store(place, [*parts, unrelated], keep=True)
    assert names(place) == ["monday", "tuesday", "monday#2", "monday#3", "monday#4"]
    maintenance.store(place, [make_entry("monday", 5), parts[0]], keep=True, overwrite=True)
    assert sorted(names(place)) == ["monday", "monday#2", "monday#4", "tuesday"]
    assert maintenance.check(place) == ()
