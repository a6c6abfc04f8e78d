"""Format 1 of a database, written down: who changes it must raise its number and bring old files along."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from pathlib import Path

import pytest

from pc2grid.errors import DatabaseVersion
from signature.database import codec, open_database, schema
from signature.database.sqlite import store
from signature.database.upkeep import check
from tests.test_database import make_entry

TABLES_OF_1 = "56cd09ffe3cc00c1"


def test_the_tables_of_format_1_are_as_they_were() -> None:
    """If this fails, files of users exist that the change cannot read: see `schema.FORMAT`."""
    digest = hashlib.sha256(json.dumps(schema.TABLES, sort_keys=True).encode()).hexdigest()[:16]
    assert (schema.FORMAT, digest) == (1, TABLES_OF_1)


@pytest.mark.fault(44)
def test_settings_of_the_future_are_refused_by_name_and_left_alone(tmp_path: Path) -> None:
    """The format is the same, but a session was made with a setting that this version does not know."""
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)
    connection = sqlite3.connect(path)
    columns = schema.COLUMNS["session"]
    values = connection.execute(f"SELECT {', '.join(columns)} FROM session").fetchone()
    row = dict(zip(columns, values, strict=True))
    document = json.loads(row["document"])
    document["config"]["partition"]["fractal"] = 3
    document["versions"]["pc2grid"] = "9.1.0"
    row["document"] = json.dumps(document)
    crc = codec.row_crc(list(row.values()))
    connection.execute("UPDATE session SET document = ?, crc32 = ?", (row["document"], crc))
    connection.commit()
    connection.close()
    before = path.read_bytes()
    words = r"'monday' was made by pc2grid 9\.1\.0 with the setting partition\.fractal"
    with open_database(path) as database, pytest.raises(DatabaseVersion, match=words):
        database.sessions()
    with pytest.raises(DatabaseVersion, match=words):
        store(path, [make_entry("tuesday", 1)], keep=True)
    assert path.read_bytes() == before
    (problem,) = check(path)
    assert "partition.fractal" in problem.what
