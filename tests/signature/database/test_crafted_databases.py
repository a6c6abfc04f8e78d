"""Databases with right checksums and implausible content: refused by row, on every engine."""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseVersion
from pc2grid.model import OccupancyGrid, Submap
from signature.database import maintenance, open_database, serialize, validation
from signature.database.postgres import schema as postgres_schema
from signature.database.sqlite import schema
from signature.database.sqlite.database import store as store_file
from tests.helpers import postgresql
from tests.helpers.databases import assert_holds, make_entry

FUZZ = int(os.environ.get("PC2GRID_FUZZ", "0"))
Change = Callable[[dict[str, Any]], dict[str, Any]]


def craft(place: str | Path, table: str, change: Change, row_number: int = 0) -> None:
    """Change a row of the first session, and make its checksum right again."""
    url = isinstance(place, str)
    columns = list(postgres_schema.TYPES[table] if url else schema.COLUMNS[table])
    name, mark = (f"pc2grid.{table}", "%s") if url else (table, "?")
    number, order = (
        ("ctid", "submap_id" if "submap_id" in columns else "crc32") if url else ("rowid", "rowid")
    )
    key = "id" if table == "session" else "session_id"
    query = f"SELECT {number}, {', '.join(columns)} FROM {name} WHERE {key} = 1 ORDER BY {order}"
    sets = ", ".join(f"{column} = {mark}" for column in (*columns, "crc32"))
    connection: Any
    with contextlib.closing(postgresql.connect(place) if url else sqlite3.connect(place)) as connection:
        which, *content = connection.execute(query).fetchall()[row_number]
        row = change(dict(zip(columns, content, strict=True)))
        values = [row[column] for column in columns]
        update = f"UPDATE {name} SET {sets} WHERE {number} = {mark}"
        connection.execute(update, [*values, serialize.row_crc(values), which])
        connection.commit()


def put(**values: Any) -> Change:
    return lambda row: {**row, **values}


def array(column: str, dtype: str, index: Any, value: Any) -> Change:
    """Change one entry of an array, counted in its flat form."""

    def change(row: dict[str, Any]) -> dict[str, Any]:
        numbers = np.frombuffer(row[column], dtype).copy()
        numbers[index] = value
        return {**row, column: numbers.tobytes()}

    return change


def pose(component: int, value: float, number: int = 3) -> Change:
    """One of the twelve numbers of a pose; of seven poses."""

    def change(row: dict[str, Any]) -> dict[str, Any]:
        poses = serialize.unpack_poses(row["poses"], 7).copy()
        poses[number, component // 4, component % 4] = value
        packed = np.ascontiguousarray(poses[:, :3].reshape(7, 12).T).tobytes()
        return {**row, "poses": serialize.zlib.compress(packed)}

    return change


def way(number: int, value: float) -> Change:
    """One of the coordinates of the ways of a graph of six points: all x, then all y."""

    def change(row: dict[str, Any]) -> dict[str, Any]:
        points = np.frombuffer(serialize.zlib.decompress(row["path_m"]), "<f4").copy()
        points[number] = value
        return {**row, "path_m": serialize.zlib.compress(points.tobytes())}

    return change


def voxel(number: int, value: int) -> Change:
    """One of the steps from voxel to voxel: all along x, then y, then z."""

    def change(row: dict[str, Any]) -> dict[str, Any]:
        steps = np.frombuffer(serialize.zlib.decompress(row["voxels"]), "<i4").copy()
        steps[number] = value
        return {**row, "voxels": serialize.zlib.compress(steps.tobytes())}

    return change


def document(**values: Any) -> Change:
    """Entries of a session's document; those of its report as report__name."""

    def change(row: dict[str, Any]) -> dict[str, Any]:
        content = json.loads(row["document"])
        for name, value in values.items():
            outer, _, inner = name.partition("__")
            if inner:
                content[outer][inner] = value
            else:
                content[name] = value
        return {**row, "document": json.dumps(content)}

    return change


def other_cells(row: dict[str, Any]) -> dict[str, Any]:
    cells = np.zeros(row["height"] * row["width"], np.int8)
    cells[5] = 101
    return {**row, "cells": serialize.zlib.compress(cells.tobytes())}


def all_known(row: dict[str, Any]) -> dict[str, Any]:
    """A submap at the edge of its map that knows what lies beyond."""
    return {**row, "cells": serialize.zlib.compress(bytes(row["height"] * row["width"]))}


NAN, INF = float("nan"), float("inf")
READ: dict[str, Callable[[Any], object]] = {
    "session": lambda database: database.sessions(),
    "grid": lambda database: database.grid("monday"),
    "trajectory": lambda database: database.trajectory("monday"),
    "loop": lambda database: database.loops("monday"),
    "graph": lambda database: database.graph("monday"),
    "points": lambda database: database.points("monday"),
    "isovist": lambda database: database.seen_places("monday"),
    "submap": lambda database: list(database.submaps("monday")),
    "signature": lambda database: database.signatures(),
}
CASES: list[tuple[str, Change, str]] = [
    ("trajectory", array("stamps_ns", "<i8", 4, 5), "stamp 4 is earlier than the one before"),
    ("trajectory", array("stamps_ns", "<i8", 0, 2**63 - 1), "stamp 1 is earlier"),
    ("trajectory", pose(0, 1.001), "pose 3 is not rigid"),
    ("trajectory", pose(10, -1.0), "pose 3 is not rigid"),  # a mirror image
    ("trajectory", pose(10, -0.99999), "pose 3 is not rigid"),
    ("trajectory", pose(5, 0.0, number=6), "pose 6 is not rigid"),
    ("trajectory", pose(2, 1e200), "pose 3 is not rigid"),
    ("trajectory", pose(3, NAN), "not finite"),
    ("trajectory", pose(7, -INF), "not finite"),
    ("trajectory", pose(11, 1e9), "pose 3 is more than 1e\\+08 m away"),
    ("trajectory", put(count=8), "needs 64"),
    ("trajectory", put(count=-1), "cannot be"),
    ("trajectory", put(health=b"\0\0\0\0\0\0\7"), "unknown health"),
    ("trajectory", put(health=b"\0"), "expected 7 entries, got 1"),
    ("loop", array("pairs", "<i4", 3, 7), "loop 1 is between poses 1 and 7 of 7"),
    ("loop", array("pairs", "<i4", 2, -1), "loop 1 is between poses -1 and 5 of 7"),
    ("loop", array("pairs", "<i4", 2, 5), "loop 1 is between poses 5 and 5 of 7"),
    ("loop", array("measured", "<f8", 5, NAN), "not finite"),
    ("loop", array("measured", "<f8", 7, -1e9), "loop 2 measures more than 1e\\+08 m"),
    ("loop", array("information", "<f8", 9, INF), "not finite"),
    ("loop", array("information", "<f8", 10, 1e6), "loop 1 has an information that is no inverse"),
    ("loop", array("information", "<f8", 26, -1.0), "loop 2 has an information that is no inverse"),
    ("loop", array("information", "<f8", 0, 1e16), "loop 0 has an information that is no inverse"),
    ("loop", put(accepted=b"\0\1\2"), "loop 2 is neither accepted nor rejected"),
    ("graph", array("ends", "<i4", 3, 3), "edges: not that of a junction graph"),
    ("graph", array("ends", "<i4", 0, -1), "edges: not that of a junction graph"),
    ("graph", array("ends", "<i4", 3, 1), "edges: not that of a junction graph"),  # twice the same
    ("graph", array("kind", "u1", 2, 2), "kind: not that of a junction graph"),
    ("graph", array("pixels", "<i4", 1, 0), "node 1 has less than one pixel"),
    ("graph", array("center_m", "<f8", 2, NAN), "not finite"),
    ("graph", array("center_m", "<f8", 4, 1.9), "node 2 lies outside its map"),
    ("graph", array("center_m", "<f8", 1, 0.6), "node 0 lies outside its map"),
    ("graph", array("length_m", "<f8", 1, -1.0), "length_m: not that of a junction graph"),
    ("graph", array("length_m", "<f8", 1, 1e9), "edge 1 is longer than 1e\\+08 m"),
    ("graph", array("path_start", "<i8", 1, 7), "path_start: not that of a junction graph"),
    ("graph", array("path_start", "<i8", 2, 5), "path_start: not that of a junction graph"),
    ("graph", way(3, 90.0), "point 3 lies outside its map"),
    ("graph", way(9, INF), "not finite"),
    ("graph", put(points=7), "does not hold the 56 bytes"),
    ("graph", put(points=2**30), "a graph of 1073741824 points"),
    ("points", voxel(3, -20), "a voxel outside 0"),
    ("points", voxel(0, 2**21), "a voxel outside 0"),
    ("points", lambda row: {**row, "within": serialize.zlib.compress(b"\x40" * 120)}, "outside its voxel"),
    ("points", lambda row: {**row, "voxels": serialize.zlib.compress(bytes(480))}, "voxel 1 is not after"),
    ("points", put(count=41), "does not hold the 492 bytes"),
    ("points", put(count=2**30), "1073741824 points"),
    ("points", put(voxel_m=0.0), "voxel_m is 0"),
    ("points", put(origin_z_m=INF), "origin_m is inf"),
    ("isovist", put(bearings=36), "isovists of 36 rays and 111 columns"),
    ("isovist", put(columns=110), "of 48 rays and 110 columns"),
    ("isovist", put(count=4), "does not hold the 192 bytes"),
    ("isovist", put(count=2**30), "1073741824 isovists"),
    ("isovist", put(sight_m=INF), "sight_m is inf"),
    ("isovist", lambda row: {**row, "seen": serialize.zlib.compress(bytes(9))}, "does not hold the"),
    ("graph", put(nodes=4), "needs 64"),
    ("graph", put(nodes=-1), "nodes is -1 instead of a count"),
    ("graph", put(edges=3), "needs 24"),
    ("grid", put(resolution_m=1e-9), "resolution_m is 1e-09 instead of a number in 0.001..100"),
    ("grid", put(resolution_m=1e6), "resolution_m is 1000000.0 instead"),
    ("grid", put(resolution_m=-0.05), "expected > 0, got -0.05"),
    ("grid", put(resolution_m=INF), "expected > 0, got inf"),
    ("grid", put(origin_x_m=INF), "origin_m is inf"),
    ("grid", put(origin_y_m=-1e9), "origin_m is -1000000000.0"),
    ("grid", put(height=-40, width=-60), "height is -40 instead of a count"),
    ("grid", put(height=2**30, width=2**30), "a grid of 1073741824 x 1073741824 cells"),
    ("grid", other_cells, "a cell outside -1..100"),
    ("submap", put(radius_m=-1.0), "radius_m is -1.0 instead of a number in 0..10000"),
    ("submap", put(radius_m=INF), "radius_m is inf"),
    ("submap", put(center_x_m=INF), "center_m is inf"),
    ("submap", put(center_x_m=90.0), "its centre lies outside its own cells"),
    ("submap", put(center_y_m=-90.0), "its centre lies outside its own cells"),
    ("submap", put(center_x_m=90.0, origin_x_m=89.9), "its centre lies outside its map"),
    ("submap", put(resolution_m=0.06), "resolution_m is 0.06 where its map has 0.05"),
    ("submap", all_known, "it knows cells outside its map"),
    ("submap", put(submap_id=-1), "submap_id is -1 instead of a count"),
    ("submap", other_cells, "a cell outside -1..100"),
    ("signature", array("boundary", "<f4", 3, -0.5), "boundary histogram 0 has sum "),
    ("signature", array("boundary", "<f4", slice(0, 50), 0.5), "boundary histogram 0 has sum 25 instead of"),
    ("signature", array("boundary", "<f4", 0, NAN), "boundary histogram 0 has sum nan"),
    ("signature", array("freespace", "<f4", 0, INF), "freespace histogram 0 has sum inf"),
    ("signature", array("freespace", "<f4", slice(0, 3), [-2, 1, 2]), "freespace histogram 0"),
    ("signature", array("boundary", "<f4", slice(0, 50), [-1, 2] + 48 * [0]), "0 has a negative share"),
    ("signature", array("symmetry", "<f4", 0, -1), "signature 0 has a symmetry score below 0"),
    ("session", document(submaps=-3), "submaps is -3 instead of a count"),
    ("session", document(submaps="many"), "submaps is 'many' instead of a count"),
    ("session", document(submaps=True), "submaps is True instead of a count"),
    ("session", document(submaps=10**400), "submaps is 1000"),
    ("session", document(area_m2=NAN), "area_m2 is nan instead of a number"),
    ("session", document(path_m=-1.0), "path_m is -1.0 instead of a number"),
    ("session", document(driven_s=INF), "driven_s is inf"),
    ("session", document(start_s="0"), "start_s is '0' instead"),
    ("session", document(duration_s=[]), "duration_s is of type list instead"),
    ("session", document(digest=None), "digest is None instead of text"),
    ("session", document(versions={"numpy": 2}), "numpy is 2 instead of text"),
    ("session", document(versions=[]), "AttributeError"),
    ("session", document(source=7), "source is 7 instead of text"),
    ("session", document(report__scans_read=1.5), "scans_read is 1.5 instead of a count"),
    ("session", document(report__bytes_lost=-1), "bytes_lost is -1"),
    ("session", document(report__scans_skipped={"late": -1}), "late is -1"),
    ("session", document(report__warnings=[3]), "warning is 3 instead of text"),
    ("session", document(report=None), "TypeError"),
    ("session", document(consistency__bent=1), "bent is 1 instead of true or false"),
    ("session", document(consistency__contradicted=1.5), "contradicted is 1.5 instead of a number in 0..1"),
    ("session", document(consistency__stretches=[{}]), "KeyError"),
    ("session", document(consistency__stretches=[{"from_ns": 2**63}]), "from_ns is 9223372036854775808"),
    ("session", document(consistency=[]), "TypeError"),
    ("session", document(precision__sigma_m=[-1.0, 0.1]), "sigma_m is -1.0 instead of a number"),
    ("session", document(precision__sigma_m=[0.1]), "expected as many stamps as sigmas"),
    ("session", document(precision__loose=[{}]), "KeyError"),
    ("session", document(odometry__overruled=-1), "overruled is -1"),
    ("session", document(odometry__stretches=[{}]), "KeyError"),
    ("session", document(floor=2), "floor is 2 instead of text"),
    ("session", put(document="[]"), "TypeError"),
    ("session", put(document="{"), "JSONDecodeError"),
    ("session", put(document="[" * 100_000), "RecursionError"),
]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("crafted") / "x.submaps"
    store_file(path, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return path.read_bytes()


@pytest.fixture(scope="module")
def server() -> str:
    url = postgresql.new_database()
    maintenance.store(url, [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)], keep=False)
    return url


@pytest.fixture(params=["sqlite", "postgres"])
def place(request, tmp_path: Path) -> Any:
    """A database of its own for each test: on the server, a copy of what has been stored once."""
    if request.param == "sqlite":
        path = tmp_path / "x.submaps"
        path.write_bytes(request.getfixturevalue("file"))
        return path
    return postgresql.new_database(like=request.getfixturevalue("server"))


@pytest.mark.parametrize(("table", "change", "words"), CASES)
def test_what_cannot_be_true_is_refused_by_row(place: Any, table: str, change: Change, words: str) -> None:
    craft(place, table, change)
    row = {"session": "session 1", "signature": "signature"}.get(table, "of session 'monday'")
    with open_database(place) as database:
        with pytest.raises(DatabaseCorrupt, match=words) as caught:
            READ[table](database)
        assert row in caught.value.message
        assert "checksum" not in caught.value.message
    # The crafted row is all that is wrong: the rest is read, checked and copied as ever.
    if table == "session":
        return
    problems = maintenance.check(place)
    assert any(problem.where.startswith(table) for problem in problems), problems
    assert all("1" in problem.where or "monday" in problem.where for problem in problems), problems
    if table in ("loop", "graph", "points", "isovist", "submap"):  # the others are what a search rests on
        with open_database(place) as database:
            assert len(database.signatures()) == 8


@pytest.mark.parametrize("side", [(0, 4), (8, 4), (4, 0), (4, 8)])
def test_cells_beyond_each_side_of_the_map(side: tuple[int, int]) -> None:
    """A submap of 9 x 9 cells in the middle of a map of 7 x 7."""
    grid = OccupancyGrid(cells=np.full((9, 9), -1), resolution_m=0.1, origin_m=(2.0, 3.0))
    sizes = validation.Sizes(
        scans=0, height=7, width=7, resolution_m=0.1, origin_x_m=2.0 + 0.1, origin_y_m=3.0 + 0.1
    )
    submap = Submap(submap_id=0, center_m=(2.45, 3.45), radius_m=0.4, grid=grid)
    inside = grid.cells.copy()
    inside[1:8, 1:8] = 0
    validation.check_submap(replace(submap, grid=replace(grid, cells=inside)), sizes)
    outside = grid.cells.copy()
    outside[side] = 0
    with pytest.raises(ValueError, match="it knows cells outside its map"):
        validation.check_submap(replace(submap, grid=replace(grid, cells=outside)), sizes)
    validation.check_submap(replace(submap, grid=replace(grid, cells=outside)), None)


def test_rounding_is_no_lie() -> None:
    """Deviations that rounding causes are accepted."""
    rng = np.random.default_rng(2)
    pairs, measured, accepted = np.array([[0, 5]]), np.zeros((1, 3)), np.ones(1, np.uint8)
    for scale in (1e-9, 1.0, 1e9):
        root = rng.normal(size=(3, 2))  # singular: one direction without information
        information = (root @ root.T)[None] * scale
        information[0, 0, 1] *= 1 + 1e-12
        validation.check_loops(pairs, measured, information, accepted, 6)
    turned = np.tile(np.eye(4), (1, 1, 1))
    turned[0, :3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned[0, :3, :3] *= np.sign(np.linalg.det(turned[0, :3, :3])) * (1 + 1e-6)
    validation.check_poses(turned)
    validation.check_stamps(np.array([5, 5, 6]))
    histograms = rng.dirichlet(np.ones(80), 1000).astype(np.float32)
    histograms[7] = 0
    validation.check_histograms(histograms, "boundary")


def test_recovering_keeps_what_can_be_true(place: Any, tmp_path: Path) -> None:
    craft(place, "loop", array("pairs", "<i4", 3, 7))
    with open_database(place) as database:
        assert database.leave_out_damaged() == ()  # a search reads no loops
    craft(place, "session", document(submaps=-3))
    with open_database(place) as database:
        (problem,) = database.leave_out_damaged()
        assert "session 1" in problem.where and "submaps is -3" in problem.what
        assert_holds(database, make_entry("tuesday", 1, submaps=5))
    target = tmp_path / "good.submaps"
    with pytest.raises(DatabaseCorrupt):
        maintenance.copy(place, target)
    assert len(maintenance.copy(place, target, recover=True)) == 2
    assert maintenance.check(target) == ()
    with open_database(target) as database:
        assert [info.name for info in database.sessions()] == ["tuesday"]


@pytest.mark.parametrize("width", [1, 20])
def test_histograms_of_other_widths_are_not_stretched(place: Any, width: int) -> None:
    """A single 1.0 would fill a row of any width, and two of wrong lengths the place of two right ones."""
    one = np.zeros(width, "<f4")
    one[0] = 1.0
    if isinstance(place, str):
        craft(place, "signature", put(boundary=one.tobytes()))
    else:
        craft(place, "signature", put(boundary=np.tile(one, 3).tobytes(), boundary_bins=width))
    with open_database(place) as database, pytest.raises(DatabaseCorrupt, match=r"bins|among others"):
        database.signatures()
    with open_database(place) as database, pytest.raises(DatabaseCorrupt, match=r"bins|among others"):
        database.nearest(make_entry("q", 99)[1][0], 5)


def test_signatures_out_of_order_and_far_away(file: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    for change, words in (
        (array("submap_id", "<i4", 1, 0), "submap 0 comes after submap 0"),
        (array("submap_id", "<i4", 0, -1), "signature 0 has a negative submap_id"),
        (array("center_m", "<f8", 5, 1e9), "signature 2 has a centre more than"),
        (put(name=b"\xff"), "name is of type bytes instead of text"),
    ):
        path.write_bytes(file)
        table = "session" if "name" in words else "signature"
        craft(path, table, change)
        with open_database(path) as database, pytest.raises(DatabaseCorrupt, match=words):
            READ[table](database)
        assert maintenance.check(path) != ()


def test_centres_that_contradict_each_other_are_found(place: Any) -> None:
    """The centre of a submap and that of its signature: each is plausible, but they differ."""
    if isinstance(place, str):
        craft(place, "signature", lambda row: {**row, "center_x_m": row["center_x_m"] + 0.01}, 1)
    else:
        craft(place, "signature", array("center_m", "<f8", 2, 0.4))
    (problem,) = maintenance.check(place)
    assert "monday" in problem.where and "submap 1 lies elsewhere than its signature says" in problem.what


def test_label_that_a_search_would_miss_is_refused() -> None:
    url = postgresql.new_database()
    maintenance.store(url, [make_entry("monday", 0)], keep=False)
    craft(url, "session", put(floor="2"))
    with open_database(url) as database, pytest.raises(DatabaseCorrupt, match="'2', but is of no label"):
        database.sessions()


def test_settings_of_a_newer_version_are_named_with_that_version(place: Any) -> None:
    craft(place, "session", document(versions={}, config={"partition": {"warp": 9}}))
    with open_database(place) as database, pytest.raises(DatabaseVersion, match="an unknown version"):
        database.sessions()


def test_signatures_that_their_settings_do_not_make_are_not_stored(place: Any) -> None:
    session_map, signatures, origin = make_entry("friday", 5)
    config = origin.config.model_copy(
        update={"partition": origin.config.partition.model_copy(update={"radius_m": 6.0})}
    )
    with pytest.raises(ValueError, match=r"histograms of 50 and .* where its settings make 60"):
        maintenance.store(place, [(session_map, signatures, replace(origin, config=config))], keep=True)


# --- anything at all ----------------------------------------------------------------------------------

ODD = (-1, 0, 1, 2**31 - 1, -(2**63), 0.5, 1e308, -1e308, INF, "", "a", "\0", b"", b"\xff" * 8)


def _read_everything(path: Path) -> None:
    with open_database(path) as database:
        for info in database.sessions():
            database.grid(info.name)
            assert all(way > 0 for *_, way in database.graph(info.name).edges(data="length_m"))
            trajectory = database.trajectory(info.name)
            assert all(loop.newer < len(trajectory) for loop in database.loops(info.name))
            assert np.isfinite(trajectory.T_session_base).all()
            for submap in database.submaps(info.name):
                assert np.isfinite(submap.center_m).all() and submap.grid.cells.max() <= 100
        table = database.signatures()
        assert np.isfinite(table.boundary).all() and (table.boundary >= 0).all()
        query = make_entry("q", 99)[1][0]
        assert all(np.isfinite(found.score) for found in database.nearest(query, 3))


def test_fuzz_any_value_in_any_column_with_a_right_checksum(file: bytes, tmp_path: Path) -> None:
    """Whatever a row holds: reading gives plausible content or raises DatabaseCorrupt."""
    path = tmp_path / "x.submaps"
    rng = np.random.default_rng(11)
    refused = read = 0
    for _ in range(min(FUZZ, 5000) or 150):
        table = str(rng.choice(list(schema.COLUMNS)))
        column = str(rng.choice([c for c in schema.COLUMNS[table] if c not in ("id", "session_id")]))

        def change(row: dict[str, Any], column: str = column) -> dict[str, Any]:
            value = row[column]
            if isinstance(value, bytes) and len(value) and rng.random() < 0.7:
                data = bytearray(value)
                for at in rng.integers(0, len(data), rng.integers(1, 9)):
                    data[at] = rng.integers(256)
                return {**row, column: bytes(data)}
            return {**row, column: ODD[rng.integers(len(ODD))]}

        path.write_bytes(file)
        with contextlib.suppress(sqlite3.IntegrityError):  # one submap's number for another
            craft(path, table, change)
        try:
            _read_everything(path)
            read += 1
        except DatabaseCorrupt as error:
            assert str(path) in error.message
            refused += 1
        maintenance.check(path)
    assert refused > read / 2
