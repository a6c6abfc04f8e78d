"""The format of a database, written down: files of today must be readable tomorrow."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from pc2grid.errors import DatabaseVersion
from signature.database import open_database
from signature.database import sqlite as schema
from signature.database.document import row_crc, unpack
from signature.database.maintenance import check, store
from signature.database.protocol import FORMAT
from tests.helpers.databases import Content, craft, make_entry, sql


def test_tables_and_checksums_are_unchanged() -> None:
    """If this fails, files exist that the change cannot read: it needs another `FORMAT`."""
    digest = hashlib.sha256(json.dumps(schema.TABLES, sort_keys=True).encode()).hexdigest()[:16]
    assert (FORMAT, digest) == (1, "18f09c183e83f1cc")
    assert row_crc([1, "ä", b"\0\1"]) == 0xBE567009


PARTS: dict[str, tuple[Any, dict[str, tuple[str, tuple[int, ...]]]]] = {
    "grid": (
        {"origin_m": [-1.25, 2 / 3], "resolution_m": 0.05, "height_m": None, "heights": None},
        {"cells": ("int8", (40, 60))},
    ),
    "trajectory": (
        {"health": ["fine", "degenerate", "fine", "fine", "fine", "fine", "lost"]},
        {"stamps_ns": ("int64", (7,)), "T_session_base": ("float64", (7, 4, 4))},
    ),
    "graph": (
        {},
        {
            "center_m": ("float64", (3, 2)),
            "kind": ("uint8", (3,)),
            "pixels": ("int32", (3,)),
            "edges": ("int32", (2, 2)),
            "length_m": ("float64", (2,)),
            "path_start": ("int64", (3,)),
            "path_m": ("float32", (6, 2)),
        },
    ),
    "points": ({"voxel_m": 0.1}, {"origin_m": ("float64", (3,)), "steps": ("int32", (40, 3))}),
    "submaps": (
        {},
        {
            "submap_id": ("int32", (3,)),
            "center_m": ("float64", (3, 2)),
            "boundary": ("float32", (3, 50)),
            "freespace": ("float32", (3, 50)),
            "symmetry": ("float32", (3, 2)),
        },
    ),
    "seen": (
        {},
        {"at_m": ("float32", (3, 2)), "place": ("int64", (3,)), "signatures": ("uint8", (3, 199))},
    ),
    "frame": (None, {}),
}
"""What a session consists of; a field that is added to one of the stored types changes the format."""


def test_a_stored_session_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)
    stored = {name: unpack(data) for name, data in sql(path, "SELECT name, data FROM part")}
    loops, no_arrays = stored.pop("loops")
    found = {
        name: (document, {key: (array.dtype.name, array.shape) for key, array in arrays.items()})
        for name, (document, arrays) in stored.items()
    }
    assert found == PARTS
    assert {key: type(value) for key, value in loops[1].items()} == {
        "older": int, "newer": int, "T_older_newer": dict, "information": list, "accepted": bool
    }  # fmt: skip
    assert (len(loops), no_arrays) == (3, {})


@pytest.mark.fault(44)
def test_settings_of_the_future_are_refused_by_name_and_left_alone(tmp_path: Path) -> None:
    """The format is the same, but a session was made with a setting that this version does not know."""
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)

    def from_the_future(content: Content) -> None:
        origin: dict[str, Any] = content.document["provenance"]
        origin["config"]["partition"]["fractal"] = 3
        origin["versions"]["pc2grid"] = "9.1.0"

    craft(path, from_the_future)
    before = path.read_bytes()
    words = r"'monday' was made by pc2grid 9\.1\.0 with the setting partition\.fractal"
    with open_database(path) as database, pytest.raises(DatabaseVersion, match=words):
        database.sessions()
    with pytest.raises(DatabaseVersion, match=words):
        store(path, [make_entry("tuesday", 1)], keep=True)
    assert path.read_bytes() == before
    (problem,) = check(path)
    assert "partition.fractal" in problem.what
