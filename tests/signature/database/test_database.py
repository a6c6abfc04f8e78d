"""The submap database: what goes in comes out, whole or not at all, on every engine; damage is found."""

from __future__ import annotations

import math
import multiprocessing
import os
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseVersion,
    NotADatabase,
    OutputError,
)
from pc2grid.model import Trajectory
from signature.config import Config
from signature.database import Label, create_database, maintenance, open_database
from signature.database.maintenance import check, copy, merge, store
from signature.database.sqlite import atomic_update
from signature.database.sqlite.atomic_update import hold
from tests.helpers import postgresql
from tests.helpers.databases import assert_holds, digest_of, everything, make_entry, sql


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "odd name #1?%41.submaps"
    store(file, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return file


# --- what every engine promises -----------------------------------------------------------------------


@pytest.fixture(params=["sqlite", "postgres"])
def empty(request, tmp_path: Path) -> str | Path:
    """Where there is no database yet, on each engine."""
    return tmp_path / "x.submaps" if request.param == "sqlite" else postgresql.new_database()


@pytest.fixture
def filled(empty: str | Path) -> str | Path:
    store(empty, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return empty


def test_what_goes_in_comes_out(filled: str | Path) -> None:
    with open_database(filled) as database:
        assert [info.name for info in database.sessions()] == ["monday", "tuesday"]
        assert_holds(database, make_entry("monday", 0))
        assert_holds(database, make_entry("tuesday", 1, submaps=5))
        assert database.check() == ()
        assert database.leave_out_damaged() == ()
        assert list(database.signatures("tuesday").session_index) == [1] * 5
        assert [info.name for info in database.sessions(["tuesday", "friday"])] == ["tuesday"]
        with pytest.raises(DatabaseError, match="no session 'sunday'"):
            database.grid("sunday")
        with pytest.raises(DatabaseError, match="has no submap 99"):
            database.submap("monday", 99)
        with pytest.raises(DatabaseError, match="reading only"):
            database.add(*make_entry("wednesday", 2))


def test_a_session_is_summed_up(filled: str | Path) -> None:
    session_map, _, origin = make_entry("monday", 0)
    with open_database(filled) as database:
        info = database.sessions()[0]
    grid, steps = session_map.grid, [math.hypot(0.1, 0.01 * (2 * i + 1)) for i in range(6)]
    free = int(((grid.cells >= 0) & (grid.cells < 20)).sum())
    assert info.area_m2 == pytest.approx(free * 0.0025, abs=6e-4)
    assert info.path_m == pytest.approx(sum(steps), abs=6e-4)
    assert (info.duration_s, info.scans, info.submaps, info.resolution_m) == (0.6, 7, 3, 0.05)
    assert (info.sensor, info.report, info.provenance) == ("lidar", session_map.report, origin)
    assert info.consistency == session_map.consistency
    assert info.precision == session_map.precision
    assert info.odometry == session_map.odometry is not None


def test_a_session_of_which_nothing_was_measured(filled: str | Path) -> None:
    session_map, signatures, origin = make_entry("old", 5)
    entry = replace(session_map, consistency=None, odometry=None, precision=None), signatures, origin
    store(filled, [entry], keep=True)
    with open_database(filled) as database:
        assert database.sessions(["old"])[0].consistency is None
        assert database.sessions(["old"])[0].precision is None
        assert database.sessions(["old"])[0].odometry is None
        assert database.check() == ()


def test_sessions_without_submaps_or_poses(filled: str | Path) -> None:
    session_map, signatures, origin = make_entry("empty", 5, submaps=0)
    nowhere = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
    entry = replace(session_map, trajectory=nowhere, loops=()), signatures, origin
    for keep in (True, False):
        store(filled, [entry], keep=keep)
        with open_database(filled) as database:
            assert_holds(database, entry)
            info = database.sessions(["empty"])[0]
            assert (info.path_m, info.duration_s, info.scans, info.submaps) == (0.0, 0.0, 0, 0)
            assert database.check() == ()
            assert len(database.signatures("empty")) == 0
            assert len(database.signatures()) == (8 if keep else 0)
            assert len(database.seen_places("empty")) == 0


def test_nothing_there_is_no_database(empty: str | Path) -> None:
    with pytest.raises(NotADatabase, match=r"no such database|no submap database yet") as caught:
        open_database(empty)
    assert "pc2grid convert" in str(caught.value)


def test_a_handle_sees_what_was_there_when_it_was_opened(empty: str | Path) -> None:
    with create_database(empty) as first:
        assert (first.sessions(), len(first.signatures()), first.config()) == ((), 0, Config())
        first.add(*make_entry("monday", 0))
        with open_database(empty) as reader:
            first.add(*make_entry("tuesday", 1, submaps=5))
            assert [info.name for info in reader.sessions()] == ["monday"]
            assert len(reader.signatures()) == 3
        assert [info.name for info in first.sessions()] == ["monday", "tuesday"]
        assert_holds(first, make_entry("tuesday", 1, submaps=5))


def test_a_database_can_be_narrowed_to_a_building_or_floor(empty: str | Path) -> None:
    labels = {"a": Label(building="north", floor="1"), "b": Label(building="north"), "c": Label()}
    entries = []
    for seed, (name, label) in enumerate(labels.items()):
        session_map, signatures, origin = make_entry(name, seed, submaps=30)
        entries.append((session_map, signatures, replace(origin, label=label)))
    store(empty, entries, keep=False)
    filters = [
        {},
        {"building": "north"},
        {"floor": "1"},
        {"building": "north", "floor": ""},
        {"building": ""},
    ]
    for wanted, sessions in zip(filters, ["abc", "ab", "a", "b", "c"], strict=True):
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
        assert (database.submap("monday", 2).grid.cells >= 0).sum() == known


@pytest.mark.parametrize("other", ["sqlite", "postgres"])
def test_copy_and_merge_between_engines(filled: str | Path, other: str, tmp_path: Path) -> None:
    targets = (
        (tmp_path / "y.submaps", tmp_path / "z.submaps")
        if other == "sqlite"
        else (postgresql.new_database(), postgresql.new_database())
    )
    assert maintenance.copy(filled, targets[0]) == ()
    assert maintenance.check(targets[0]) == ()
    assert everything(targets[0]) == everything(filled)
    with pytest.raises(OutputError, match="exists"):
        maintenance.copy(filled, targets[0])
    third = tmp_path / "third.submaps"
    store(third, [make_entry("tuesday", 1, submaps=5), make_entry("friday", 5)], keep=False)
    assert maintenance.merge([filled, third], targets[1]) == 3
    with open_database(targets[1]) as database:
        assert [info.name for info in database.sessions()] == ["monday", "tuesday", "friday"]
        assert_holds(database, make_entry("friday", 5))
    store(third, [make_entry("monday", 9)], keep=False)
    with pytest.raises(DatabaseError, match="'monday'"):
        maintenance.merge([filled, third], targets[1], force=True)
    with open_database(targets[1]) as database:
        assert len(database.sessions()) == 3


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
        database.check()
        assert sorted(path.parent.iterdir()) == folder
        with pytest.raises(DatabaseError, match="reading only"):
            database.add(*make_entry("wednesday", 2))
    assert path.read_bytes() == before
    assert sorted(path.parent.iterdir()) == folder == [path]


def test_same_sessions_give_same_bytes(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.submaps"
    store(other, [make_entry("monday", 0)], keep=False)
    with open_database(other, writable=True) as database:
        database.add(*make_entry("tuesday", 1, submaps=5))
    copied = tmp_path / "copy.submaps"
    copy(path, copied)
    rebuilt = tmp_path / "rebuilt.submaps"
    store(rebuilt, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    assert path.read_bytes() == rebuilt.read_bytes()
    with open_database(other) as a, open_database(copied) as b:
        for database in (a, b):
            assert_holds(database, make_entry("monday", 0))
            assert_holds(database, make_entry("tuesday", 1, submaps=5))


def test_adding_again_changes_nothing_and_another_of_the_name_needs_force(filled: str | Path) -> None:
    before = everything(filled)
    with open_database(filled, writable=True) as database:
        database.add(*make_entry("monday", 0))
        assert digest_of(database) == before
        assert len(database.sessions()) == 2
        with pytest.raises(DatabaseError, match="another session named 'monday'") as caught:
            database.add(*make_entry("monday", 7))
        assert "--force" in str(caught.value)
        assert_holds(database, make_entry("monday", 0))
        database.add(*make_entry("monday", 7), force=True)
        assert_holds(database, make_entry("monday", 7))
        assert_holds(database, make_entry("tuesday", 1, submaps=5))
        assert [info.name for info in database.sessions()] == ["monday", "tuesday"]
        assert database.check() == ()


def test_create_refuses_to_overwrite_and_leaves_what_is_there(filled: str | Path) -> None:
    before = everything(filled)
    with pytest.raises(OutputError, match="exists"):
        create_database(filled)
    assert everything(filled) == before
    with create_database(filled, force=True) as database:
        assert database.sessions() == ()
        assert len(database.signatures()) == 0


def test_sessions_made_with_other_settings_are_not_mixed(filled: str | Path) -> None:
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    before = everything(filled)
    with (
        open_database(filled, writable=True) as database,
        pytest.raises(DatabaseError, match=r"signature\.boundary_bin_m = 0\.2 and with 0\.3"),
    ):
        database.add(*make_entry("wednesday", 3, config=config))
    assert everything(filled) == before


def test_failure_in_the_middle_leaves_what_was_there(filled: str | Path) -> None:
    before = everything(filled)
    session_map, signatures, origin = make_entry("wednesday", 3)
    for keep in (True, False):
        with pytest.raises(ValueError, match="3 submaps but 2 signatures"):
            store(filled, [make_entry("friday", 4), (session_map, signatures[:-1], origin)], keep=keep)
        assert everything(filled) == before


def test_failure_in_the_middle_leaves_the_old_file_and_no_litter(path: Path) -> None:
    before = path.read_bytes()
    session_map, signatures, origin = make_entry("wednesday", 3)
    with pytest.raises(ValueError, match="3 submaps but 2 signatures"):
        store(path, [make_entry("friday", 4), (session_map, signatures[:-1], origin)], keep=True)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


# --- faults 43 and 44 ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        (b"", NotADatabase, "empty file"),
        (b"hello", NotADatabase, "not a pc2grid database"),
        (os.urandom(4096), NotADatabase, "not a pc2grid database"),
        (b"SQLite format 3\0" + b"\0" * 20, DatabaseCorrupt, "truncated"),
    ],
)
def test_what_is_not_a_database_is_said_to_be_none(tmp_path: Path, content, error, words) -> None:
    file = tmp_path / "x.submaps"
    file.write_bytes(content)
    with pytest.raises(error, match=words):
        open_database(file)
    assert list(tmp_path.iterdir()) == [file]


def test_missing_file_folder_and_url(tmp_path: Path) -> None:
    with pytest.raises(NotADatabase, match="no such database"):
        open_database(tmp_path / "none.submaps")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(NotADatabase, match="folder"):
        open_database(tmp_path)
    with pytest.raises(DatabaseError, match="mongodb:// databases"):
        open_database("mongodb://host/db")


def test_sqlite_file_of_another_program(tmp_path: Path) -> None:
    file = tmp_path / "places.sqlite"
    connection = sqlite3.connect(file)
    connection.execute("CREATE TABLE bookmarks (url TEXT)")
    connection.commit()
    connection.close()
    with pytest.raises(NotADatabase, match="another program's SQLite file"):
        open_database(file)


def test_zero_byte_file_is_filled_without_force(tmp_path: Path) -> None:
    file = tmp_path / "new.submaps"
    file.touch()
    with create_database(file) as database:
        database.add(*make_entry())
        assert_holds(database, make_entry())


def test_newer_format_is_refused_by_number(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[60:64] = (99).to_bytes(4, "big")
    path.write_bytes(data)
    with pytest.raises(DatabaseVersion, match="format 99; this pc2grid reads format 1"):
        open_database(path)


@pytest.mark.parametrize("share", [0.02, 0.5, 0.99])
def test_truncated_file_is_seen_at_opening(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises((DatabaseCorrupt, NotADatabase), match="truncated"):
        open_database(path)


def test_strangers_trigger_is_refused(path: Path) -> None:
    connection = sqlite3.connect(path)
    connection.execute("CREATE TRIGGER t AFTER INSERT ON session BEGIN DELETE FROM session; END")
    connection.commit()
    connection.close()
    with pytest.raises(DatabaseCorrupt, match="tables are not those"):
        open_database(path)


@pytest.mark.parametrize(
    "name",
    [
        "grid.cells",
        "trajectory.T_session_base",
        "loops.information",
        "graph.path_m",
        "points.steps",
        "seen.signatures",
        "submaps.boundary",
        "submaps.center_m",
    ],
)
def test_flipped_bit_in_any_array_is_found_where_integrity_check_is_blind(path: Path, name: str) -> None:
    ((blob,),) = sql(path, 'SELECT data FROM "array" WHERE name = ? LIMIT 1', name)
    data = bytearray(path.read_bytes())
    at = data.find(blob[:64]) + min(len(blob), 64) // 2
    data[at] ^= 4
    path.write_bytes(data)
    assert sql(path, "PRAGMA integrity_check") == [("ok",)]

    (problem,) = check(path)
    assert problem.where.startswith(f"{name} of session ")
    assert "checksum" in problem.what
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match="checksum") as caught:
        digest_of(database)
    assert "db check" in str(caught.value)


# --- merge --------------------------------------------------------------------------------------------


def test_merge_takes_equal_sessions_once_and_refuses_namesakes(path: Path, tmp_path: Path) -> None:
    second, third, out = (tmp_path / f"{name}.submaps" for name in ("second", "third", "out"))
    store(second, [make_entry("tuesday", 1, submaps=5), make_entry("friday", 5)], keep=False)
    assert merge([path, second], out) == 3
    assert check(out) == ()
    with open_database(out) as database:
        for entry in (make_entry("monday", 0), make_entry("tuesday", 1, submaps=5), make_entry("friday", 5)):
            assert_holds(database, entry)
    store(third, [make_entry("monday", 9)], keep=False)
    with pytest.raises(DatabaseError, match="'monday' is not the 'monday' of"):
        merge([path, third], tmp_path / "no.submaps")
    assert not (tmp_path / "no.submaps").exists()


def test_merging_a_database_with_itself_is_refused(path: Path, tmp_path: Path) -> None:
    link, out = tmp_path / "link.submaps", tmp_path / "out.submaps"
    link.symlink_to(path)
    for sources in ([path, path], [path, link], [path, path.parent / "." / path.name]):
        with pytest.raises(DatabaseError, match=r"submaps: named twice"):
            merge(sources, out)
        assert not out.exists()


# --- fault 45: a writer that holds it -----------------------------------------------------------------


def _hold_forever(file: str, ready) -> None:
    with hold(Path(file), 1.0):
        ready.set()
        time.sleep(60)


@pytest.mark.fault(45)
def test_a_second_writer_learns_the_holder_and_a_killed_holder_is_no_obstacle(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    holder = context.Process(target=_hold_forever, args=(str(path.resolve()), ready))
    holder.start()
    assert ready.wait(30)
    monkeypatch.setattr(atomic_update, "BUSY_TIMEOUT_S", 0.2)
    with pytest.raises(DatabaseBusy, match=f"being written by process {holder.pid} on "):
        store(path, [make_entry("friday", 5)], keep=True)
    with open_database(path) as database:
        assert len(database.sessions()) == 2
    holder.kill()
    holder.join()
    monkeypatch.setattr(atomic_update, "BUSY_TIMEOUT_S", 5)
    store(path, [make_entry("friday", 5)], keep=True)
    assert check(path) == ()
    assert list(path.parent.iterdir()) == [path]


# --- the database against a dict ----------------------------------------------------------------------


class DatabaseModel(RuleBasedStateMachine):
    @initialize()
    def start(self) -> None:
        import tempfile

        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name) / "model.submaps"
        create_database(self.path).close()
        self.model: dict[str, int] = {}

    @rule(name=st.sampled_from("abc"), seed=st.integers(0, 2), force=st.booleans())
    def add(self, name: str, seed: int, force: bool) -> None:
        known = self.model.get(name)
        with open_database(self.path, writable=True) as database:
            if known is not None and known != seed and not force:
                with pytest.raises(DatabaseError):
                    database.add(*make_entry(name, seed), force=force)
                return
            database.add(*make_entry(name, seed), force=force)
        self.model[name] = seed

    @rule(name=st.sampled_from("abc"))
    def fail(self, name: str) -> None:
        session_map, signatures, origin = make_entry(name, 99)
        with pytest.raises((ValueError, DatabaseError)):
            store(self.path, [(session_map, signatures[:-1], origin)], keep=True, force=True)

    @rule()
    def compact(self) -> None:
        other = self.path.with_name("other.submaps")
        assert copy(self.path, other, force=True) == ()
        other.replace(self.path)

    @invariant()
    def agrees(self) -> None:
        if not hasattr(self, "model"):
            return
        with open_database(self.path) as database:
            assert {info.name for info in database.sessions()} == set(self.model)
            for name, seed in self.model.items():
                assert_holds(database, make_entry(name, seed))
        assert list(self.path.parent.iterdir()) == [self.path]

    def teardown(self) -> None:
        self.folder.cleanup()


DatabaseModel.TestCase.settings = settings(
    max_examples=15, stateful_step_count=12, deadline=None, suppress_health_check=list(HealthCheck)
)
TestDatabaseModel = DatabaseModel.TestCase
