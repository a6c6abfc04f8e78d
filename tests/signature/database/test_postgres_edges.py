"""Rarer answers of a PostgreSQL server: missing rows, missing rights, other settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from signature.config import Config
from signature.database import create_database, maintenance, open_database
from signature.database.maintenance import store
from signature.similarity import distances
from tests.helpers import postgresql
from tests.helpers.databases import assert_holds, make_entry
from tests.helpers.postgresql import with_user


@pytest.fixture(scope="module")
def stored() -> str:
    url = postgresql.new_database()
    store(url, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return url


@pytest.fixture
def url(stored: str) -> str:
    return postgresql.new_database(like=stored)


def change(url: str, *statements: str) -> None:
    with postgresql.connect(url) as connection:
        for statement in statements:
            connection.execute(statement)


@pytest.mark.parametrize("table", ["grid", "trajectory", "loop", "graph", "points", "isovist", "signature"])
def test_a_row_that_is_gone_is_missed_by_name(url: str, tmp_path: Path, table: str) -> None:
    change(url, f"DELETE FROM pc2grid.{table} WHERE session_id = 1")
    uses: dict[str, Callable[[Any], object]] = {
        "grid": lambda database: database.sessions(),
        "trajectory": lambda database: database.sessions(),
        "loop": lambda database: database.loops("monday"),
        "graph": lambda database: database.graph("monday"),
        "points": lambda database: database.points("monday"),
        "isovist": lambda database: database.seen_places("monday"),
        "signature": lambda database: database.grid("monday"),
    }
    reads: dict[str, Callable[[Any], object]] = {
        "grid": lambda database: database.grid("monday"),
        "trajectory": lambda database: database.trajectory("monday"),
        "loop": lambda database: database.loops("monday"),
        "graph": lambda database: database.graph("monday"),
        "points": lambda database: database.points("monday"),
        "isovist": lambda database: database.seen_places("monday"),
        "signature": lambda database: list(database.submaps("monday")),
    }
    words = f"session 1: has no {table}" if table in ("grid", "trajectory") else f"{table} .*missing"
    with open_database(url) as database:
        if table == "signature":  # nothing tells a session without submaps from one that lost all signatures
            uses[table](database)
        else:
            with pytest.raises(DatabaseCorrupt, match=words):
                uses[table](database)
        with pytest.raises(DatabaseCorrupt, match="missing"):
            reads[table](database)
    (problem,) = maintenance.check(url)
    assert "1" in problem.where or "monday" in problem.where
    good = tmp_path / "good.submaps"
    assert maintenance.copy(url, good, recover=True) == (problem,)
    assert maintenance.check(good) == ()
    with open_database(good) as database:
        assert_holds(database, make_entry("tuesday", 1, submaps=5))


def test_nothing_is_left_of_a_wholly_damaged_database(url: str) -> None:
    change(url, "UPDATE pc2grid.grid SET width = width + 1")
    with (
        open_database(url) as database,
        pytest.raises(DatabaseCorrupt, match="damaged: grid 1: wrong checksum"),
    ):
        database.leave_out_damaged()


def test_merging_takes_nothing_from_a_damaged_database(url: str, tmp_path: Path) -> None:
    change(url, "UPDATE pc2grid.submap SET radius_m = 1 WHERE session_id = 2 AND submap_id = 3")
    target = tmp_path / "target.submaps"
    with pytest.raises(DatabaseCorrupt, match="submap 3 of session 'tuesday': wrong checksum"):
        maintenance.merge([url], target)
    assert list(tmp_path.iterdir()) == []


def test_tables_that_are_not_ours(url: str) -> None:
    change(url, "ALTER TABLE pc2grid.loop RENAME COLUMN accepted TO believed")
    with open_database(url) as database, pytest.raises(DatabaseCorrupt, match="not those of format 5"):
        database.loops("monday")
    change(url, "DELETE FROM pc2grid.about")
    with pytest.raises(DatabaseCorrupt, match=r"pc2grid\.about has 0 rows instead of one"):
        open_database(url)


def test_a_server_that_takes_no_changes(url: str) -> None:
    """A replica, or one whose administrator has set it so."""
    name = url.rpartition("/fleet")[2].partition("?")[0]
    change(url, f"ALTER DATABASE fleet{name} SET default_transaction_read_only = on")
    with pytest.raises(OutputError, match=r"cannot write: cannot execute .* in a read-only transaction"):
        store(url, [make_entry("friday", 5)], keep=True)
    with open_database(url) as database:
        assert_holds(database, make_entry("monday", 0))


def test_a_user_who_may_not_enable_pgvector() -> None:
    url = postgresql.new_database()
    change(url, "CREATE ROLE guest LOGIN", "REVOKE ALL ON SCHEMA public FROM guest")
    with pytest.raises(DatabaseError, match="pgvector is not enabled in this database") as caught:
        create_database(with_user(url, "guest", ""))
    assert "CREATE EXTENSION vector" in str(caught.value)


def test_another_number_of_bins_gets_another_index(url: str) -> None:
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    entry = make_entry("friday", 5, submaps=9, config=config)
    store(url, [entry], keep=False)
    query = make_entry("q", 99, config=config)[1][0]
    with open_database(url) as database:
        assert_holds(database, entry)
        scores = distances(query, database.signatures(), config.signature)
        assert [n.score for n in database.nearest(query, 4)] == sorted(scores)[:4]
        assert database.check() == ()
    with postgresql.connect(url) as connection:
        (index,) = connection.execute(
            "SELECT pg_get_indexdef('pc2grid.signature_embedding'::regclass)"
        ).fetchone()
    signature = entry[1][0]
    assert f"halfvec({len(signature.boundary) + len(signature.freespace)})" in index
