"""Sessions renamed, removed and split off, on every engine; all or nothing."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pc2grid.errors import DatabaseError, NotADatabase, OutputError
from pc2grid.geometry import SE2
from pc2grid.io.maps import save_map
from pc2grid_cli.main import app
from pc2grid_cli.relocalize import as_text
from signature.config import Config
from signature.database import Label, maintenance, open_database
from signature.database.protocol import BuildingFrame
from signature.localization.localizer import locate_map
from signature.places.map_index import MapIndex
from tests.helpers.databases import MONDAY, TUESDAY, assert_holds, everything, make_entry, sql
from tests.helpers.simulated_drives import plan


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
    before, none = everything(place), tmp_path / "no.submaps"
    for act, words in (
        (lambda: maintenance.rename(place, "monday", "tuesday"), "holds a session 'tuesday' already"),
        (lambda: maintenance.rename(place, "monday", " "), "the name of a session is empty"),
        (lambda: maintenance.split(place, ["monday"], place, overwrite=True), "named twice"),
        (lambda: maintenance.rename(place, "friday", "sunday"), "no session 'friday'"),
        (lambda: maintenance.remove(place, ["monday", "friday"]), "no session 'friday'"),
        (lambda: maintenance.split(place, ["monday", "friday"], none), "no session 'friday'"),
        (lambda: maintenance.store_frames(place, {"monday": THERE, "friday": HERE}), "no session 'friday'"),
    ):
        with pytest.raises(DatabaseError, match=words) as caught:
            act()
        assert "friday" not in words or caught.value.hint == "there are: 'monday', 'tuesday'"
    assert everything(place) == before and not none.exists() and not frames(place)


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


# --- Building and floor: given when converting, kept in the database, named in answers ---


ROOM = plan(6, 4, [(2, 0, 2, 2), (4, 2, 6, 2)])


@pytest.mark.parametrize(
    ("a", "b", "contradict"),
    [
        (Label(), Label(), False),
        (Label(building="A", floor="1"), Label(building="A", floor="1"), False),
        (Label(building="A", floor="1"), Label(building="A"), False),
        (Label(building="A"), Label(), False),
        (Label(building="A", floor="1"), Label(building="A", floor="2"), True),
        (Label(building="A", floor="1"), Label(building="B", floor="1"), True),
    ],
)
def test_what_was_not_said_contradicts_nothing(a: Label, b: Label, contradict: bool) -> None:
    assert a.contradicts(b) is b.contradicts(a) is contradict


def test_convert_takes_labels_and_relocalize_names_them(tmp_path: Path) -> None:
    save_map(ROOM, tmp_path / "room")
    made = tmp_path / "d.submaps"
    words = f"convert {tmp_path}/room.yaml -o {made} --building hall --floor 2"
    assert CliRunner().invoke(app, words.split()).exit_code == 0
    with open_database(made) as database:
        answer = locate_map(ROOM, MapIndex.of(database, Config()))
    assert answer.label == Label(building="hall", floor="2")
    assert answer.to_json()["floor"] == "2"
    assert "in room (hall, 2): x" in as_text(answer, is_map=True)
    shown = CliRunner().invoke(app, ["db", "info", str(made), "--json"])
    assert json.loads(shown.stdout)["sessions"][0]["building"] == "hall"


# --- Where sessions lie in their buildings, on every engine: all or nothing, and kept with the sessions ---


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
    maintenance.store_frames(place, FRAMES)
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
    maintenance.store_frames(path, {"monday": HERE})
    assert frames(path) == {"monday": HERE}
    maintenance.store_frames(path, {"monday": None})
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


def test_a_damaged_frame_costs_no_other(joined: str | Path, tmp_path: Path) -> None:
    sql(joined, "UPDATE part SET crc32 = crc32 + 1 WHERE session_id = 2 AND name = 'frame'")
    maintenance.copy(joined, tmp_path / "copy.submaps", recover=True)
    assert frames(tmp_path / "copy.submaps") == {"monday": HERE}
