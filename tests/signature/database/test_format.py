"""The format of a database, written down: files of today must be readable tomorrow."""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import DatabaseVersion
from signature.database import open_database
from signature.database.maintenance import check, store
from signature.database.protocol import FORMAT
from signature.database.sqlite import schema
from tests.helpers.databases import Content, craft, make_entry, sql

TABLES = "6fa430e427dca6ee"


def test_the_tables_are_unchanged() -> None:
    """If this fails, files exist that the change cannot read: it needs another `FORMAT`."""
    digest = hashlib.sha256(json.dumps(schema.TABLES, sort_keys=True).encode()).hexdigest()[:16]
    assert (FORMAT, digest) == (1, TABLES)


ARRAYS = {
    "grid.cells": ("int8", [40, 60]),
    "trajectory.stamps_ns": ("int64", [7]),
    "trajectory.T_session_base": ("float64", [7, 4, 4]),
    "trajectory.health": ("uint8", [7]),
    "loops.older": ("int64", [3]),
    "loops.newer": ("int64", [3]),
    "loops.T_older_newer.x": ("float64", [3]),
    "loops.T_older_newer.y": ("float64", [3]),
    "loops.T_older_newer.yaw": ("float64", [3]),
    "loops.information": ("float64", [3, 3, 3]),
    "loops.accepted": ("bool", [3]),
    "graph.center_m": ("float64", [3, 2]),
    "graph.kind": ("uint8", [3]),
    "graph.pixels": ("int32", [3]),
    "graph.edges": ("int32", [2, 2]),
    "graph.length_m": ("float64", [2]),
    "graph.path_start": ("int64", [3]),
    "graph.path_m": ("float32", [6, 2]),
    "points.origin_m": ("float64", [3]),
    "points.steps": ("int32", [40, 3]),
    "submaps.submap_id": ("int32", [3]),
    "submaps.center_m": ("float64", [3, 2]),
    "submaps.boundary": ("float32", [3, 50]),
    "submaps.freespace": ("float32", [3, 50]),
    "submaps.symmetry": ("float32", [3, 2]),
    "seen.at_m": ("float32", [3, 2]),
    "seen.place": ("int64", [3]),
    "seen.signatures": ("uint8", [3, 111]),
}
"""What a session consists of; a field that is added to one of the stored types changes the format."""


def test_a_stored_session_is_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)
    found = sql(path, 'SELECT name, dtype, shape, data FROM "array"')
    assert {name: (dtype, json.loads(shape)) for name, dtype, shape, _ in found} == ARRAYS
    stored = {name: data for name, _, _, data in found}
    assert stored["graph.pixels"] == struct.pack("<3i", 1, 2, 3)
    assert stored["graph.kind"] == b"\0\1\0"
    assert stored["trajectory.health"] == b"\0\1\0\0\0\0\2"
    assert stored["loops.accepted"] == b"\1\0\1"
    # All x, then all y; of all of them first the lowest bytes.
    x = np.arange(3) - 1 / 3
    path_m = struct.pack("<12f", *x[[0, 0, 1, 0, 0, 2]], *[1.0] * 6)
    assert zlib.decompress(stored["graph.path_m"]) == b"".join(path_m[k::4] for k in range(4))
    ((document,),) = sql(path, "SELECT document FROM session")
    content = json.loads(document)
    grid = {"cells": "array", "origin_m": [-1.25, 2 / 3], "resolution_m": 0.05}
    assert content["grid"] == {**grid, "height_m": None, "heights": None}
    assert (content["loops"], content["points"]["voxel_m"]) == (3, 0.1)


def test_a_session_of_before_grids_had_heights_is_read(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)

    def of_before(content: Content) -> None:
        del content.document["grid"]["height_m"]

    craft(path, of_before)
    with open_database(path) as database:
        assert database.grid("monday").height_m is None
    assert check(path) == ()


@pytest.mark.fault(44)
def test_settings_of_the_future_are_refused_by_name_and_left_alone(tmp_path: Path) -> None:
    """The format is the same, but a session was made with a setting that this version does not know."""
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)

    def from_the_future(content: Content) -> None:
        origin: dict[str, Any] = content.document["info"]["provenance"]
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
