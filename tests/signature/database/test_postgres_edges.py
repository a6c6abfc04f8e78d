"""Rarer answers of a PostgreSQL server: missing rows, missing rights, other settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from signature.database import create_database, maintenance, open_database
from signature.database.maintenance import store
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


def test_nothing_is_left_of_a_wholly_damaged_database(url: str) -> None:
    change(url, "UPDATE pc2grid.array SET crc32 = crc32 + 1 WHERE name = 'grid.cells'")
    with (
        open_database(url) as database,
        pytest.raises(DatabaseCorrupt, match=r"damaged: grid\.cells of session 'monday': wrong checksum"),
    ):
        database.leave_out_damaged()


def test_merging_takes_nothing_from_a_damaged_database(url: str, tmp_path: Path) -> None:
    change(url, "UPDATE pc2grid.array SET dtype = 'int64' WHERE session_id = 2 AND name = 'graph.pixels'")
    target = tmp_path / "target.submaps"
    with pytest.raises(DatabaseCorrupt, match=r"graph\.pixels of session 'tuesday': wrong checksum"):
        maintenance.merge([url], target)
    assert list(tmp_path.iterdir()) == []


def test_tables_that_are_not_ours(url: str) -> None:
    change(url, "ALTER TABLE pc2grid.array RENAME COLUMN data TO content")
    with open_database(url) as database, pytest.raises(DatabaseCorrupt, match="not those of format 1"):
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


def test_a_user_who_may_not_make_tables() -> None:
    url = postgresql.new_database()
    change(url, "CREATE ROLE guest LOGIN")
    with pytest.raises(DatabaseError, match="permission denied for database") as caught:
        create_database(with_user(url, "guest", ""))
    assert "ask an administrator" in str(caught.value)
