"""A PostgreSQL server as database: access, many clients at once, damage, and a server that is killed.

What it shares with other engines is in test_database.py.
"""

from __future__ import annotations

import multiprocessing
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import (
    DatabaseBusy,
    DatabaseCorrupt,
    DatabaseError,
    DatabaseUnreachable,
    DatabaseVersion,
    NotADatabase,
    Pc2GridError,
)
from signature.config import Config
from signature.database import create_database, maintenance, open_database
from signature.database.maintenance import store
from signature.database.nearest_rows import embedding
from signature.database.postgres import schema
from tests.helpers import postgresql
from tests.helpers.databases import (
    assert_holds,
    everything,
    make_entry,
    with_graph_of_grid,
    without_loops,
    without_points,
)
from tests.helpers.postgresql import with_user


@pytest.fixture
def url() -> str:
    return postgresql.new_database()


@pytest.fixture
def filled(url: str) -> str:
    store(url, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return url


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
    for attempt in (open_database, create_database, maintenance.check):
        with pytest.raises(error, match=words) as caught:
            attempt(bad)
        assert "\n" not in str(caught.value)
        for part in ("s3cret", "s3c", "ret@", "cret"):
            assert part not in str(caught.value)


def test_location_is_a_url_without_secrets(filled: str) -> None:
    shown = schema.location("postgresql://robot:pa%40ss@host:5433/db?sslpassword=x&options=-cx%3D1")
    assert shown == "postgresql://robot@host:5433/db"
    with open_database(filled) as database, open_database(database.location) as again:
        assert again.sessions() == database.sessions()


def test_wrong_password_user_and_database(filled: str) -> None:
    server = postgresql.server()
    with postgresql.connect(filled) as connection:
        connection.execute("CREATE ROLE robot LOGIN PASSWORD 'right'")
        rules = server.data / "pg_hba.conf"
        rules.write_text("local all robot scram-sha-256\n" + rules.read_text())
        connection.execute("SELECT pg_reload_conf()")
    with pytest.raises(DatabaseUnreachable, match="user or password is not accepted") as caught:
        _eventually(lambda: open_database(with_user(filled, "robot", "wr0ng")))
    assert "wr0ng" not in str(caught.value)
    assert "PGPASSWORD" in str(caught.value)
    with pytest.raises(DatabaseError, match="permission denied") as caught:
        open_database(with_user(filled, "robot", "right"))
    with pytest.raises(DatabaseUnreachable, match="ghost"):
        open_database(with_user(filled, "ghost", ""))
    with pytest.raises(NotADatabase, match="does not exist") as caught:
        open_database(server.url("none"))
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


def test_server_without_pgvector(url: str, monkeypatch) -> None:
    """Its files are looked for where they would be; there, not found."""
    store(url, [make_entry()], keep=False)
    with postgresql.connect(url) as connection:
        connection.execute("DROP EXTENSION vector CASCADE")
    with pytest.raises(DatabaseError, match="no pgvector extension") as caught:
        open_database(url)
    assert "CREATE EXTENSION vector" in str(caught.value)
    empty = postgresql.new_database()
    with postgresql.connect(empty) as connection:
        connection.execute("ALTER ROLE postgres SET extension_control_path = '/nonexistent'")
    try:
        with pytest.raises(DatabaseError, match="no pgvector extension"):
            create_database(empty)
    finally:
        with postgresql.connect(empty) as connection:
            connection.execute("ALTER ROLE postgres RESET extension_control_path")
    with postgresql.connect(empty) as connection:
        assert connection.execute("SELECT to_regnamespace('pc2grid')").fetchone() == (None,)


@pytest.mark.parametrize(
    ("number", "error", "words"),
    [
        (99, DatabaseVersion, r"format 99; this pc2grid reads up to 5 \(use a newer"),
        (0, DatabaseCorrupt, "never existed"),
    ],
)
def test_schema_of_another_version(filled: str, number: int, error: type[DatabaseError], words: str) -> None:
    with postgresql.connect(filled) as connection:
        connection.execute("UPDATE pc2grid.about SET format = %s", [number])
    for attempt in (open_database, lambda u: store(u, [make_entry("friday", 5)], keep=True)):
        with pytest.raises(error, match=words):
            attempt(filled)


@pytest.mark.fault(44)
@pytest.mark.parametrize(
    ("version", "since"),
    [
        (1, ["loop", "graph", "points", "isovist"]),
        (2, ["graph", "points", "isovist"]),
        (3, ["points", "isovist"]),
        (4, ["isovist"]),
    ],
)
def test_a_database_of_an_older_format_is_read_as_it_is_and_migrated_when_written(
    url: str, version: int, since: list[str]
) -> None:
    plain = [
        without_points(with_graph_of_grid(make_entry(name, seed)))
        for seed, name in enumerate(("monday", "tuesday"))
    ]
    if "loop" in since:
        plain = [without_loops(entry) for entry in plain]
    store(url, plain, keep=False)
    with postgresql.connect(url) as connection:  # what the format was
        for table in since:
            connection.execute(f"DROP TABLE pc2grid.{table}")
        connection.execute("UPDATE pc2grid.about SET format = %s", [version])
    with open_database(url) as early:
        for entry in plain:
            assert_holds(early, entry)
        assert early.check() == ()
        store(url, [make_entry("friday", 5)], keep=True)
        assert len(early.loops("monday")) == len(plain[0][0].loops)
        assert early.check() == ()
    with open_database(url) as late, postgresql.connect(url) as connection:
        assert connection.execute("SELECT format FROM pc2grid.about").fetchone() == (5,)
        for entry in (*plain, make_entry("friday", 5)):
            assert_holds(late, entry)
        assert late.check() == ()
        connection.execute(f"DELETE FROM pc2grid.{since[0]} WHERE session_id = 1")
    with open_database(url) as short:
        (problem,) = short.check()
        assert (problem.where, problem.what) == ("session 1", f"has no {since[0]}")


def test_old_pgvector_is_named(filled: str) -> None:
    with postgresql.connect(filled) as connection:
        connection.execute("UPDATE pg_extension SET extversion = '0.7.4' WHERE extname = 'vector'")
    with pytest.raises(DatabaseError, match=r"pgvector 0\.7\.4; needed is 0\.8 or newer"):
        open_database(filled)


def test_without_the_extra_it_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['psycopg'] = None\n"
        "from signature.database import open_database\n"
        "open_database('postgresql://host/db')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "DatabaseError" in done.stderr
    assert "pip install 'psycopg[binary]' pgvector" in done.stderr


def test_rights_that_a_robot_needs(filled: str) -> None:
    """Those that examples/fleet.md names, and no others."""
    with postgresql.connect(filled) as connection:
        for role, tables in (("writer", "SELECT, INSERT, DELETE"), ("viewer", "SELECT")):
            connection.execute(f"CREATE ROLE {role} LOGIN")
            connection.execute(f"GRANT USAGE ON SCHEMA pc2grid TO {role}")
            connection.execute(f"GRANT {tables} ON ALL TABLES IN SCHEMA pc2grid TO {role}")
        connection.execute("GRANT UPDATE ON pc2grid.about, pc2grid.session TO writer")
        connection.execute("GRANT USAGE ON SEQUENCE pc2grid.session_id TO writer")
    writer, viewer = (with_user(filled, role, "") for role in ("writer", "viewer"))
    store(writer, [make_entry("friday", 5)], keep=True)
    store(writer, [make_entry("friday", 6)], keep=True, force=True)
    with open_database(viewer, writable=True) as database:
        assert_holds(database, make_entry("friday", 6))
        assert len(database.nearest(make_entry("q", 99)[1][0], 5)) == 5
        with pytest.raises(DatabaseError, match="permission denied"):
            database.add(*make_entry("sunday", 7))
        assert len(database.sessions()) == 3


# --- many at once -------------------------------------------------------------------------------------


def test_robots_that_write_and_read_at_once(url: str) -> None:
    """The tables do not exist at first. All writers store one common session; the other sessions differ."""
    wrong: list[str] = []

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

    robots = [threading.Thread(target=robot, args=(number,)) for number in range(6)]
    for thread in robots:
        thread.start()
    for thread in robots:
        thread.join()
    assert wrong == []
    with open_database(url) as database:
        assert len(database.sessions()) == 6 * 3 + 1
        assert database.check() == ()


def test_first_two_with_different_settings_do_not_both_win(url: str) -> None:
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

    threads = [threading.Thread(target=add, args=(entry,)) for entry in entries]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results.count("stored") == 1, results
    assert sum("cannot be compared" in str(result) for result in results) == 2, results


def test_writer_that_waits_too_long_is_told(filled: str, monkeypatch) -> None:
    monkeypatch.setattr(schema, "BUSY_TIMEOUT_S", 1.0)
    with postgresql.connect(filled) as other, other.transaction():
        other.execute("SELECT 1 FROM pc2grid.about FOR UPDATE")
        with pytest.raises(DatabaseBusy, match="lock timeout"):
            store(filled, [make_entry("friday", 5)], keep=True)


# --- damage -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("session", "document", "document || ' '"),
        ("session", "floor", "'cellar'"),
        ("grid", "cells", "set_byte(cells, 9, 1)"),
        ("trajectory", "poses", "set_byte(poses, 9, 1)"),
        ("loop", "measured", "set_byte(measured, 9, 1)"),
        ("graph", "length_m", "set_byte(length_m, 9, 1)"),
        ("points", "within", "set_byte(within, 9, 1)"),
        ("isovist", "seen", "set_byte(seen, 9, 1)"),
        ("submap", "center_x_m", "center_x_m + 1"),
        ("signature", "boundary", "set_byte(boundary, 9, 1)"),
        ("signature", "embedding", "embedding + embedding"),
    ],
)
def test_changed_rows_are_found(filled: str, table: str, column: str, value: str) -> None:
    number = "id" if table == "session" else "session_id"
    with postgresql.connect(filled) as connection:
        connection.execute(f"UPDATE pc2grid.{table} SET {column} = {value} WHERE {number} = 1")
    problems = maintenance.check(filled)
    assert problems
    assert all(table in problem.where for problem in problems)
    if column == "embedding":
        return  # read by the index only, which a wrong one can mislead but not break
    with pytest.raises(DatabaseCorrupt, match="checksum"), open_database(filled) as database:
        for info in database.sessions():
            database.grid(info.name)
            database.trajectory(info.name)
            database.loops(info.name)
            database.graph(info.name)
            database.points(info.name)
            database.seen_places(info.name)
            list(database.submaps(info.name))
        database.signatures()


def test_search_and_copy_go_on_without_what_is_damaged(filled: str, tmp_path: Path) -> None:
    with postgresql.connect(filled) as connection:
        connection.execute("UPDATE pc2grid.grid SET width = width + 1 WHERE session_id = 1")
        connection.execute("DELETE FROM pc2grid.submap WHERE session_id = 2 AND submap_id = 3")
    query = make_entry("q", 99)[1][0]
    with open_database(filled) as database:
        assert [problem.where for problem in database.leave_out_damaged()] == ["grid 1"]
        assert [info.name for info in database.sessions()] == ["tuesday"]
        assert {found.session for found in database.nearest(query, 20)} == {"tuesday"}
        with pytest.raises(DatabaseCorrupt, match="1 missing"):
            list(database.submaps("tuesday"))
    target = tmp_path / "good.submaps"
    with pytest.raises(DatabaseCorrupt, match="grid 1"):
        maintenance.copy(filled, target)
    assert len(maintenance.copy(filled, target, recover=True)) == 2
    assert maintenance.check(target) == ()
    with open_database(target) as database:
        assert [submap.submap_id for submap in database.submaps("tuesday")] == [0, 1, 2, 4]


# --- a server that goes away --------------------------------------------------------------------------


def test_connection_cut_in_the_middle_of_storing_leaves_what_was_there(filled: str) -> None:
    before = everything(filled)

    def entries():
        yield make_entry("wednesday", 2)
        with postgresql.connect(filled) as connection:
            connection.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
                " WHERE datname = current_database() AND pid <> pg_backend_pid()"
            )
        yield make_entry("thursday", 3)

    with pytest.raises(DatabaseUnreachable, match="server went away") as caught:
        store(filled, entries(), keep=True)
    assert "try again" in str(caught.value)
    assert everything(filled) == before


def _write_for_ever(url: str, queue) -> None:
    for i in range(1000):
        try:
            store(url, [make_entry(f"day {i}", i)], keep=True)
        except Pc2GridError as error:
            queue.put(type(error).__name__)
            return
        queue.put(i)


def test_killed_server_loses_nothing_that_was_stored(filled: str) -> None:
    server = postgresql.server()
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    writer = context.Process(target=_write_for_ever, args=(filled, queue))
    writer.start()
    stored = [queue.get(timeout=60) for _ in range(4)]
    with open_database(filled) as reader:
        server.kill()
        with pytest.raises(DatabaseUnreachable, match="server went away"):
            reader.sessions()
    with pytest.raises(DatabaseUnreachable):
        open_database(filled)
    server.start()
    writer.join(60)
    while not isinstance(stored[-1], str):
        stored.append(queue.get(timeout=10))
    assert stored.pop() == "DatabaseUnreachable"
    with open_database(filled) as database:
        names = [info.name for info in database.sessions()]
        # One more than it was told of may have been stored: the answer got lost, not the session.
        assert names[: 2 + len(stored)] == ["monday", "tuesday", *(f"day {i}" for i in stored)]
        assert database.check() == ()


# --- the embedding ------------------------------------------------------------------------------------


def test_inner_product_is_the_weighted_bhattacharyya_coefficient() -> None:
    rng = np.random.default_rng(0)
    boundary, freespace = (rng.dirichlet(np.ones(n), 6).astype(np.float32) for n in (50, 30))
    config = Config().signature
    vectors = embedding(boundary, freespace, config)
    for i in range(6):
        for j in range(6):
            wanted = (
                0.9 * np.sqrt(boundary[i] * boundary[j]).sum()
                + 0.1 * np.sqrt(freespace[i] * freespace[j]).sum()
            )
            assert vectors[i] @ vectors[j] == pytest.approx(wanted, abs=1e-5)
