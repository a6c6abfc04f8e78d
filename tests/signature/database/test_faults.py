"""Damaged, foreign and contended databases: refused by name, or searched without what is damaged."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import multiprocessing
import os
import sqlite3
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.synchronize import Event
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseVersion,
    NotADatabase,
    OutputError,
    Pc2GridError,
)
from pc2grid.io.maps import save_map
from pc2grid.model import ReadReport, SessionMap, Trajectory
from pc2grid.submaps.submaps import divide
from pc2grid_cli.main import app
from signature.boundary import boundary_bins
from signature.config import Config
from signature.database import (
    Label,
    Provenance,
    SubmapDatabase,
    document as validation,
    maintenance,
    open_database,
    postgres,
    sqlite,
)
from signature.database.database import PART_COLUMNS, SESSION_COLUMNS
from signature.database.document import PARTS
from signature.database.maintenance import check, copy, merge, store
from signature.database.protocol import APPLICATION_ID
from signature.database.sqlite import hold
from signature.paper import describe
from signature.sessions import add_session, provenance
from tests.helpers import postgresql
from tests.helpers.databases import (
    MONDAY,
    READ_PART,
    TUESDAY,
    Content,
    assert_holds,
    craft,
    everything,
    make_entry,
    sql,
)
from tests.helpers.memory import bounded_memory
from tests.helpers.rooms import small_house

FUZZ = int(os.environ.get("PC2GRID_FUZZ", "0"))


def set_header(offset: int, value: int) -> Callable[[bytes], bytes]:
    return lambda data: data[:offset] + value.to_bytes(4, "big") + data[offset + 4 :]


# --- faults 43 and 44: what is not a whole database of this format ------------------------------------


@pytest.mark.fault(43)
@pytest.mark.parametrize(
    ("damage", "error", "words"),
    [
        (lambda data: b"", NotADatabase, "empty file"),
        (lambda data: data[:15], NotADatabase, "not a pc2grid database"),
        (lambda data: data[:99], DatabaseCorrupt, "truncated to 99 bytes"),
        (lambda data: data[:100], DatabaseCorrupt, "100 bytes where its header promises"),
        (lambda data: data[:-1], DatabaseCorrupt, "truncated or damaged"),
        (lambda data: data + b"\0", DatabaseCorrupt, "truncated or damaged"),
        (lambda data: data[:100] + bytes(len(data) - 100), DatabaseCorrupt, "x.submaps"),
        (lambda data: bytes(range(256)) * 64, NotADatabase, "not a pc2grid database"),
        (set_header(68, 0), NotADatabase, "another program's SQLite file (application id 0x0)"),
        (set_header(60, 2), DatabaseVersion, "database format 2; this pc2grid reads format 1"),
        (set_header(60, 0), DatabaseVersion, "database format 0; this pc2grid reads format 1"),
        # Definitions of tables that are no text; SQLite's message quotes the name.
        (lambda data: data.replace(b"tablepartpart", b"table\xffartpart"), DatabaseCorrupt, "x.submaps"),
        (lambda data: data.replace(b"CREATE TABLE part", b"CREATE \xffABLE part"), DatabaseCorrupt, ""),
        (lambda data: data.replace(b"part (building", b"part (b\xffilding"), DatabaseCorrupt, ""),
    ],
)
def test_every_command_refuses_it_and_leaves_it(
    path: Path, tmp_path: Path, damage: Callable[[bytes], bytes], error: type[Pc2GridError], words: str
) -> None:
    content, sound = damage(path.read_bytes()), path.read_bytes()
    assert content != sound
    path.write_bytes(content)
    uses: list[Callable[[], object]] = [
        lambda: everything(path),
        lambda: copy(path, tmp_path / "copy.submaps"),
        lambda: merge([path], tmp_path / "merged.submaps"),
    ]
    if content:  # an empty file may be filled
        uses.append(lambda: store(path, [make_entry("friday", 5)], keep=True))
    for use in uses:
        with pytest.raises(error) as caught:
            use()
        assert words in caught.value.message
        assert str(path) in caught.value.message
        assert path.read_bytes() == content
        assert list(tmp_path.iterdir()) == [path]
    if error is DatabaseCorrupt:
        assert check(path) != ()
    else:
        with pytest.raises(error):
            check(path)


def test_files_of_other_programs(tmp_path: Path) -> None:
    stranger = tmp_path / "places.sqlite"
    connection = sqlite3.connect(stranger)
    connection.execute("CREATE TABLE session (id INTEGER PRIMARY KEY, name TEXT)")
    connection.commit()
    with pytest.raises(NotADatabase, match="another program's SQLite file"):
        open_database(stranger)
    # Even one that calls itself ours.
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute("PRAGMA user_version = 1")
    connection.commit()
    connection.close()
    before = stranger.read_bytes()
    with pytest.raises(DatabaseCorrupt, match="its tables are not those of format 1") as caught:
        open_database(stranger)
    assert "convert the recordings again" in str(caught.value)  # it may be of an older version
    with pytest.raises(DatabaseCorrupt, match="its tables are not those of format 1"):
        store(stranger, [make_entry()], keep=True)
    assert stranger.read_bytes() == before
    assert list(tmp_path.iterdir()) == [stranger]


# --- fault 43: flipped bits ---------------------------------------------------------------------------


def flip(path: Path, part: str, position: float, bit: int, session: int = 2) -> None:
    """Flip one bit inside the bytes of a part, in the file's bytes."""
    with sqlite3.connect(path) as connection:
        query = "SELECT rowid FROM part WHERE session_id = ? AND name = ?"
        (rowid,) = connection.execute(query, (session, part)).fetchone()
        with connection.blobopen("part", "data", rowid) as blob:
            at = int(position * (len(blob) - 1))
            blob[at] = blob[at] ^ (1 << bit)
    connection.close()


@pytest.mark.fault(43)
def test_fuzz_flipped_bit_anywhere_in_any_array_is_found(two: bytes, path: Path) -> None:
    rng = np.random.default_rng(43)
    for _ in range(min(FUZZ, 600) or 2):
        for part in PARTS:
            path.write_bytes(two)
            flip(path, part, float(rng.random()), int(rng.integers(8)))
            assert sql(path, "PRAGMA integrity_check") == [("ok",)]  # SQLite itself does not see it
            (problem,) = check(path)
            assert (problem.where, problem.what) == (f"{part} of session 'tuesday'", "wrong checksum")
            if part != "frame":
                with pytest.raises(DatabaseCorrupt, match=r"damaged: .*wrong checksum") as caught:
                    everything(path)
                assert "--recover" in str(caught.value)


def test_pages_that_are_met_again_and_again(path: Path) -> None:
    """Two pages with four hundred times the page below make 160,000 rows of one, in a few kilobytes."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        ((root,),) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'session'")
    content, size = bytearray(path.read_bytes()), 4096
    rows_at, pages = (root - 1) * size, len(content) // size
    rows_of_it = content[rows_at : rows_at + size]

    def many_times(page: int) -> bytes:
        """An inner page of a table with four hundred children, all of them one page."""
        begin = size - 400 * 6  # where the cells stand: a page, and the largest number of a row below it
        head = struct.pack(">BHHHBI", 0x05, 0, 400, begin, 0, page)
        places = struct.pack(">400H", *range(begin, size, 6))
        cells = struct.pack(">IH", page, 0x8101) * 400
        return head + places + bytes(begin - len(head) - len(places)) + cells

    content[rows_at : rows_at + size] = many_times(pages + 1)
    content += many_times(pages + 2) + rows_of_it
    content[28:32] = (pages + 2).to_bytes(4, "big")
    path.write_bytes(content)
    with bounded_memory(64 << 20):
        assert any("comes twice" in problem.what for problem in check(path))
        with pytest.raises(DatabaseCorrupt, match="comes twice"), open_database(path) as db:
            db.sessions()
        with pytest.raises(DatabaseCorrupt, match=r"comes twice|malformed"):
            store(path, [make_entry("sunday", 9, submaps=1)], keep=True)
    assert path.read_bytes() == content


COLUMNS = [("session", column) for column in SESSION_COLUMNS] + [("part", column) for column in PART_COLUMNS]
KEYS = ("building", "id", "session_id", "name")
"""Columns by which a row is found at all."""


@pytest.mark.parametrize(("table", "column"), COLUMNS)
def test_any_changed_value_of_any_row_is_found(path: Path, table: str, column: str) -> None:
    """Not only bytes of arrays: every number, name and document stands under the checksum."""
    ((kind,),) = sql(path, f"SELECT typeof({column}) FROM {table} LIMIT 1")
    change = {"integer": f"{column} + 8", "text": f"{column} || ' '", "blob": f"zeroblob(length({column}))"}[
        kind
    ]
    sql(path, f"UPDATE {table} SET {column} = {change} WHERE rowid = 1")
    said = [problem.what for problem in check(path)]
    assert "wrong checksum" in said or (column in KEYS and {"is missing", "belong to no session"} & {*said})
    with pytest.raises(Pc2GridError):
        everything(path)


HOW = {
    "lost": ("DELETE FROM {}", "is missing"),
    "changed": ("UPDATE {} SET crc32 = crc32 + 1", "wrong checksum"),
}


@pytest.mark.fault(43)
@pytest.mark.parametrize("part", READ_PART)
@pytest.mark.parametrize("how", HOW)
def test_a_damaged_part_is_named_and_costs_as_little_as_it_can(
    place: maintenance.Location, part: str, how: str, tmp_path: Path
) -> None:
    """A search needs grids and submaps; a copy also poses and loops, and makes the rest again."""
    (statement, what), where = HOW[how], f"{part} of session 'monday'"
    sql(place, statement.format("part") + " WHERE session_id = 1 AND name = ?", part)
    problems = check(place)
    assert [(problem.where, problem.what) for problem in problems] == [(where, what)]
    with open_database(place) as database:
        assert len(database.sessions()) == 2
        with pytest.raises(DatabaseCorrupt, match=f"{where}: {what}"):
            READ_PART[part](database)
        needed = part in ("grid", "submaps")
        assert database.leave_out_damaged() == (problems if needed else ())
        assert_only(database, ["monday", "tuesday"][needed:])
    assert check(place) == problems
    good, target = tmp_path / "good.submaps", tmp_path / "target.submaps"
    with pytest.raises(DatabaseCorrupt, match=f"damaged: {where}: {what}"):
        merge([place], target)
    assert not target.exists()
    assert len(copy(place, good, recover=True)) == 1
    assert check(good) == ()
    with open_database(good) as database:
        assert_only(database, ["monday", "tuesday"][part in ("grid", "trajectory", "loops") :])


@pytest.mark.parametrize("how", HOW)
def test_a_session_that_is_damaged_itself_is_left_out(place: maintenance.Location, how: str) -> None:
    if how == "lost" and isinstance(place, str):
        pytest.skip("a server refuses it")
    sql(place, HOW[how][0].format("session") + " WHERE id = 1")
    before = check(place)
    with open_database(place) as database:
        (problem,) = database.leave_out_damaged()
        assert "session" in problem.where and ("1" in problem.where or "monday" in problem.where)
        assert problem.what in ("wrong checksum", "belong to no session")
        assert_only(database, ["tuesday"])
    assert check(place) == before != ()


def assert_only(database: SubmapDatabase, names: list[str]) -> None:
    """These sessions are there, Tuesday as it was stored, and no other is."""
    assert [info.name for info in database.sessions()] == names
    assert_holds(database, TUESDAY)
    assert database.config() == Config()
    if names == ["tuesday"]:
        assert set(database.signatures().session_index) == {0}
        with pytest.raises(Pc2GridError, match="no session 'monday'"):
            database.grid("monday")


def test_a_wholly_damaged_database_is_refused(place: maintenance.Location) -> None:
    sql(place, "UPDATE part SET crc32 = crc32 + 1 WHERE name = 'submaps'")
    with (
        open_database(place) as database,
        pytest.raises(DatabaseCorrupt, match="submaps of session 'monday': wrong checksum"),
    ):
        database.leave_out_damaged()


@pytest.mark.fault(43)
def test_relocalize_leaves_a_damaged_session_out_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map is looked for in a database of itself and of a damaged neighbour."""
    from signature.sessions import build_session

    yaml, _ = save_map(small_house(), tmp_path / "house")
    config, database = Config(), tmp_path / "x.submaps"
    house, origin = build_session(yaml, "house", config)
    cellar, _ = build_session(yaml, "cellar", config)
    for session in (cellar, house):
        add_session(database, session, config, provenance(yaml, origin.digest, config))
    flip(database, "submaps", 0.3, 5, session=1)
    damaged = database.read_bytes()
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["relocalize", "house.yaml", "--database", "x.submaps", "--json"])
    answer = json.loads(done.stdout)
    assert answer["status"] == "located", answer
    assert done.exit_code == 3, done.stderr
    assert answer["database"]["left_out"] == ["submaps of session 'cellar': wrong checksum"]
    assert (
        "warning: x.submaps: damaged and left out: submaps of session 'cellar': wrong checksum" in done.stderr
    )
    assert database.read_bytes() == damaged


# --- fault 45: many readers, two writers --------------------------------------------------------------


def _write(place: maintenance.Location, mine: str, until: float, results: Any) -> None:
    """Add and replace sessions as fast as it goes; one of them both write."""
    done = number = 0
    while time.time() < until:
        number += 1
        name = "both" if number % 5 == 0 else f"{mine}{number % 4}"
        with contextlib.suppress(DatabaseBusy):
            store(place, [make_entry(name, 100 + number % 3)], keep=True, overwrite=True)
            done += 1
    results.put(("written", done))


def _read(place: maintenance.Location, known: dict[str, set[str]], until: float, results: Any) -> None:
    """Read everything repeatedly: every session is complete and equals one that was written."""
    done = 0
    while time.time() < until:
        for name, digest in everything(place).items():
            assert digest in known[name], f"a session {name!r} that was never written"
        done += 1
    results.put(("read", done))


@pytest.mark.fault(45)
@pytest.mark.parametrize("engine", ["sqlite", "postgres"])
def test_fuzz_eight_readers_and_two_writers(path: Path, engine: str, monkeypatch, tmp_path_factory) -> None:
    """No error but busy, no torn read; sessions that were not changed are still there."""
    place: maintenance.Location = path
    if engine == "postgres":
        place = postgresql.new_database()
        monkeypatch.setattr(postgres, "BUSY_TIMEOUT_S", 1.0)  # whole seconds there
        maintenance.store(place, [MONDAY, TUESDAY], keep=False)
    known: dict[str, set[str]] = {}
    names = ["both", *(f"{writer}{i}" for writer in "ab" for i in range(4))]
    for number, seed in enumerate((100, 101, 102)):
        written = tmp_path_factory.mktemp("written") / f"{number}.submaps"
        store(written, [make_entry(name, seed) for name in names], keep=False)
        for name, digest in everything(written).items():
            known.setdefault(name, set()).add(digest)
    known |= {name: {digest} for name, digest in everything(path).items()}

    context = multiprocessing.get_context("fork")  # ten interpreters would spend the time on starting
    results = context.Queue()
    until = time.time() + (60.0 if FUZZ else 1.0)
    parts = [context.Process(target=_write, args=(place, mine, until, results)) for mine in "ab"]
    parts += [context.Process(target=_read, args=(place, known, until, results)) for _ in range(8)]
    for part in parts:
        part.start()
    said = [results.get(timeout=120) for _ in parts]
    for part in parts:
        part.join(60)
    assert [part.exitcode for part in parts] == [0] * len(parts)
    written, read = (sum(times for what, times in said if what == kind) for kind in ("written", "read"))
    print(f"{engine}: {read} reads of everything, {written} sessions written")
    assert min(written, read) > 0
    assert maintenance.check(place) == ()
    for name, digest in everything(place).items():
        assert digest in known[name]
    with open_database(place) as database:
        assert_holds(database, MONDAY)
    assert list(path.parent.iterdir()) == [path]


def _hold(file: str, ready: Event) -> None:
    with hold(Path(file), 1.0):
        ready.set()
        time.sleep(60)


@pytest.mark.fault(45)
def test_a_second_writer_learns_the_holder_and_a_killed_holder_is_no_obstacle(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    holder = context.Process(target=_hold, args=(str(path.resolve()), ready))
    holder.start()
    assert ready.wait(60)
    monkeypatch.setattr(sqlite, "BUSY_TIMEOUT_S", 0.1)
    with pytest.raises(DatabaseBusy, match=f"being written by process {holder.pid} on ") as caught:
        store(path, [make_entry("friday", 5)], keep=True)
    assert caught.value.hint == "try again when it is done"
    with open_database(path) as database:
        assert len(database.sessions()) == 2
    monkeypatch.setattr(sqlite, "BUSY_TIMEOUT_S", 60)
    threading.Timer(0.3, holder.kill).start()
    store(path, [make_entry("friday", 5)], keep=True)  # waits until the other one is gone
    holder.join(60)
    assert check(path) == () and list(path.parent.iterdir()) == [path]


def test_adding_to_a_damaged_database_names_the_damage(path: Path) -> None:
    """A page of the tree overwritten: neither an error of SQLite's own nor a file that is worse off."""
    data = bytearray(path.read_bytes())
    refused = 0
    for page in range(4096, len(data), 4096):
        broken = data[:page] + b"\xa5" * 64 + data[page + 64 :]
        path.write_bytes(broken)
        try:
            store(path, [make_entry("tuesday", 9, submaps=5)], keep=True, overwrite=True)
        except (DatabaseCorrupt, OutputError) as error:
            assert str(path) in error.message
            assert path.read_bytes() == broken
            refused += 1
        assert list(path.parent.iterdir()) == [path]
    assert refused > 3


# --- what is lost as a whole, and what stands in a writer's way ---------------------------------------


def test_merging_does_not_mix_settings(path: Path, tmp_path: Path) -> None:
    other, target = tmp_path / "other.submaps", tmp_path / "target.submaps"
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    store(other, [make_entry("friday", 5, config=config)], keep=False)
    words = r"other\.submaps: sessions made with signature\.boundary_bin_m = 0\.2 and with 0\.3"
    with pytest.raises(DatabaseError, match=words):
        merge([path, other], target)
    assert not target.exists()


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("CREATE VIEW more AS SELECT * FROM part", "its tables are not those of format 1 ('more')"),
        ("CREATE TRIGGER t AFTER DELETE ON part BEGIN DELETE FROM session; END", "format 1 ('t')"),
        ("DELETE FROM session WHERE id = 2", "belong to no session"),
    ],
)
def test_structure_that_no_row_shows(path: Path, statement: str, words: str) -> None:
    sql(path, statement)
    problems = check(path)
    assert any(words in problem.what for problem in problems), problems


def test_what_follows_from_the_map_is_made_again(empty: maintenance.Location, tmp_path: Path) -> None:
    """Damaged submaps, signatures and views cost nothing; a damaged grid costs the session."""
    place = empty
    config, grid = Config(), small_house()
    empty = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    _, submaps = divide(grid, config.partition)
    house = SessionMap(session="house", sensor="map", grid=grid, submaps=submaps, trajectory=empty)
    signatures = [describe(submap, config.signature) for submap in submaps]
    entry = house, signatures, Provenance(source="house.yaml", digest="0" * 64, config=config)
    store(place, [MONDAY, entry, TUESDAY], keep=False)
    with open_database(place) as database:
        before = database.seen_places("house")
    damaged = [(1, "grid"), (2, "submaps"), (2, "seen"), (3, "points"), (3, "seen")]
    for session, part in damaged:
        sql(place, "UPDATE part SET crc32 = crc32 + 1 WHERE session_id = ? AND name = ?", session, part)
    good = tmp_path / "good.submaps"
    assert len(copy(place, good, recover=True)) == len(damaged)
    assert check(good) == ()
    with open_database(good) as database:
        assert [info.name for info in database.sessions()] == ["house", "tuesday"]
        assert_holds(database, entry)
        assert np.array_equal(database.seen_places("house").signatures, before.signatures)
        tuesday = TUESDAY
        assert_holds(database, (dataclasses.replace(tuesday[0], points=None), *tuesday[1:]))


def test_names_that_cannot_be_files(tmp_path: Path) -> None:
    with pytest.raises(NotADatabase, match="cannot be read: embedded null"):
        open_database(Path("a\0b"))
    with pytest.raises(NotADatabase, match="cannot be read: File name too long"):
        open_database(tmp_path / ("a" * 300))


def test_words_that_are_no_text_are_shown(empty: maintenance.Location) -> None:
    """As a shell or a file system of another encoding gives them."""
    session_map, signatures, origin = make_entry("friday", 5)
    label = Label(building="north\udcff", floor="\udcff")
    origin = dataclasses.replace(origin, source="fri\udcffday.mcap", label=label)
    report = ReadReport(scans_skipped={"of \udcff": 2}, warnings=("odd\udcff.pcd: empty",))
    session_map = dataclasses.replace(session_map, session="fri\udcffday", report=report)
    maintenance.store(empty, [(session_map, signatures, origin)], keep=True)
    with open_database(empty) as database:
        (info,) = database.sessions()
        assert (info.name, info.provenance.source) == (r"fri\xffday", r"fri\xffday.mcap")
        assert info.provenance.label == Label(building=r"north\xff", floor=r"\xff")
        assert info.report.scans_skipped == {r"of \xff": 2}
        assert info.report.warnings == (r"odd\xff.pcd: empty",)
        assert maintenance.check(database.location) == ()
        with pytest.raises(DatabaseError, match=r"no session|UTF-8 only"):
            database.grid("fri\udcffday")


# --- Databases with right checksums and implausible content: refused by name, whatever a row holds ---


Change = Callable[[Content], Any]


def entry(path: str, index: Any, value: Any) -> Change:
    """Change entries of the array `part.name`, counted in its flat form."""

    def change(content: Content) -> None:
        part, name = path.split(".")
        arrays = content.parts[part][1]
        arrays[name] = arrays[name].copy()
        arrays[name].reshape(-1)[index] = value

    return change


def array(path: str, value: Any) -> Change:
    """Another array."""
    part, name = path.split(".")
    return lambda content: content.parts[part][1].update({name: value})


def without(path: str) -> Change:
    part, name = path.split(".")
    return lambda content: content.parts[part][1].pop(name)


def document(path: str, value: Any) -> Change:
    """A value in the document of a part, `grid.origin_m`, or in that of the session, `info.report.lossy`."""

    def change(content: Content) -> None:
        part, *outer, last = path.split(".")
        place = content.document if part == "info" else content.parts[part][0]
        for name in outer:
            place = place[int(name) if isinstance(place, list) else name]
        place[int(last) if isinstance(place, list) else last] = value

    return change


def whole(part: str, value: Any) -> Change:
    """Another document and arrays of a part, or other bytes."""
    return lambda content: content.parts.update({part: value})


def row(**values: Any) -> Change:
    """Columns of a session's row."""
    return lambda content: content.row.update(values)


NAN, INF = float("nan"), float("inf")
READ = {"info": lambda database: database.sessions(), **READ_PART}
POSES, STEPS, FLAT = "trajectory.T_session_base", "points.steps", slice(0, 50)
CASES: list[tuple[Change, str]] = [
    (entry("trajectory.stamps_ns", 4, 5), "trajectory: the stamp after 3 is earlier"),
    (entry(POSES, 48, 1.001), "trajectory: pose 3 is not rigid"),
    (entry(POSES, 48 + 10, -1.0), "trajectory: pose 3 is not rigid"),  # a mirror
    (entry(POSES, 48 + 15, 2.0), "trajectory: pose 3 is not rigid"),
    (entry(POSES, 48 + 3, NAN), "trajectory: .* not finite"),
    (entry(POSES, 48 + 11, 1e9), "trajectory: pose 3 is more than 1e\\+08 m"),
    (array(POSES, np.zeros((6, 4, 4))), "trajectory: .*expected shape"),
    (without(POSES), "trajectory: T_session_base: Field required"),
    (array("trajectory.speed", np.zeros(7)), "trajectory: speed: Unexpected"),
    (document("trajectory.health", ["fine"] * 6 + ["gone"]), "trajectory: health.6: Input should be"),
    (document("trajectory.health", ["fine"]), "trajectory: .*expected 7 entries, got 1"),
    (document("info.scans", 8), "trajectory: 7 poses where 8 were stored"),
    (document("loops.1.newer", 7), "loops: loop 1 is not between two of 7 poses"),
    (document("loops.1.older", -1), "loops: loop 1 is not between two of 7 poses"),
    (document("loops.1.T_older_newer.yaw", NAN), "loops: 1.T_older_newer.yaw: .* finite number"),
    (document("loops.1.information", [1.0]), "loops: 1: .*expected shape"),
    (whole("loops", ({}, {})), "loops: Input should be a valid tuple"),
    (entry(STEPS, 3, -20 * 64), "points: a voxel outside 0"),
    (entry(STEPS, 0, 2**21 * 64), "points: a voxel outside 0"),
    (array(STEPS, np.zeros((40, 3), np.int32)), "points: the voxel after 0 is not after it"),
    (document("points.voxel_m", 0.0), "points: cells of 0 m"),
    (entry("points.origin_m", 2, 1e9), "points: origin 0 is more than"),
    (array("seen.signatures", np.zeros((4, 111), np.uint8)), "seen: .*expected shape"),
    (array("seen.signatures", np.zeros((3, 110), np.uint8)), "seen: signatures of 110 columns"),
    (entry("seen.place", 0, 5), "seen: viewpoints that do not belong to 3 places"),
    (document("grid.resolution_m", 1e-9), "grid: cells of 1e-09 m instead of 0.001..100"),
    (document("grid.resolution_m", 0.06), "grid: resolution_m is 0.06 where 0.05 was stored"),
    (document("grid.origin_m", [INF, 0.0]), "grid: origin_m.0: .* finite number"),
    (document("grid.origin_m", [0.0, -1e9]), "grid: corner 0 is more than"),
    (document("grid.origin_m", [0.0]), "grid: origin_m.1: Field required"),
    (document("grid.floors", 2), "grid: floors: Unexpected"),
    (entry("grid.cells", 5, 101), "grid: a cell outside -1..100"),
    (whole("grid", (None, {})), "grid: is not there"),
    (whole("grid", b"junk"), "grid: BadZipFile"),
    (entry("submaps.center_m", 3, -90.0), "submaps: submap 1 lies outside its map"),
    (entry("submaps.submap_id", 0, -1), "submaps: the number of submap 0 does not increase"),
    (entry("submaps.submap_id", 1, 0), "submaps: the number of submap 1 does not increase"),
    (entry("submaps.boundary", FLAT, 0.5), "submaps: boundary histogram 0 does not have the sum 1"),
    (entry("submaps.boundary", FLAT, [-1, 2] + 48 * [0]), "boundary histogram 0 has a negative share"),
    (entry("submaps.freespace", 0, INF), "submaps: .*not finite"),
    (array("submaps.boundary", np.eye(3, 20, dtype=np.float32)), "submaps: .* bins where its settings"),
    (document("info.submaps", 4), "submaps: 3 submaps where 4 were stored"),
    (document("info.submaps", "many"), "info: submaps: Input should be a valid integer"),
    (document("info.area_m2", NAN), "info: area_m2: .*"),
    (document("info.provenance.source", 7), "info: provenance.source: Input should be a valid string"),
    (document("info.precision.sigma_m", [0.1]), "info: precision: .*as many stamps as sigmas"),
    (document("info.mood", "fair"), "info: mood: Unexpected"),
    (document("info.name", "tuesday"), "info: filed as 'monday', '', '', but is 'tuesday'"),
    (row(name=b"\xff"), "info: filed as"),
    (row(floor="2"), "info: filed as 'monday', '', '2', but is 'monday' of no label"),
    (row(document="null"), "info: a document without content"),
    (row(document="{"), "info: Invalid JSON"),
    (row(document="[" * 100_000), "info: Invalid JSON"),
    (whole("frame", ({"name": 3}, {})), "frame: name: Input should be a valid string"),
]


@pytest.mark.parametrize(("change", "words"), CASES)
def test_what_cannot_be_true_is_refused_by_name(path: Path, change: Change, words: str) -> None:
    part = words.partition(":")[0] if ": " in words else "submaps"
    craft(path, change)
    where = "session 1" if part == "info" else f"{part} of session 'monday'"
    with open_database(path) as database:
        with pytest.raises(DatabaseCorrupt, match=words.removeprefix(f"{part}: ")) as caught:
            READ[part](database)
        assert f"damaged: {where}: " in caught.value.message
        assert "checksum" not in caught.value.message
    problems = maintenance.check(path)
    # The crafted row is all that is wrong, and costs a search the session only if that rests on it.
    assert any(problem.where == where for problem in problems), problems
    assert all("1" in problem.where or "monday" in problem.where for problem in problems), problems
    with open_database(path) as database:
        left_out = database.leave_out_damaged()
        assert [problem.where for problem in left_out] == [where] * (part in ("info", "grid", "submaps"))
        assert len(database.signatures()) == (5 if left_out else 8)


def test_rounding_is_no_lie() -> None:
    """Deviations that rounding causes are accepted."""
    rng = np.random.default_rng(2)
    turned = np.tile(np.eye(4), (3, 1, 1))
    turned[0, :3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned[0, :3, :3] *= np.sign(np.linalg.det(turned[0, :3, :3])) * (1 + 1e-6)
    three: Any = SimpleNamespace(scans=3)
    validation.check_trajectory(Trajectory(stamps_ns=np.array([5, 5, 6]), T_session_base=turned), three)
    histograms = rng.dirichlet(np.ones(80), 1000).astype(np.float32)
    histograms[7] = 0
    validation.check_histograms(histograms, "boundary")


def test_recovering_keeps_what_can_be_true(place: str | Path, tmp_path: Path) -> None:
    craft(place, document("info.submaps", None))
    target = tmp_path / "good.submaps"
    with pytest.raises(DatabaseCorrupt):
        maintenance.copy(place, target)
    assert len(maintenance.copy(place, target, recover=True)) == 1
    assert maintenance.check(target) == ()
    with open_database(target) as database:
        assert_only(database, ["tuesday"])


def test_sessions_whose_settings_differ_are_not_searched_together(path: Path) -> None:
    """Each is sound by itself; a writer would not have put them into one database."""
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    other, bins = config.model_dump(mode="json"), boundary_bins(config.partition.radius_m, config.signature)
    craft(path, document("info.provenance.config", other), session_id=2)
    craft(path, array("submaps.boundary", np.full((5, bins), 1 / bins, np.float32)), session_id=2)
    assert maintenance.check(path) == ()
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match=r"'tuesday'.* bins"):
        database.signatures()


def test_submaps_and_signatures_that_their_settings_do_not_make_are_not_stored(path: Path) -> None:
    session_map, signatures, origin = make_entry("friday", 5)
    wide = origin.config.partition.model_copy(update={"radius_m": 6.0})
    origin = replace(origin, config=origin.config.model_copy(update={"partition": wide}))
    with pytest.raises(ValueError, match="submap 0 has the radius 5 m where its settings make 6 m"):
        maintenance.store(path, [(session_map, signatures, origin)], keep=True)
    submaps = tuple(replace(submap, radius_m=6.0) for submap in session_map.submaps)
    with pytest.raises(ValueError, match=r"histograms of 50 and .* where its settings make 60"):
        maintenance.store(path, [(replace(session_map, submaps=submaps), signatures, origin)], keep=True)


# --- anything at all ----------------------------------------------------------------------------------

ODD = (-1, 0, 1, 2**31 - 1, -(2**63), 0.5, 1e308, -1e308, INF, "", "a", "\0", b"", b"\xff" * 8)


def _read_everything(path: Path) -> None:
    with open_database(path) as database:
        for info in database.sessions():
            database.grid(info.name)
            trajectory = database.trajectory(info.name)
            assert all(loop.newer < len(trajectory) for loop in database.loops(info.name))
            assert np.isfinite(trajectory.T_session_base).all()
            for submap in database.submaps(info.name):
                assert np.isfinite(submap.center_m).all() and submap.grid.cells.max() <= 100
            points = database.points(info.name)
            assert points is None or np.isfinite(points.points_m()).all()
            database.seen_places(info.name)
        table = database.signatures()
        assert np.isfinite(table.boundary).all() and (table.boundary >= 0).all()


def test_fuzz_any_value_in_any_column_with_a_right_checksum(two: bytes, path: Path) -> None:
    """Whatever a row holds: reading gives plausible content or raises DatabaseCorrupt."""
    names = [name for (name,) in sql(path, "SELECT name FROM part WHERE session_id = 1")]
    blobs = dict(sql(path, "SELECT name, data FROM part WHERE session_id = 1"))
    rng = np.random.default_rng(11)
    refused = read = 0

    def changed(data: bytes) -> bytes:
        """The same length with bytes changed."""
        found = np.frombuffer(data, np.uint8).copy()
        at = rng.integers(0, len(found), rng.integers(1, 9)) if len(found) else []
        found[at] = rng.integers(0, 256, len(at))
        return found.tobytes()

    def other(value: Any) -> Any:
        """A value with bytes changed, or any value."""
        if isinstance(value, str) and value and rng.random() < 0.7:
            return changed(value.encode()).decode("latin1")
        return ODD[rng.integers(len(ODD))]

    def odd_array(content: Content) -> None:
        """Bytes changed in an array whose own checksum is right as well."""
        arrays = content.parts[str(rng.choice(["grid", "trajectory", "points", "submaps", "seen"]))][1]
        name = str(rng.choice(sorted(arrays)))
        was = arrays[name]
        arrays[name] = np.frombuffer(changed(was.tobytes()), was.dtype).reshape(was.shape)

    def change(content: Content) -> None:
        kind = rng.random()
        if kind < 0.3:
            column = str(rng.choice(SESSION_COLUMNS[2:]))
            content.row[column] = other(content.row[column])
        elif kind < 0.5:
            name = str(rng.choice(names))
            content.parts[other(name)] = content.parts.pop(name)
        elif kind < 0.7:
            name = str(rng.choice(names))
            content.parts[name] = changed(blobs[name])
        else:
            odd_array(content)

    for _ in range(min(FUZZ, 5000) or 8):
        path.write_bytes(two)
        craft(path, change)
        try:
            _read_everything(path)
            read += 1
        except (DatabaseCorrupt, DatabaseVersion) as error:
            assert str(path) in error.message
            refused += 1
        maintenance.check(path)
    assert refused > read / 2
