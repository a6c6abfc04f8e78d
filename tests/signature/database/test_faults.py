"""Damaged, foreign and contended databases: refused by name, or searched without what is damaged."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import json
import multiprocessing
import os
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseVersion,
    NotADatabase,
    OutputError,
    Pc2GridError,
)
from pc2grid.io.nav2_map import save_map
from pc2grid.model import ReadReport
from signature.config import Config
from signature.database import Label, maintenance, open_database
from signature.database.maintenance import check, copy, merge
from signature.database.postgres import schema
from signature.database.postgres.schema import is_url
from signature.database.protocol import APPLICATION_ID
from signature.database.sqlite import atomic_update, rows
from signature.database.sqlite.atomic_update import hold, rewrite
from signature.database.sqlite.database import store
from signature.database.sqlite.schema import COLUMNS
from signature.sessions import add_session, provenance
from tests.helpers import postgresql
from tests.helpers.databases import assert_holds, make_entry
from tests.helpers.memory import bounded_memory
from tests.helpers.rooms import small_house

ROOT = Path(__file__).resolve().parents[3]
FUZZ = int(os.environ.get("PC2GRID_FUZZ", "0"))
BLOBS = {
    "grid": ["cells"],
    "trajectory": ["stamps_ns", "poses", "health"],
    "loop": ["pairs", "measured", "information", "accepted"],
    "graph": ["center_m", "kind", "pixels", "ends", "length_m", "path_start", "path_m"],
    "points": ["voxels", "within"],
    "isovist": ["ranges", "seen"],
    "submap": ["cells"],
    "signature": ["submap_id", "center_m", "boundary", "freespace", "symmetry"],
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "x.submaps"
    store(file, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return file


def pc2grid(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()", *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, timeout=120,
        env={
            **os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}", "PC2GRID_CONFIG": "",
            "PC2GRID_DEBUG": "", "OMP_NUM_THREADS": "1",
        },
    )  # fmt: skip


def read_all(file: maintenance.Place) -> dict[str, str]:
    """A digest of everything of each session."""
    digests = {}
    with open_database(file) as database:
        table = database.signatures()
        for index, info in enumerate(database.sessions()):
            digest = hashlib.sha256(repr(info).encode())
            digest.update(database.grid(info.name).cells.tobytes())
            trajectory = database.trajectory(info.name)
            digest.update(trajectory.stamps_ns.tobytes() + trajectory.T_session_base.tobytes())
            digest.update(repr(trajectory.health).encode())
            digest.update(repr(database.loops(info.name)).encode())
            digest.update(repr(database.graph(info.name).edges(data=True)).encode())
            seen = database.seen_places(info.name)
            digest.update(b"" if seen is None else seen.ranges.tobytes() + seen.signatures.tobytes())
            points = database.points(info.name)
            digest.update(b"" if points is None else points.points_m().tobytes())
            for submap in database.submaps(info.name):
                digest.update(repr((submap.submap_id, submap.center_m, submap.radius_m)).encode())
                digest.update(submap.grid.cells.tobytes())
            for field in ("boundary", "freespace", "symmetry", "submap_id", "center_m"):
                digest.update(np.ascontiguousarray(getattr(table, field)[table.session_index == index]))
            digests[info.name] = digest.hexdigest()
    return digests


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
        (lambda data: data[:-4096], DatabaseCorrupt, "truncated or damaged"),
        (lambda data: data + b"\0", DatabaseCorrupt, "truncated or damaged"),
        (lambda data: data[:4096] + bytes(len(data) - 4096), DatabaseCorrupt, "x.submaps"),
        (lambda data: data[:100] + bytes(len(data) - 100), DatabaseCorrupt, "x.submaps"),
        (lambda data: bytes(range(256)) * 64, NotADatabase, "not a pc2grid database"),
        (set_header(68, 0), NotADatabase, "another program's SQLite file (application id 0x0)"),
        (set_header(60, 6), DatabaseVersion, "database format 6; this pc2grid reads up to 5"),
        (
            set_header(60, 1),
            DatabaseCorrupt,
            "its tables are not those of format 1 ('graph', 'isovist', 'loop', 'points')",
        ),
        (
            set_header(60, 2),
            DatabaseCorrupt,
            "its tables are not those of format 2 ('graph', 'isovist', 'points')",
        ),
        (set_header(60, 2**31 - 1), DatabaseVersion, "database format 2147483647"),
        (set_header(60, 0), DatabaseCorrupt, "database format 0 never existed"),
    ],
)
def test_every_command_refuses_it_and_leaves_it(
    path: Path, tmp_path: Path, damage: Callable[[bytes], bytes], error: type[Pc2GridError], words: str
) -> None:
    content = damage(path.read_bytes())
    path.write_bytes(content)
    uses: list[Callable[[], object]] = [
        lambda: read_all(path),
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
    with pytest.raises(DatabaseCorrupt, match="its tables are not those of format 1"):
        open_database(stranger)
    with pytest.raises(DatabaseCorrupt, match="its tables are not those of format 1"):
        store(stranger, [make_entry()], keep=True)
    assert stranger.read_bytes() == before
    assert list(tmp_path.iterdir()) == [stranger]


@pytest.mark.fault(44)
def test_command_line_refuses_a_newer_format_in_one_line(path: Path) -> None:
    path.write_bytes(set_header(60, 7)(path.read_bytes()))
    done = pc2grid("db", "info", path.name, cwd=path.parent)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.splitlines() == [
        "pc2grid: error: x.submaps: database format 7; this pc2grid reads up to 5",
        "hint: use a newer pc2grid",
    ]


# --- fault 43: flipped bits ---------------------------------------------------------------------------


def flip(path: Path, table: str, column: str, position: float, bit: int, session: int = 2) -> None:
    """Flip one bit inside a blob, in the file's bytes."""
    with sqlite3.connect(path) as connection:
        query = f"SELECT rowid FROM {table} WHERE session_id = ? ORDER BY rowid DESC"
        (rowid,) = connection.execute(query, (session,)).fetchone()
        with connection.blobopen(table, column, rowid) as blob:
            at = int(position * (len(blob) - 1))
            blob[at] = blob[at] ^ (1 << bit)
    connection.close()


@pytest.mark.fault(43)
def test_fuzz_flipped_bit_anywhere_in_any_blob_is_found(path: Path) -> None:
    clean = path.read_bytes()
    rng = np.random.default_rng(43)
    for _ in range(min(FUZZ, 200) or 4):
        for table, columns in BLOBS.items():
            for column in columns:
                path.write_bytes(clean)
                flip(path, table, column, float(rng.random()), int(rng.integers(8)))
                problems = check(path)
                assert len(problems) == 1, problems
                assert problems[0].where.startswith(table)
                assert problems[0].what == "wrong checksum"
                with pytest.raises(DatabaseCorrupt, match=r"damaged: .*wrong checksum") as caught:
                    read_all(path)
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
        assert any("more rows than fit" in problem.what for problem in check(path))
        with (
            pytest.raises(DatabaseCorrupt, match="more rows than fit into the file"),
            open_database(path) as db,
        ):
            db.sessions()
        with pytest.raises(DatabaseCorrupt, match="more rows than fit into the file"):
            store(path, [make_entry("sunday", 9, submaps=1)], keep=True)
    assert path.read_bytes() == content


@pytest.mark.parametrize("table", list(COLUMNS))
def test_any_changed_value_of_any_row_is_found(path: Path, table: str) -> None:
    """Not only blobs: every number, name and document stands under the checksum."""
    clean = path.read_bytes()
    for column in COLUMNS[table]:
        path.write_bytes(clean)
        connection = sqlite3.connect(path)
        (kind,) = connection.execute(f"SELECT typeof({column}) FROM {table} LIMIT 1").fetchone()
        change = {
            "integer": f"{column} + 8",
            "real": f"{column} + 0.5",
            "text": f"{column} || ' '",
            "blob": f"zeroblob(length({column}))",
        }[kind]
        connection.execute(f"UPDATE {table} SET {column} = {change} WHERE rowid = 1")
        connection.commit()
        connection.close()
        assert any("wrong checksum" in problem.what for problem in check(path)), column
        with pytest.raises(Pc2GridError):
            read_all(path)


@pytest.mark.parametrize("table", ["session", "grid", "signature"])
@pytest.mark.parametrize("how", ["changed", "lost"])
def test_damaged_session_is_left_out_and_the_others_answer(path: Path, table: str, how: str) -> None:
    column, number = ("document", "id") if table == "session" else ("crc32", "session_id")
    connection = sqlite3.connect(path)
    if how == "changed":
        connection.execute(f"UPDATE {table} SET {column} = {column} || '1' WHERE {number} = 1")
    else:
        connection.execute(f"DELETE FROM {table} WHERE {number} = 1")
    connection.commit()
    connection.close()
    before = path.read_bytes()
    with open_database(path) as database:
        problems = database.leave_out_damaged()
        assert len(problems) == 1
        assert "1" in problems[0].where
        assert table in problems[0].where + problems[0].what
        assert ("checksum" if how == "changed" else f"no {table}") in problems[0].what
        assert_holds(database, make_entry("tuesday", 1, submaps=5))
        assert [info.name for info in database.sessions()] == ["tuesday"]
        assert set(database.signatures().session_index) == {0}
        assert database.config() == Config()
        with pytest.raises(Pc2GridError, match="no session 'monday'"):
            database.grid("monday")
    assert path.read_bytes() == before


def test_sound_database_leaves_nothing_out_and_a_wholly_damaged_one_is_refused(path: Path) -> None:
    with open_database(path) as database:
        assert database.leave_out_damaged() == ()
        assert len(database.sessions()) == 2
    for session in (1, 2):
        flip(path, "signature", "boundary", 0.5, 3, session)
    with (
        open_database(path) as database,
        pytest.raises(DatabaseCorrupt, match="signature 1: wrong checksum"),
    ):
        database.leave_out_damaged()


@pytest.mark.fault(43)
def test_relocalize_leaves_a_damaged_session_out_with_a_warning(tmp_path: Path) -> None:
    """A map is looked for in a database of itself and of a damaged neighbour."""
    from signature.sessions import build_session

    yaml, _ = save_map(small_house(), tmp_path / "house")
    config, database = Config(), tmp_path / "x.submaps"
    house, origin = build_session(yaml, "house", config)
    cellar, _ = build_session(yaml, "cellar", config)
    for session in (cellar, house):
        add_session(database, session, config, provenance(yaml, origin.digest, config))
    flip(database, "signature", "boundary", 0.3, 5, session=1)
    damaged = database.read_bytes()
    done = pc2grid("relocalize", "house.yaml", "--database", "x.submaps", "--json", cwd=tmp_path)
    answer = json.loads(done.stdout)
    assert answer["status"] == "located", answer
    assert done.returncode == 3, done.stderr
    assert answer["database"]["left_out"] == ["signature 1: wrong checksum"]
    assert "warning: x.submaps: damaged and left out: signature 1: wrong checksum" in done.stderr
    assert database.read_bytes() == damaged


# --- fault 45: many readers, two writers --------------------------------------------------------------


def _write(place: maintenance.Place, mine: str, until: float, results: Any) -> None:
    """Add sessions and replace them with others of the name, as fast as it goes; one of them both write."""
    done = busy = number = 0
    patience = {} if is_url(place) else {"timeout_s": 0.5}
    write = maintenance.store if is_url(place) else store
    while time.time() < until:
        number += 1
        name = "both" if number % 5 == 0 else f"{mine}{number % 4}"
        try:
            write(place, [make_entry(name, 100 + number % 3)], keep=True, force=True, **patience)
            done += 1
        except DatabaseBusy:
            busy += 1
    results.put(("written", done, busy))


def _read(place: maintenance.Place, known: dict[str, set[str]], until: float, results: Any) -> None:
    """Read everything repeatedly: every session is complete and equals one that was written."""
    done = 0
    while time.time() < until:
        for name, digest in read_all(place).items():
            assert digest in known[name], f"a session {name!r} that was never written"
        done += 1
    results.put(("read", done, 0))


@pytest.mark.fault(45)
@pytest.mark.parametrize("engine", ["sqlite", "postgres"])
def test_fuzz_eight_readers_and_two_writers(path: Path, engine: str, monkeypatch) -> None:
    """No error but busy, no torn read; sessions that were not changed are still there."""
    folder = path.parent
    place: maintenance.Place = path
    if engine == "postgres":
        place = postgresql.new_database()
        monkeypatch.setattr(schema, "BUSY_TIMEOUT_S", 1.0)  # whole seconds there
        maintenance.store(place, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    known: dict[str, set[str]] = {}
    for seed in (100, 101, 102):
        scratch = folder / "scratch.submaps"
        names = ["both", *(f"{writer}{i}" for writer in "ab" for i in range(4))]
        store(scratch, [make_entry(name, seed) for name in names], keep=False)
        for name, digest in read_all(scratch).items():
            known.setdefault(name, set()).add(digest)
        scratch.unlink()
    known |= {name: {digest} for name, digest in read_all(path).items()}

    context = multiprocessing.get_context("fork")  # ten interpreters would spend the time on starting
    results = context.Queue()
    until = time.time() + (60.0 if FUZZ else 2.5)
    parts = [context.Process(target=_write, args=(place, mine, until, results)) for mine in "ab"]
    parts += [context.Process(target=_read, args=(place, known, until, results)) for _ in range(8)]
    for part in parts:
        part.start()
    said = [results.get(timeout=120) for _ in parts]
    for part in parts:
        part.join(60)
    assert [part.exitcode for part in parts] == [0] * len(parts)
    written, read, busy = (
        sum(entry[field] for entry in said if entry[0] in kinds)
        for kinds, field in ((["written"], 1), (["read"], 1), (["written"], 2))
    )
    print(f"{engine}: {read} reads of everything, {written} sessions written, {busy} times busy")
    assert min(written, read) > 0
    assert maintenance.check(place) == ()
    for name, digest in read_all(place).items():
        assert digest in known[name]
    with open_database(place) as database:
        assert_holds(database, make_entry("monday", 0))
    assert list(folder.iterdir()) == [path]


def _hold_until(file: str, ready: Event, leave: Event) -> None:
    with hold(Path(file), 1.0):
        ready.set()
        leave.wait(60)


@pytest.mark.fault(45)
def test_second_writer_waits_for_the_first(path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    ready, leave = context.Event(), context.Event()
    holder = context.Process(target=_hold_until, args=(str(path.resolve()), ready, leave))
    holder.start()
    assert ready.wait(60)
    with pytest.raises(DatabaseBusy, match=f"being written by process {holder.pid} on ") as caught:
        store(path, [make_entry("friday", 5)], keep=True, timeout_s=0.1)
    assert caught.value.hint == "try again when it is done"
    leave.set()
    store(path, [make_entry("friday", 5)], keep=True, timeout_s=60)
    holder.join(60)
    with open_database(path) as database:
        assert_holds(database, make_entry("friday", 5))
    assert list(path.parent.iterdir()) == [path]


def test_adding_to_a_damaged_database_names_the_damage(path: Path) -> None:
    """A page of the tree overwritten: neither an error of SQLite's own nor a file that is worse off."""
    data = bytearray(path.read_bytes())
    refused = 0
    for page in range(4096, len(data), 4096):
        broken = data[:page] + b"\xa5" * 64 + data[page + 64 :]
        path.write_bytes(broken)
        try:
            store(path, [make_entry("tuesday", 9, submaps=5)], keep=True, force=True)
        except (DatabaseCorrupt, OutputError) as error:
            assert str(path) in error.message
            assert path.read_bytes() == broken
            refused += 1
        assert list(path.parent.iterdir()) == [path]
    assert refused > 3


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b"tablegridgrid", b"table\xffridgrid"),  # SQLite's message quotes the name
        (b"CREATE TABLE grid", b"CREATE \xffABLE grid"),
        (
            b"CREATE TABLE grid (session_id INTEGER PRIMARY",
            b"CREATE TABLE grid (s\xffssion_id INTEGER PRIMARY",
        ),
    ],
)
def test_table_definitions_that_are_no_text(path: Path, before: bytes, after: bytes) -> None:
    content = path.read_bytes()
    assert content.count(before) == 1
    content = content.replace(before, after)
    path.write_bytes(content)
    with pytest.raises(DatabaseCorrupt):
        open_database(path)
    with pytest.raises(DatabaseCorrupt):
        store(path, [make_entry("friday", 5)], keep=True)
    assert check(path) != ()
    assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path]


# --- what is lost as a whole, and what stands in a writer's way ---------------------------------------


def change(path: Path, *statements: str) -> None:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        for statement in statements:
            connection.execute(statement)
        connection.commit()


@pytest.mark.parametrize("table", ["grid", "trajectory", "loop", "graph", "points", "isovist", "signature"])
def test_a_row_that_is_gone_is_missed_by_name(path: Path, tmp_path: Path, table: str) -> None:
    change(path, f"DELETE FROM {table} WHERE session_id = 1")
    assert check(path) != ()
    uses: dict[str, Callable[[Any], object]] = {
        "grid": lambda database: database.grid("monday"),
        "trajectory": lambda database: database.trajectory("monday"),
        "loop": lambda database: database.loops("monday"),
        "graph": lambda database: database.graph("monday"),
        "points": lambda database: database.points("monday"),
        "isovist": lambda database: database.seen_places("monday"),
        "signature": lambda database: list(database.submaps("monday")),
    }
    words = rf"session 1: has no {table}" if table in ("grid", "trajectory") else "missing"
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match=words):
        database.sessions()
        uses[table](database)
    good = tmp_path / "good.submaps"
    assert copy(path, good, recover=True) != ()
    assert check(good) == ()
    with open_database(good) as database:
        names = [info.name for info in database.sessions()]
        assert names == (["monday", "tuesday"] if table in ("graph", "points", "isovist") else ["tuesday"])


def test_a_submap_too_many_or_too_few_is_found(path: Path) -> None:
    change(path, "DELETE FROM submap WHERE session_id = 2 AND submap_id = 4")
    (problem,) = check(path)
    assert problem.where == "session 'tuesday'"
    assert problem.what == "has 4 submaps and 5 signatures where 5 were stored"
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match="'tuesday': 1 missing"):
        list(database.submaps("tuesday"))


@pytest.mark.parametrize("table", ["session", "submap", "loop", "graph", "points"])
def test_merging_takes_nothing_from_a_damaged_file(path: Path, tmp_path: Path, table: str) -> None:
    other, target = tmp_path / "other.submaps", tmp_path / "target.submaps"
    store(other, [make_entry("friday", 5)], keep=False)
    change(path, f"UPDATE {table} SET crc32 = crc32 + 1 WHERE rowid = 2")
    with pytest.raises(DatabaseCorrupt, match=rf"x\.submaps: damaged: {table} .*wrong checksum"):
        merge([other, path], target)
    assert not target.exists()


def test_merging_does_not_mix_settings(path: Path, tmp_path: Path) -> None:
    other, target = tmp_path / "other.submaps", tmp_path / "target.submaps"
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    store(other, [make_entry("friday", 5, config=config)], keep=False)
    words = r"other\.submaps: sessions made with signature\.boundary_bin_m = 0\.2 and with 0\.3"
    with pytest.raises(DatabaseError, match=words):
        merge([path, other], target)
    assert not target.exists()


def test_checking_what_is_no_database_of_ours(path: Path, tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.write_text("hello")
    with pytest.raises(NotADatabase, match="not a pc2grid database"):
        check(text)
    path.write_bytes(set_header(60, 7)(path.read_bytes()))
    with pytest.raises(DatabaseVersion, match="format 7"):
        check(path)


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        ("CREATE VIEW more AS SELECT * FROM grid", "its tables are not those of format 5 ('more')"),
        ("CREATE TRIGGER t AFTER DELETE ON grid BEGIN DELETE FROM loop; END", "format 5 ('t')"),
        ("DELETE FROM session WHERE id = 2", "belongs to no session"),
    ],
)
def test_structure_that_no_row_shows(path: Path, statement: str, words: str) -> None:
    change(path, statement)
    problems = check(path)
    assert any(words in problem.what for problem in problems), problems


def test_what_is_not_worth_recovering_is_left_behind(path: Path, tmp_path: Path) -> None:
    """A damaged submap costs itself, and its signature; a damaged grid the session."""
    change(
        path,
        "UPDATE submap SET crc32 = crc32 + 1 WHERE session_id = 2 AND submap_id = 3",
        "UPDATE grid SET crc32 = crc32 + 1 WHERE session_id = 1",
    )
    good = tmp_path / "good.submaps"
    assert len(copy(path, good, recover=True)) == 2
    assert check(good) == ()
    with open_database(good) as database:
        (info,) = database.sessions()
        assert (info.name, info.submaps) == ("tuesday", 4)
        assert [submap.submap_id for submap in database.submaps("tuesday")] == [0, 1, 2, 4]
        assert database.signatures().submap_id.tolist() == [0, 1, 2, 4]
        wanted = make_entry("tuesday", 1, submaps=5)[1]
        assert np.array_equal(database.signatures().boundary[3], wanted[4].boundary)


def test_a_lock_that_its_holder_took_away_is_not_held(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between our opening the lock file and locking it, its holder removes it: another may lock a new one."""
    lock, plain, seen = path.with_name(f".{path.name}.lock"), fcntl.flock, []

    def flock(descriptor: int, how: int) -> None:
        seen.append(descriptor)
        if len(seen) <= 2:
            lock.unlink()
        if len(seen) == 2:
            lock.write_text("another one's")
        plain(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    with hold(path, 1.0):
        assert len(seen) == 3
        assert lock.read_text().startswith(f"process {os.getpid()} on ")
        monkeypatch.undo()
        with pytest.raises(DatabaseBusy), hold(path, 0.0):
            pass
    assert list(path.parent.iterdir()) == [path]


def test_a_mistake_of_the_body_stays_its_own(path: Path) -> None:
    """Not called a full disk, nor damage: there was nothing that could be damaged."""
    target, before = path.with_name("new.submaps"), psutil.Process().num_fds()
    with pytest.raises(sqlite3.IntegrityError, match="UNIQUE"), rewrite(target, keep=False) as connection:
        for number in (1, 2):
            row = {"id": number, "name": "monday", "sensor": "lidar", "document": "{}"}
            rows.insert(connection, "session", row)
    assert list(path.parent.iterdir()) == [path]
    assert psutil.Process().num_fds() == before


@pytest.mark.fault(39)
@pytest.mark.parametrize("with_code", [True, False])
def test_a_medium_that_refuses_is_told_from_damage(with_code: bool) -> None:
    """By the error code of SQLite; by its message where Python gives no code."""
    for code, message in [
        (13, "database or disk is full"),
        (10 | 3 << 8, "disk I/O error"),
        (1, "no such table"),
    ]:
        error = sqlite3.OperationalError(message)
        if with_code:
            error.sqlite_errorcode = code
        found = atomic_update._explained(error, Path("x.submaps"), kept=True)
        assert type(found) is (DatabaseCorrupt if code == 1 else OutputError), message


def test_waiting_for_another_writer_keeps_nothing_open(path: Path) -> None:
    before = psutil.Process().num_fds()
    with hold(path, 1.0):
        with pytest.raises(DatabaseBusy), hold(path, 0.2):
            pass
        assert psutil.Process().num_fds() == before + 1
    assert psutil.Process().num_fds() == before


def test_a_file_of_one_byte_is_not_overwritten(tmp_path: Path) -> None:
    file = tmp_path / "x.submaps"
    file.write_bytes(b"S")
    with pytest.raises(NotADatabase, match="not a pc2grid database"):
        store(file, [make_entry()], keep=True)
    assert file.read_bytes() == b"S"
    assert list(tmp_path.iterdir()) == [file]


def test_names_that_cannot_be_files(tmp_path: Path) -> None:
    with pytest.raises(NotADatabase, match="cannot be read: embedded null"):
        open_database(Path("a\0b"))
    with pytest.raises(NotADatabase, match="cannot be read: File name too long"):
        open_database(tmp_path / ("a" * 300))


@pytest.mark.parametrize("engine", ["sqlite", "postgres"])
def test_words_that_are_no_text_are_shown(tmp_path: Path, engine: str) -> None:
    """As a shell or a file system of another encoding gives them."""
    place: maintenance.Place = tmp_path / "x.submaps" if engine == "sqlite" else postgresql.new_database()
    session_map, signatures, origin = make_entry("friday", 5)
    label = Label(building="north\udcff", floor="\udcff")
    origin = dataclasses.replace(origin, source="fri\udcffday.mcap", label=label)
    report = ReadReport(scans_skipped={"of \udcff": 2}, warnings=("odd\udcff.pcd: empty",))
    session_map = dataclasses.replace(session_map, session="fri\udcffday", report=report)
    maintenance.store(place, [(session_map, signatures, origin)], keep=True)
    with open_database(place) as database:
        (info,) = database.sessions()
        assert (info.name, info.provenance.source) == (r"fri\xffday", r"fri\xffday.mcap")
        assert info.provenance.label == Label(building=r"north\xff", floor=r"\xff")
        assert info.report.scans_skipped == {r"of \xff": 2}
        assert info.warnings == (r"odd\xff.pcd: empty",)
        assert database.check() == ()
        with pytest.raises(DatabaseError, match=r"no session|UTF-8 only"):
            database.grid("fri\udcffday")
