"""Damaged rosbag2 .db3 files: what is whole is read, what is not is counted; and SQLite as the oracle."""

from __future__ import annotations

import dataclasses
import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pc2grid.config import ReadConfig
from pc2grid.errors import LogCorrupt, LogTruncated, Pc2GridError
from pc2grid.io import open_log
from pc2grid.io.sqlite_pages import BrokenRow, SqlitePages
from pc2grid_cli.main import main
from tests.builders import STEP, T0, check_drive, drive, read, ros, write_rosbag2

PAGE = 4096
SCANS = 60


def db3(folder: Path, points: int = 1000) -> Path:
    """Clouds of three pages each, and nothing else."""
    rng = np.random.default_rng(3)
    clouds = [ros().cloud("/points", T0 + i * STEP, rng.uniform(1, 9, (points, 3))) for i in range(SCANS)]
    return write_rosbag2(folder / "log", clouds) / "log.db3"


def essence(path: Path, *, recover: bool = True, config: ReadConfig | None = None) -> tuple[list[Any], Any]:
    config = config or ReadConfig(assume_identity=True)
    scans, report = read(path, config, recover=recover)
    return [(s.stamp_ns, s.points_m.tobytes()) for s in scans], report


def page_of(content: bytes, kind: int, number: int = 0) -> int:
    """Where a page of a kind begins; behind the small tables, which are of one page each."""
    pages = [at for at in range(5 * PAGE, len(content), PAGE) if content[at] == kind]
    return pages[number]


@pytest.mark.fault(5)
@pytest.mark.fault(7)
@pytest.mark.parametrize(
    ("damage", "gone"),
    [
        (lambda c: (page_of(c, 0x0D, 4), b"\x55" * PAGE), 7),  # the rows of a page
        (lambda c: (page_of(c, 0x0D, 4), b"\x00"), 7),  # what it says it is
        (lambda c: (page_of(c, 0x0D, -1), b"\x05"), 7),  # the same of the last
        # A page of an index in its place.
        (lambda c: (page_of(c, 0x0D, -1), c[page_of(c, 0x0A) :][:PAGE]), 7),
        (lambda c: (page_of(c, 0x0D, 4) + 4, b"\x00"), 7),  # how many rows it has
        (lambda c: (page_of(c, 0x0D, 4) + 8, b"\xff\xff"), 1),  # where the first is
        (lambda c: (page_of(c, 0x00, 20), b"\x00\x00\x00\x09"), 2),  # where a row goes on: in another's page
        (lambda c: (page_of(c, 0x00, 20), b"\x77"), 1),  # where there is no page
        (lambda c: (page_of(c, 0x05), b"\x55" * PAGE), 0),  # the tree above all rows
        (lambda c: (page_of(c, 0x0A), b"\x55" * PAGE), 0),  # the index by time
    ],
)
def test_what_is_whole_is_read(
    tmp_path: Path, damage: Callable[[bytes], tuple[int, bytes]], gone: int
) -> None:
    path = db3(tmp_path)
    clean, usual = essence(path)
    assert len(clean) == SCANS
    assert not usual.lossy
    content = bytearray(path.read_bytes())
    at, new = damage(bytes(content))
    content[at : at + len(new)] = new
    path.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"log\.db3: .*--recover reads what is whole"):
        essence(path, recover=False)
    found, report = essence(path)
    assert set(found) <= set(clean)
    assert SCANS - gone <= len(found) <= SCANS - min(gone, 1)
    assert found == [c for c in clean if c in set(found)]
    assert report.lossy
    assert path.read_bytes() == content


@pytest.mark.fault(5)
def test_a_db3_that_ends_too_early(tmp_path: Path) -> None:
    path = db3(tmp_path)
    whole = path.read_bytes()
    clean, _ = essence(path)
    last = SCANS
    for size in range(len(whole) - 1, 12 * PAGE, -len(whole) // 7):
        path.write_bytes(whole[:size])
        with pytest.raises(LogTruncated, match=r"log\.db3: ends after \d+ of \d+ bytes .*--recover"):
            essence(path, recover=False)
        found, report = essence(path)
        assert found == clean[: len(found)]
        assert 0 < len(found) <= last
        missing = len(whole) - size // PAGE * PAGE
        assert report.bytes_lost >= missing
        assert f"{missing} bytes at the end of the .db3 are missing" in report.warnings
        last = len(found)
    assert last < SCANS / 3


@pytest.mark.fault(5)
def test_the_command_recovers_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_rosbag2(tmp_path / "log", drive(scans=60)) / "log.db3"
    content = path.read_bytes()
    path.write_bytes(content[: 2 * len(content) // 3])
    database = tmp_path / "x.submaps"

    def convert(*more: str) -> tuple[int | str | None, str]:
        monkeypatch.setattr(sys, "argv", ["pc2grid", "convert", str(path), "-o", str(database), *more])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capfd.readouterr().err

    code, said = convert()
    assert code == 1
    assert "--recover reads what is whole" in said
    assert not database.exists()
    code, said = convert("--recover")
    assert code == 3
    assert "bytes unreadable" in said
    assert database.exists()


def test_recovering_a_sound_file_is_reading_it(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("DELETE FROM messages WHERE id > 1 AND id % 3 = 0")  # cut by hand: no loss
    _, usual = read(path)
    _, report = read(path, recover=True)
    assert report == usual
    assert not report.lossy


def test_messages_compressed_one_by_one_are_recovered(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "log", drive(), "sqlite3", "message")
    path = folder / "log.db3"
    path.write_bytes(path.read_bytes() + b"left over")
    with path.open("r+b") as file:
        file.seek(page_of(path.read_bytes(), 0x0A))
        file.write(b"\x55" * PAGE)
    scans, report = read(path, recover=True)
    check_drive(scans)
    assert report.bytes_lost == PAGE + len(b"left over")


def test_what_is_salvaged_is_described_as_ever(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    with open_log(path) as log:
        clean = log.info
        part = [s.stamp_ns for s in log.scans(0.3, 0.4)]
    with path.open("r+b") as file:
        file.seek(page_of(path.read_bytes(), 0x0A))
        file.write(b"\x55" * PAGE)
    with open_log(path, recover=True) as log:
        assert dataclasses.replace(log.info, warnings=()) == dataclasses.replace(clean, warnings=())
        assert all(topic.schema for topic in log.info.topics)
        assert [s.stamp_ns for s in log.scans(0.3, 0.4)] == part
        check_drive(list(log.scans()))
    path.write_bytes(path.read_bytes()[: 2 * PAGE])  # nothing of it is left but its name
    with open_log(path, recover=True) as log:
        assert (log.info.start_ns, log.info.end_ns, log.info.message_count) == (0, 0, 0)
        assert log.info.topics == ()
        assert log.report().bytes_lost == 8 * PAGE


def test_a_list_of_free_pages_without_end(tmp_path: Path) -> None:
    path = db3(tmp_path)
    clean, _ = essence(path)
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("CREATE TABLE extra(data)")
        db.execute("INSERT INTO extra VALUES (zeroblob(100000))")
        db.execute("DROP TABLE extra")
    content = bytearray(path.read_bytes())
    trunk = int.from_bytes(content[32:36], "big")
    assert trunk > 0
    at = (trunk - 1) * PAGE
    content[at : at + 8] = trunk.to_bytes(4, "big") + b"\xff" * 4  # the next one is itself
    path.write_bytes(content)
    found, report = essence(path)
    assert found == clean
    assert not report.lossy


def test_an_index_that_misses_messages_is_noticed(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    content = bytearray(path.read_bytes())
    at = page_of(bytes(content), 0x0A)
    assert content[at + 4] == 25
    content[at + 4] = 20
    path.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"index of times disagree .*--recover"):
        read(path)
    check_drive(read(path, recover=True)[0])


def test_a_topic_that_is_lost(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    content = bytearray(path.read_bytes())
    at = 3 * PAGE
    cell = at + int.from_bytes(content[at + 10 : at + 12], "big")
    assert b"/odom" in content[cell : cell + 20]
    content[cell + 1] = 40  # topic 2 is now 40
    path.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"messages, topics and index .*--recover"):
        read(path)
    with open_log(path, recover=True) as log:
        assert "12 messages are of a topic that is lost" in log.report().warnings
        assert log.report().lossy
        assert log.info.message_count == 13
        assert {t.topic: t.message_count for t in log.info.topics}["/points"] == 12


def test_a_number_that_makes_no_sense_is_no_million_of_lost_messages(tmp_path: Path) -> None:
    path = db3(tmp_path, points=4)
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("UPDATE messages SET id = 1 << 60 WHERE id = 60")
    path.write_bytes(path.read_bytes() + bytes(PAGE))  # pages that the file does not know of
    with path.open("r+b") as file:
        file.seek(page_of(path.read_bytes(), 0x0A))
        file.write(b"\x55" * PAGE)
    found, report = essence(path)
    assert len(found) == SCANS
    assert report.bytes_lost == 2 * PAGE
    assert not any("messages" in w for w in report.warnings)


def test_a_message_above_the_limit_is_lost(tmp_path: Path) -> None:
    clouds = [ros().cloud("/points", T0 + i * STEP, np.ones((900 if i == 4 else 9, 3))) for i in range(SCANS)]
    path = write_rosbag2(tmp_path / "log", clouds) / "log.db3"
    with path.open("r+b") as file:
        file.seek(page_of(path.read_bytes(), 0x0A))
        file.write(b"\x55" * PAGE)
    assert len(essence(path)[0]) == SCANS
    found, report = essence(path, config=ReadConfig(assume_identity=True, max_record_bytes=5000))
    assert [len(points) // 12 for _, points in found] == [9] * (SCANS - 1)
    assert any("a row of 109" in w and "the limit is 5000" in w for w in report.warnings)


def test_a_header_that_is_damaged(tmp_path: Path) -> None:
    path = db3(tmp_path)
    with path.open("r+b") as file:
        file.seek(16)
        file.write(b"\x00\x03")
    for recover in (False, True):
        with pytest.raises(LogCorrupt, match=r"log\.db3: a damaged \.db3"):
            essence(path, recover=recover)


# --- recorders that were killed -----------------------------------------------------------------------


def killed(folder: Path, commits: int) -> Path:
    """A .db3 whose last messages are in its write-ahead log, committed in so many steps."""
    source = write_rosbag2(folder / "log", drive()) / "log.db3"
    with closing(sqlite3.connect(source)) as db:
        db.execute("PRAGMA journal_mode=WAL")
        rows = db.execute("SELECT * FROM messages WHERE id > 5").fetchall()
        db.execute("DELETE FROM messages WHERE id > 5")
        db.commit()
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.execute("PRAGMA wal_autocheckpoint=0")
        size = -(-len(rows) // commits)
        for first in range(0, len(rows), size):
            db.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[first : first + size])
            db.commit()
        for name in ("log.db3", "log.db3-wal"):
            shutil.copy(source.with_name(name), folder / name)
    assert (folder / "log.db3-wal").stat().st_size > PAGE
    return folder / "log.db3"


@pytest.mark.fault(6)
def test_what_the_recorder_left_in_the_log_is_read(tmp_path: Path) -> None:
    path = killed(tmp_path, 1)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
    for recover in (False, True):
        scans, report = read(path, recover=recover)
        check_drive(scans)
        assert not report.lossy
        assert any("did not close the file" in w for w in report.warnings)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == before


@pytest.mark.fault(6)
def test_of_the_log_only_what_was_committed_counts(tmp_path: Path) -> None:
    path = killed(tmp_path, 4)
    wal = path.with_name("log.db3-wal")
    content = bytearray(wal.read_bytes())
    content[-100] ^= 1  # in the last commit
    wal.write_bytes(content)
    with closing(sqlite3.connect(path)) as db:  # SQLite's own recovery, which needs to write
        expected = db.execute("SELECT timestamp FROM messages ORDER BY timestamp, id").fetchall()
        wal.write_bytes(content)
    assert 5 < len(expected) < 25
    path = killed(tmp_path / "again", 4)
    path.with_name("log.db3-wal").write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"bytes of the -wal are damaged .*--recover"):
        read(path)
    with open_log(path, recover=True) as log:
        assert log.info.message_count == len(expected)
        assert log.report().bytes_lost > PAGE
    path.with_name("log.db3-wal").write_bytes(content[:-100])  # never written to its end: no damage
    with open_log(path) as log:
        assert log.info.message_count == len(expected)
        assert not log.report().lossy


def test_a_log_of_another_file_is_not_read(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    for content in (b"junk", bytes(5000), b"\x37\x7f\x06\x82" + bytes(5000)):
        path.with_name("log.db3-wal").write_bytes(content)
        scans, report = read(path)
        check_drive(scans)
        assert "nothing in the -wal beside it belongs to the file" in report.warnings


@pytest.mark.parametrize("at", [5, 14, 17, 25])
def test_a_log_whose_beginning_is_damaged(tmp_path: Path, at: int) -> None:
    path = killed(tmp_path, 1)
    wal = path.with_name("log.db3-wal")
    content = bytearray(wal.read_bytes())
    content[at] ^= 4
    wal.write_bytes(content)
    with pytest.raises(LogCorrupt, match=rf"{len(content)} bytes of the -wal are damaged .*--recover"):
        read(path)
    with open_log(path, recover=True) as log:
        assert log.info.message_count == 5
        assert log.report().bytes_lost == len(content)


def test_damage_beside_a_log_is_not_passed_over(tmp_path: Path) -> None:
    path = killed(tmp_path, 1)
    content = bytearray(path.read_bytes())
    content[-PAGE:] = b"\x55" * PAGE
    path.write_bytes(content + content[-PAGE:])
    with pytest.raises(LogCorrupt, match=r"log\.db3: a damaged .*--recover"):
        read(path)


# --- SQLite as the oracle -----------------------------------------------------------------------------

VALUES = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0, 1, -1, 127, -128, 2**23, -(2**23) - 1, 2**47, -(2**31)]),
    st.floats(allow_nan=False),
    st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=40),
    st.binary(max_size=40),
    st.integers(0, 9000).map(lambda n: bytes(range(256)) * (n // 256) + bytes(n % 256)),
)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(st.tuples(VALUES, VALUES), max_size=30),
    page_bytes=st.sampled_from([512, 1024, 4096, 65536]),
    shrinks=st.booleans(),
    kept=st.integers(1, 5),
)
def test_rows_are_those_that_sqlite_reads(
    tmp_path: Path, rows: list[tuple[Any, Any]], page_bytes: int, shrinks: bool, kept: int
) -> None:
    path = tmp_path / "x.db"
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path)) as db:
        db.execute(f"PRAGMA page_size={page_bytes}")
        db.execute(f"PRAGMA auto_vacuum={int(shrinks)}")
        db.execute("CREATE TABLE rows(id INTEGER PRIMARY KEY, a, b)")
        db.executemany("INSERT INTO rows(a, b) VALUES (?, ?)", rows)
        db.execute("DELETE FROM rows WHERE id % 6 >= ?", (kept,))
        db.commit()
        expected = db.execute("SELECT id, a, b FROM rows").fetchall()
    pages = SqlitePages(path, 1 << 30)
    found = [pages.take(place) for place in pages.places()]
    assert sorted((row.rowid, *row.values[1:]) for row in found) == expected
    assert all(row.values[0] is None for row in found)
    assert pages.unused() == 0
    assert pages.bytes_missing == 0
    pages.close()


def test_numbers_of_rows_of_every_length(tmp_path: Path) -> None:
    numbers = sorted(
        {sign * (1 << bits) + more for bits in range(0, 63, 7) for sign in (1, -1) for more in (-1, 0)}
    )
    numbers += [-(2**63), 2**63 - 1]
    path = tmp_path / "x.db"
    with closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE rows(id INTEGER PRIMARY KEY, a)")
        db.executemany("INSERT INTO rows VALUES (?, ?)", [(n, str(n)) for n in numbers])
        db.commit()
    pages = SqlitePages(path, 1 << 30)
    found = [pages.take(place) for place in pages.places()]
    assert sorted(row.rowid for row in found) == sorted(numbers)
    assert all(row.values[1] == str(row.rowid) for row in found)
    pages.close()


@pytest.mark.parametrize("page_bytes", [512, 4096])
def test_of_an_index_no_page_is_missed(tmp_path: Path, page_bytes: int) -> None:
    path = tmp_path / "x.db"
    with closing(sqlite3.connect(path)) as db:
        db.execute(f"PRAGMA page_size={page_bytes}")
        db.execute("CREATE TABLE rows(id INTEGER PRIMARY KEY, time INTEGER)")
        db.execute("CREATE INDEX times ON rows(time)")
        db.executemany("INSERT INTO rows(time) VALUES (?)", [(T0 + i * STEP,) for i in range(3000)])
        db.commit()
    content = path.read_bytes()
    kinds = {content[at] for at in range(page_bytes, len(content), page_bytes)}
    assert kinds == {0x02, 0x05, 0x0A, 0x0D}
    pages = SqlitePages(path, 1 << 30)
    assert [pages.take(place).values[1] for place in pages.places()] == [T0 + i * STEP for i in range(3000)]
    assert pages.unused() == 0
    pages.close()


@pytest.mark.parametrize(
    ("size", "ahead", "new", "words"),
    [
        (20, 5, bytes([23 + 20]), "leaves its page"),
        (20, 3, bytes([24]), "head of a row is longer"),
        (20, 1, bytes([12 + 2 * 19]), "not as long as its columns"),
        (20, 1, bytes([12 + 2 * 21]), "shorter than its columns"),
        (3000, 7, b"\x93\x40", "longer than it says"),  # 2496 of 3004 bytes: a page less
    ],
)
def test_what_is_broken_in_a_row_is_said(
    tmp_path: Path, size: int, ahead: int, new: bytes, words: str
) -> None:
    path = tmp_path / "x.db"
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA page_size=512")
        db.execute("CREATE TABLE rows(id INTEGER PRIMARY KEY, a)")
        db.execute("INSERT INTO rows(a) VALUES (?)", (b"x" * size,))
        db.commit()
    content = bytearray(path.read_bytes())
    at = content.index(b"x" * 20) - ahead  # in front: bytes and number of the row, and its head
    content[at : at + len(new)] = new
    path.write_bytes(content)
    pages = SqlitePages(path, 1 << 30)
    with pytest.raises(BrokenRow, match=words):
        pages.row(next(pages.places()))
    pages.close()


def test_the_page_that_locks_stand_on_is_not_missed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite never uses the page with the byte 2^30."""
    path = tmp_path / "x.db"
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA page_size=65536")
        db.execute("CREATE TABLE rows(id INTEGER PRIMARY KEY, a)")
        db.commit()
    with path.open("r+b") as stream:
        stream.truncate((1 << 30) + 3 * 65536)  # the disk keeps no page of zeros
    pages, looked = SqlitePages(path, 1 << 30), list[int]()
    begin, read_page = pages.count - 5, pages._page

    def page(number: int) -> bytes:
        looked.append(number)
        return read_page(number) if number <= 2 or number > begin else b"\x0a" * 8

    monkeypatch.setattr(pages, "_page", page)
    assert pages.unused() == 4
    assert set(range(2, pages.count + 1)) - set(looked) == {(1 << 30) // 65536 + 1}
    pages.close()


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_no_bytes_make_it_stumble(tmp_path: Path, data: st.DataObject) -> None:
    """Any damage is a broken row, or another row, but never another exception."""
    path = tmp_path / "x.db"
    if not path.exists():
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA page_size=512")
            db.execute("CREATE TABLE rows(id INTEGER PRIMARY KEY, a, b)")
            db.executemany(
                "INSERT INTO rows(a, b) VALUES (?, ?)", [(i * 7**i, bytes(90 * i)) for i in range(20)]
            )
            db.execute("DELETE FROM rows WHERE id > 15")
            db.commit()
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    damaged = tmp_path / "damaged.db"
    damaged.write_bytes(content[: data.draw(st.integers(100, len(content)))])
    try:
        pages = SqlitePages(damaged, 1 << 30)
    except ValueError:
        return
    for place in pages.places():
        try:
            pages.take(place)
        except BrokenRow as error:
            assert str(error)
    assert 0 <= pages.unused() <= pages.count
    pages.close()


def test_junk_behind_the_magic_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    path.write_bytes(b"SQLite format 3\0" + bytes(range(1, 256)) * 40)
    with pytest.raises(Pc2GridError, match=r"x\.db3"):
        read(path, recover=True)
