"""The submap database: what goes in comes out, whole or not at all, on every engine; damage is found."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import DatabaseError, NotADatabase, OutputError
from pc2grid.model import Trajectory
from signature.config import Config
from signature.database import Label, maintenance, open_database
from signature.database.maintenance import copy, merge, store
from tests.helpers import postgresql
from tests.helpers.databases import MONDAY, TUESDAY, assert_holds, everything, make_entry


def test_what_goes_in_comes_out(place: str | Path) -> None:
    with open_database(place) as database:
        assert [info.name for info in database.sessions()] == ["monday", "tuesday"]
        assert_holds(database, MONDAY)
        assert_holds(database, TUESDAY)
        info = database.sessions()[0]
        assert (info.duration_s, info.scans, info.submaps, info.resolution_m) == (0.6, 7, 3, 0.05)
        assert (info.sensor, info.report, info.provenance) == ("lidar", MONDAY[0].report, MONDAY[2])
        assert info.area_m2 == round(MONDAY[0].grid.free_m2, 3)
        assert info.path_m == round(MONDAY[0].trajectory.length_m, 3)
        assert maintenance.check(database.location) == ()
        assert database.leave_out_damaged() == ()
        assert list(database.signatures("tuesday").session_index) == [1] * 5
        assert [info.name for info in database.sessions(["tuesday", "friday"])] == ["tuesday"]
        with pytest.raises(DatabaseError, match="no session 'sunday'"):
            database.grid("sunday")


def test_sessions_of_which_nothing_was_measured_without_submaps_or_poses(place: str | Path) -> None:
    session_map, signatures, origin = make_entry("empty", 5, submaps=0)
    nowhere = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
    nothing = {"loops": (), "consistency": None, "odometry": None, "precision": None}
    entry = replace(session_map, trajectory=nowhere, **nothing), signatures, origin
    for keep in (True, False):
        store(place, [entry], keep=keep)
        with open_database(place) as database:
            assert_holds(database, entry)
            info = database.sessions(["empty"])[0]
            assert (info.path_m, info.duration_s, info.scans, info.submaps) == (0.0, 0.0, 0, 0)
            assert maintenance.check(database.location) == ()
            assert len(database.signatures("empty")) == 0
            assert len(database.signatures()) == (8 if keep else 0)
            assert len(database.seen_places("empty")) == 0


def test_nothing_there_is_no_database(empty: str | Path) -> None:
    with pytest.raises(NotADatabase, match=r"no such database|no submap database yet") as caught:
        open_database(empty)
    assert "pc2grid.convert(" in str(caught.value)


def test_a_handle_sees_what_was_there_when_it_was_opened(empty: str | Path) -> None:
    store(empty, [], keep=False)
    with open_database(empty) as first:
        assert (first.sessions(), len(first.signatures()), first.config()) == ((), 0, Config())
        store(empty, [MONDAY], keep=True)
        with open_database(empty) as reader:
            store(empty, [TUESDAY], keep=True)
            assert [info.name for info in reader.sessions()] == ["monday"]
            assert len(reader.signatures()) == 3
        assert first.sessions() == ()
    with open_database(empty) as database:
        assert [info.name for info in database.sessions()] == ["monday", "tuesday"]
        assert_holds(database, TUESDAY)


def test_a_database_can_be_narrowed_to_a_building_or_floor(empty: str | Path) -> None:
    labels = {"a": Label(building="north", floor="1"), "b": Label(building="north"), "c": Label()}
    for seed, (name, label) in enumerate(labels.items()):
        session_map, signatures, origin = make_entry(name, seed, submaps=30)
        store(empty, [(session_map, signatures, replace(origin, label=label))], keep=True)
    for wanted, sessions in (
        ({}, "abc"),
        ({"building": "north"}, "ab"),
        ({"floor": "1"}, "a"),
        ({"building": "north", "floor": ""}, "b"),
        ({"building": ""}, "c"),
    ):
        with open_database(empty) as database:
            database.keep_only(**wanted)
            assert "".join(info.name for info in database.sessions()) == sessions
            assert len(database.signatures()) == 30 * len(sessions)
            assert database.leave_out_damaged() == ()
    with open_database(empty) as database:
        with pytest.raises(DatabaseError, match="no session of south") as caught:
            database.keep_only(building="south")
        assert "north, 1" in str(caught.value)
        database.keep_only(building="north")
        with pytest.raises(DatabaseError, match="no session 'c'"):
            database.grid("c")


def test_submaps_are_cut_from_the_map_as_the_settings_say(empty: str | Path) -> None:
    config = Config.model_validate({"partition": {"view": "disc"}})
    entries = [make_entry("monday", 0, submaps=4, config=config)]
    store(empty, entries, keep=False)
    with open_database(empty) as database:
        assert_holds(database, entries[0])
        # A disc of 5 m holds all of the map that is known, and an isovist only what is seen.
        known = (database.grid("monday").cells >= 0).sum()
        assert ([*database.submaps("monday")][2].grid.cells >= 0).sum() == known


@pytest.mark.parametrize("other", ["sqlite", "postgres"])
def test_copy_and_merge_between_engines(place: str | Path, other: str, tmp_path: Path) -> None:
    files = tmp_path / "y.submaps", tmp_path / "z.submaps"
    targets = files if other == "sqlite" else (postgresql.new_database(), postgresql.new_database())
    assert maintenance.copy(place, targets[0]) == ()
    assert maintenance.check(targets[0]) == ()
    assert everything(targets[0]) == everything(place)
    with pytest.raises(OutputError, match="exists"):
        maintenance.copy(place, targets[0])
    third = tmp_path / "third.submaps"
    store(third, [TUESDAY, make_entry("friday", 5)], keep=False)
    assert maintenance.merge([place, third], targets[1]) == 3
    with open_database(targets[1]) as database:
        assert [info.name for info in database.sessions()] == ["monday", "tuesday", "friday"]
        assert_holds(database, make_entry("friday", 5))
    store(third, [make_entry("monday", 9)], keep=False)
    with pytest.raises(DatabaseError, match="'monday'"):
        maintenance.merge([place, third], targets[1], overwrite=True)
    with open_database(targets[1]) as database:
        assert len(database.sessions()) == 3


def test_any_name_of_a_file(path: Path) -> None:
    odd = path.rename(path.with_name("odd name #1?%41.submaps"))
    store(odd, [make_entry("friday", 5)], keep=True)
    with open_database(odd) as database:
        assert_holds(database, MONDAY)
    assert list(path.parent.iterdir()) == [odd]


def test_a_closed_database_is_not_called_damaged(path: Path) -> None:
    with open_database(path) as database:
        name = database.sessions()[0].name
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        database.grid(name)


def test_queries_leave_bytes_and_folder_as_they_are(path: Path) -> None:
    before, folder = path.read_bytes(), sorted(path.parent.iterdir())
    path.chmod(0o444)
    with open_database(path) as database:
        database.signatures()
        database.grid("monday")
        maintenance.check(database.location)
        assert sorted(path.parent.iterdir()) == folder
    assert path.read_bytes() == before
    assert sorted(path.parent.iterdir()) == folder == [path]


def test_same_sessions_give_same_bytes(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.submaps"
    store(other, [MONDAY], keep=False)
    store(other, [TUESDAY], keep=True)
    copied = tmp_path / "copy.submaps"
    copy(path, copied)
    rebuilt = tmp_path / "rebuilt.submaps"
    store(rebuilt, [MONDAY, TUESDAY], keep=False)
    assert path.read_bytes() == rebuilt.read_bytes()
    with open_database(other) as a, open_database(copied) as b:
        for database in (a, b):
            assert_holds(database, MONDAY)
            assert_holds(database, TUESDAY)


def test_adding_again_changes_nothing_and_another_of_the_name_needs_force(place: str | Path) -> None:
    before = everything(place)
    store(place, [MONDAY], keep=True)
    assert everything(place) == before
    with pytest.raises(DatabaseError, match="another session named 'monday'") as caught:
        store(place, [make_entry("monday", 7)], keep=True)
    assert "overwrite=True" in str(caught.value)
    assert everything(place) == before
    store(place, [make_entry("monday", 7)], keep=True, overwrite=True)
    with open_database(place) as database:
        assert_holds(database, make_entry("monday", 7))
        assert_holds(database, TUESDAY)
        assert [info.name for info in database.sessions()] == ["monday", "tuesday"]
        assert maintenance.check(database.location) == ()


def test_sessions_made_with_other_settings_are_not_mixed(place: str | Path) -> None:
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    before = everything(place)
    with pytest.raises(DatabaseError, match=r"signature\.boundary_bin_m = 0\.2 and with 0\.3"):
        store(place, [make_entry("wednesday", 3, config=config)], keep=True)
    assert everything(place) == before


def test_failure_in_the_middle_leaves_what_was_there(place: str | Path) -> None:
    before = everything(place)
    session_map, signatures, origin = make_entry("wednesday", 3)
    for keep in (True, False):
        with pytest.raises(ValueError, match="3 submaps but 2 signatures"):
            store(place, [make_entry("friday", 4), (session_map, signatures[:-1], origin)], keep=keep)
        assert everything(place) == before


def test_missing_file_folder_and_url(tmp_path: Path) -> None:
    with pytest.raises(NotADatabase, match="no such database"):
        open_database(tmp_path / "none.submaps")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(NotADatabase, match="folder"):
        open_database(tmp_path)
    with pytest.raises(DatabaseError, match="mongodb:// databases"):
        open_database("mongodb://host/db")


def test_zero_byte_file_is_place_without_force(tmp_path: Path) -> None:
    file = tmp_path / "new.submaps"
    file.touch()
    assert not maintenance.exists(file)
    store(file, [make_entry()], keep=True)
    with open_database(file) as database:
        assert_holds(database, make_entry())


def test_merging_a_database_with_itself_is_refused(path: Path, tmp_path: Path) -> None:
    link, out = tmp_path / "link.submaps", tmp_path / "out.submaps"
    link.symlink_to(path)
    for sources in ([path, path], [path, link], [path, path.parent / "." / path.name]):
        with pytest.raises(DatabaseError, match=r"submaps: named twice"):
            merge(sources, out)
        assert not out.exists()
