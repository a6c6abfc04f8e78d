"""A PostgreSQL server as database: access, many clients at once, damage, and a server that is killed.

What it shares with other engines is in test_database.py.
"""

import functools
import multiprocessing
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseUnreachable,
    DatabaseVersion,
    NotADatabase,
    OutputError,
    Pc2GridError,
)
from signature.config import Config
from signature.database import maintenance, open_database, postgres
from signature.database.maintenance import store
from tests.helpers import postgresql
from tests.helpers.databases import MONDAY, assert_holds, everything, make_entry, sql
from tests.helpers.postgresql import with_user

# --- who may come in ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "error", "words"),
    [
        ("postgresql://robot:s3cret@127.0.0.1:1/db", DatabaseUnreachable, "refused"),
        ("postgresql://robot:s3cret@nowhere.invalid/db", DatabaseUnreachable, "nowhere.invalid"),
        ("postgresql://robot:s3c@ret@127.0.0.1/db", DatabaseError, "@"),
        ("postgresql://robot:s3/cr@et@127.0.0.1/db", DatabaseError, "@"),
        ("postgresql://robot:s3/cret@127.0.0.1/db", DatabaseError, "@"),
        ("postgresql://robot:s3cret@127.0.0.1/db?s3cret=%zz", DatabaseError, "not a PostgreSQL URL"),
        ("postgresql://robot@127.0.0.1:1/db?password=s3cret", DatabaseUnreachable, "refused"),
    ],
)
def test_wrong_urls_are_one_line_without_the_password(bad: str, error: type, words: str) -> None:
    pytest.importorskip("psycopg")
    for attempt in (open_database, maintenance.exists, maintenance.check):
        with pytest.raises(error, match=words) as caught:
            attempt(bad)
        assert "\n" not in str(caught.value)
        for part in ("s3cret", "s3c", "ret@", "cret"):
            assert part not in str(caught.value)


def test_location_is_a_url_without_secrets(url: str) -> None:
    shown = postgres.location("postgresql://robot:pa%40ss@host:5433/db?sslpassword=x&options=-cx%3D1")
    assert shown == "postgresql://robot@host:5433/db"
    with open_database(url) as database, open_database(database.location) as again:
        assert again.sessions() == database.sessions()


def test_wrong_password_user_and_database(url: str) -> None:
    running = postgresql.server()
    with postgresql.connect(url) as connection:
        connection.execute("CREATE ROLE robot LOGIN PASSWORD 'right'")
        rules = running.data / "pg_hba.conf"
        rules.write_text("local all robot scram-sha-256\n" + rules.read_text())
        connection.execute("SELECT pg_reload_conf()")
    with pytest.raises(DatabaseUnreachable, match="user or password is not accepted") as caught:
        _eventually(lambda: open_database(with_user(url, "robot", "wr0ng")))
    assert "wr0ng" not in str(caught.value)
    assert "PGPASSWORD" in str(caught.value)
    with pytest.raises(DatabaseError, match="permission denied") as caught:
        open_database(with_user(url, "robot", "right"))
    with pytest.raises(DatabaseUnreachable, match="ghost"):
        open_database(with_user(url, "ghost", ""))
    with pytest.raises(NotADatabase, match="does not exist") as caught:
        open_database(running.url("none"))
    assert "createdb none" in str(caught.value)


def _eventually(attempt) -> None:
    """Settings are reloaded a moment later."""
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        try:
            attempt().close()
        except Pc2GridError as error:
            if "permission" not in str(error):
                raise
        time.sleep(0.02)


@pytest.mark.fault(44)
@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ("UPDATE about SET format = 99", DatabaseVersion, r"format 99; .* reads format 1 \(use a newer"),
        ("UPDATE about SET format = 0", DatabaseVersion, r"format 0; .*\(convert the recordings again"),
        ("DELETE FROM about", DatabaseCorrupt, r"pc2grid\.about has 0 rows instead of one"),
    ],
)
def test_schema_of_another_version(url: str, change: str, error: type[DatabaseError], words: str) -> None:
    sql(url, change)
    add = functools.partial(store, entries=[make_entry("friday", 5)], keep=True)
    for attempt in (open_database, maintenance.check, add):
        with pytest.raises(error, match=words):
            attempt(url)


def test_tables_that_are_not_ours(url: str) -> None:
    sql(url, "ALTER TABLE part RENAME COLUMN data TO content")
    with open_database(url) as database, pytest.raises(DatabaseCorrupt, match="not those of format 1"):
        database.loops("monday")


def test_a_server_that_takes_no_changes(url: str) -> None:
    """A replica, or one whose administrator has set it so."""
    name = url.rpartition("/fleet")[2].partition("?")[0]
    sql(url, f"ALTER DATABASE fleet{name} SET default_transaction_read_only = on")
    with pytest.raises(OutputError, match=r"cannot write: cannot execute .* in a read-only transaction"):
        store(url, [make_entry("friday", 5)], keep=True)
    with open_database(url) as database:
        assert_holds(database, MONDAY)


def test_a_user_who_may_not_make_tables() -> None:
    url = postgresql.new_database()
    sql(url, "CREATE ROLE guest LOGIN")
    with pytest.raises(DatabaseError, match="permission denied for database") as caught:
        store(with_user(url, "guest", ""), [], keep=True)
    assert "ask an administrator" in str(caught.value)


def test_without_the_extra_it_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['psycopg'] = None\n"
        "from signature.database import open_database\n"
        "open_database('postgresql://host/db')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "DatabaseError" in done.stderr
    assert "pip install 'psycopg[binary]'" in done.stderr


def test_rights_that_a_robot_needs(url: str) -> None:
    """Those that examples/buildings.md names, and no others."""
    with postgresql.connect(url) as connection:
        for role, tables in (("writer", "SELECT, INSERT, DELETE"), ("viewer", "SELECT")):
            connection.execute(f"CREATE ROLE {role} LOGIN")
            connection.execute(f"GRANT USAGE ON SCHEMA pc2grid TO {role}")
            connection.execute(f"GRANT {tables} ON ALL TABLES IN SCHEMA pc2grid TO {role}")
        connection.execute("GRANT UPDATE ON pc2grid.about, pc2grid.session TO writer")
        connection.execute("GRANT USAGE ON SEQUENCE pc2grid.session_id TO writer")
    writer, viewer = (with_user(url, role, "") for role in ("writer", "viewer"))
    store(writer, [make_entry("friday", 5)], keep=True)
    store(writer, [make_entry("friday", 6)], keep=True, overwrite=True)
    with pytest.raises(DatabaseError, match="permission denied"):
        store(viewer, [make_entry("sunday", 7)], keep=True)
    with open_database(viewer) as database:
        assert_holds(database, make_entry("friday", 6))
        assert len(database.sessions()) == 3


# --- many at once -------------------------------------------------------------------------------------


def at_once(act: Callable[[Any], None], of: Iterable[Any]) -> None:
    """Each in a thread of its own."""
    threads = [threading.Thread(target=act, args=(one,)) for one in of]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_robots_that_write_and_read_at_once() -> None:
    """The tables do not exist at first. All writers store one common session; the other sessions differ."""
    url, wrong = postgresql.new_database(), list[str]()

    def robot(number: int) -> None:
        try:
            for i in range(3):
                store(url, [make_entry(f"robot {number} day {i}", 10 * number + i)], keep=True)
                store(url, [make_entry("lobby", 77)], keep=True)
                with open_database(url) as database:
                    counts = [info.submaps for info in database.sessions()]
                    assert len(database.signatures()) == sum(counts)
                    assert_holds(database, make_entry(f"robot {number} day {i}", 10 * number + i))
        except BaseException as error:
            wrong.append(repr(error))
            raise

    at_once(robot, range(6))
    assert wrong == []
    with open_database(url) as database:
        assert len(database.sessions()) == 6 * 3 + 1
        assert maintenance.check(database.location) == ()


def test_first_two_with_different_settings_do_not_both_win() -> None:
    url = postgresql.new_database()
    entries = [
        make_entry(f"s{bin_m}", 1, config=Config.model_validate({"signature": {"boundary_bin_m": bin_m}}))
        for bin_m in (0.2, 0.3, 0.4)
    ]
    results: list[object] = []

    def add(entry) -> None:
        try:
            store(url, [entry], keep=True)
            results.append("stored")
        except DatabaseError as error:
            results.append(str(error))

    at_once(add, entries)
    assert results.count("stored") == 1, results
    assert sum("cannot be compared" in str(result) for result in results) == 2, results


def test_writer_that_waits_too_long_is_told(url: str, monkeypatch) -> None:
    monkeypatch.setattr(postgres, "BUSY_TIMEOUT_S", 1.0)
    with postgresql.connect(url) as other, other.transaction():
        other.execute("SELECT 1 FROM pc2grid.about FOR UPDATE")
        with pytest.raises(DatabaseBusy, match="lock timeout"):
            store(url, [make_entry("friday", 5)], keep=True)


# --- a server that goes away --------------------------------------------------------------------------


def test_connection_cut_in_the_middle_of_storing_leaves_what_was_there(url: str) -> None:
    before = everything(url)

    def entries():
        yield make_entry("wednesday", 2)
        with postgresql.connect(url) as connection:
            connection.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
                " WHERE datname = current_database() AND pid <> pg_backend_pid()"
            )
        yield make_entry("thursday", 3)

    with pytest.raises(DatabaseUnreachable, match="server went away") as caught:
        store(url, entries(), keep=True)
    assert "try again" in str(caught.value)
    assert everything(url) == before


def _write_for_ever(url: str, queue) -> None:
    for i in range(1000):
        try:
            store(url, [make_entry(f"day {i}", i)], keep=True)
        except Pc2GridError as error:
            queue.put(type(error).__name__)
            return
        queue.put(i)


def test_killed_server_loses_nothing_that_was_stored(url: str) -> None:
    running = postgresql.server()
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    writer = context.Process(target=_write_for_ever, args=(url, queue))
    writer.start()
    stored = [queue.get(timeout=60) for _ in range(4)]
    with open_database(url) as reader:
        running.kill()
        with pytest.raises(DatabaseUnreachable, match="server went away"):
            reader.sessions()
    with pytest.raises(DatabaseUnreachable):
        open_database(url)
    running.start()
    writer.join(60)
    while not isinstance(stored[-1], str):
        stored.append(queue.get(timeout=10))
    assert stored.pop() == "DatabaseUnreachable"
    with open_database(url) as database:
        names = [info.name for info in database.sessions()]
        # One more than it was told of may have been stored: the answer got lost, not the session.
        assert names[: 2 + len(stored)] == ["monday", "tuesday", *(f"day {i}" for i in stored)]
        assert maintenance.check(database.location) == ()
