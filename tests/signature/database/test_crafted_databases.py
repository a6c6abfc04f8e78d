"""Databases with right checksums and implausible content: refused by name, on every engine."""

from __future__ import annotations

import os
import re
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseVersion
from pc2grid.geometry import SE2
from pc2grid.model import Loop, Trajectory
from signature.boundary import boundary_bins
from signature.config import Config
from signature.database import maintenance, open_database, validation
from signature.database.codec import pack
from signature.database.maintenance import store as store_file
from signature.database.rows import SESSION_COLUMNS
from tests.helpers import postgresql
from tests.helpers.databases import Content, assert_holds, craft, make_entry, sql

FUZZ = int(os.environ.get("PC2GRID_FUZZ", "0"))
Change = Callable[[Content], Any]


def entry(name: str, index: Any, value: Any) -> Change:
    """Change entries of an array, counted in its flat form."""

    def change(content: Content) -> None:
        numbers = content.arrays[name].copy()
        numbers.reshape(-1)[index] = value
        content.arrays[name] = numbers

    return change


def array(name: str, value: Any) -> Change:
    """Another array, or another one as it is stored."""

    def change(content: Content) -> None:
        content.arrays[name] = value

    return change


def stored(name: str, **values: Any) -> Change:
    """Change how an array is stored: dtype, shape, data."""

    def change(content: Content) -> None:
        content.arrays[name] = pack(content.arrays[name])._replace(**values)

    return change


def without(name: str) -> Change:
    return lambda content: content.arrays.pop(name)


def document(**values: Any) -> Change:
    """Entries of a session's document, `grid__origin_m` for that of the grid."""

    def change(content: Content) -> None:
        for path, value in values.items():
            *outer, last = path.split("__")
            place = content.document
            for name in outer:
                place = place[name]
            place[last] = value

    return change


def row(**values: Any) -> Change:
    """Columns of a session's row."""
    return lambda content: content.row.update(values)


def info(**values: Any) -> Change:
    return document(**{f"info__{path}": value for path, value in values.items()})


NAN, INF = float("nan"), float("inf")
READ: dict[str, Callable[[Any], object]] = {
    "info": lambda database: database.sessions(),
    "grid": lambda database: database.grid("monday"),
    "trajectory": lambda database: database.trajectory("monday"),
    "loops": lambda database: database.loops("monday"),
    "graph": lambda database: database.graph("monday"),
    "points": lambda database: database.points("monday"),
    "seen": lambda database: database.seen_places("monday"),
    "submaps": lambda database: (database.signatures(), list(database.submaps("monday"))),
}
POSE, STEPS = 16, "points.steps"
CASES: list[tuple[str, Change, str]] = [
    ("trajectory", entry("trajectory.stamps_ns", 4, 5), "stamp 4 is earlier than the one before"),
    ("trajectory", entry("trajectory.stamps_ns", 0, 2**63 - 1), "stamp 1 is earlier"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE, 1.001), "pose 3 is not rigid"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 10, -1.0), "pose 3 is not rigid"),  # mirror
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 10, -0.99999), "pose 3 is not rigid"),
    ("trajectory", entry("trajectory.T_session_base", 6 * POSE + 5, 0.0), "pose 6 is not rigid"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 2, 1e200), "pose 3 is not rigid"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 15, 2.0), "pose 3 is not rigid"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 12, 1.0), "pose 3 is not rigid"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 3, NAN), "not finite"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 7, -INF), "not finite"),
    ("trajectory", entry("trajectory.T_session_base", 3 * POSE + 11, 1e9), "pose 3 is more than 1e\\+08 m"),
    ("trajectory", stored("trajectory.stamps_ns", shape="[8]"), "needs 64|hold the 64 bytes"),
    ("trajectory", stored("trajectory.stamps_ns", shape="[-1]"), "shape is -1 instead of a count"),
    ("trajectory", stored("trajectory.stamps_ns", shape="[7"), "JSONDecodeError"),
    ("trajectory", stored("trajectory.stamps_ns", shape="7"), "an array of int64 and the shape 7"),
    ("trajectory", stored("trajectory.stamps_ns", shape="[]"), r"and the shape \[\]"),
    ("trajectory", stored("trajectory.stamps_ns", shape="[7,true]"), "shape is True instead of a count"),
    ("trajectory", stored("trajectory.stamps_ns", dtype="object"), "an array of object"),
    ("trajectory", stored("trajectory.stamps_ns", dtype="uint64"), "an array of uint64"),
    ("trajectory", array("trajectory.stamps_ns", np.zeros(7)), "is of float64 instead of int64"),
    ("trajectory", array("trajectory.stamps_ns", np.zeros((7, 1), np.int64)), "expected shape"),
    ("trajectory", array("trajectory.T_session_base", np.zeros((6, 4, 4))), "expected shape"),
    ("trajectory", array("trajectory.health", np.full(7, 7, np.uint8)), "an unknown health"),
    ("trajectory", array("trajectory.health", np.zeros(1, np.uint8)), "expected 7 entries, got 1"),
    ("trajectory", array("trajectory.health", np.zeros((7, 1), np.uint8)), "an unknown health"),
    ("trajectory", without("trajectory.health"), "trajectory.health is missing"),
    ("trajectory", array("trajectory.speed", np.zeros(7)), "trajectory.speed is not one of its arrays"),
    ("trajectory", info(scans=8), "7 poses where 8 were stored"),
    ("loops", entry("loops.newer", 1, 7), "loop 1 is between poses 1 and 7 of 7"),
    ("loops", entry("loops.older", 1, -1), "loop 1 is between poses -1 and 5 of 7"),
    ("loops", entry("loops.older", 1, 5), "loop 1 is between poses 5 and 5 of 7"),
    ("loops", entry("loops.T_older_newer.yaw", 1, NAN), "not finite"),
    ("loops", entry("loops.T_older_newer.y", 2, -1e9), "loop 2 measures more than 1e\\+08 m"),
    ("loops", entry("loops.information", 9, INF), "not finite"),
    ("loops", entry("loops.information", 10, 1e6), "loop 1 has an information that is no inverse"),
    ("loops", entry("loops.information", 26, -1.0), "loop 2 has an information that is no inverse"),
    ("loops", entry("loops.information", 0, 1e16), "loop 0 has an information that is no inverse"),
    ("loops", stored("loops.accepted", data=b"\0\1\2"), "neither true nor false"),
    ("loops", array("loops.accepted", np.ones(2, np.bool_)), "where 3 were stored"),
    ("loops", array("loops.older", np.zeros((3, 1), np.int64)), "where 3 were stored"),
    ("loops", document(loops=4), "where 4 were stored"),
    ("loops", document(loops=-1), "loops is -1 instead of a count"),
    ("loops", document(loops="array"), "loops is 'array' instead of a count"),
    ("graph", entry("graph.edges", 3, 3), "edges: not that of a junction graph"),
    ("graph", entry("graph.edges", 0, -1), "edges: not that of a junction graph"),
    ("graph", entry("graph.edges", 3, 1), "edges: not that of a junction graph"),  # twice the same
    ("graph", entry("graph.kind", 2, 2), "kind: not that of a junction graph"),
    ("graph", entry("graph.pixels", 1, 0), "node 1 has less than one pixel"),
    ("graph", entry("graph.center_m", 2, NAN), "not finite"),
    ("graph", entry("graph.center_m", 4, 1.9), "node 2 lies outside its map"),
    ("graph", entry("graph.center_m", 1, 0.6), "node 0 lies outside its map"),
    ("graph", entry("graph.length_m", 1, -1.0), "length_m: not that of a junction graph"),
    ("graph", entry("graph.length_m", 1, 1e9), "edge 1 is longer than 1e\\+08 m"),
    ("graph", entry("graph.path_start", 1, 7), "path_start: not that of a junction graph"),
    ("graph", entry("graph.path_start", 2, 5), "path_start: not that of a junction graph"),
    ("graph", entry("graph.path_m", 7, 90.0), "point 3 lies outside its map"),
    ("graph", entry("graph.path_m", 9, INF), "not finite"),
    ("graph", stored("graph.path_m", shape="[7,2]"), "needs 56|hold the 56 bytes"),
    ("graph", stored("graph.path_m", shape="[1073741824,2]"), "an array of 8589934592 bytes, more than"),
    ("graph", array("graph.center_m", np.zeros((4, 2))), "expected shape"),
    ("graph", array("graph.length_m", np.ones(3)), "expected shape"),
    ("points", entry(STEPS, 3, -20 * 64), "a voxel outside 0"),
    ("points", entry(STEPS, 0, 2**21 * 64), "a voxel outside 0"),
    ("points", array(STEPS, np.zeros((40, 3), np.int32)), "voxel 1 is not after"),
    ("points", stored(STEPS, shape="[41,3]"), "hold the 492 bytes"),
    ("points", stored(STEPS, shape="[1073741824,3]"), "an array of 12884901888 bytes, more than"),
    ("points", stored(STEPS, shape="[100000000,3]"), "hold the 1200000000 bytes"),
    ("points", array(STEPS, np.zeros((40, 2), np.int32)), "expected shape"),
    ("points", document(points__voxel_m=0.0), "voxel_m is 0"),
    ("points", entry("points.origin_m", 2, INF), "not finite"),
    ("points", entry("points.origin_m", 2, 1e9), "origin 0 is more than"),
    ("points", document(points=None), "points.origin_m is not one of its arrays"),
    ("seen", array("seen.place", np.array([0, 2])), "expected shape"),
    ("seen", array("seen.signatures", np.zeros((4, 111), np.uint8)), "expected shape"),
    ("seen", entry("seen.place", 0, 5), "do not belong to 3 places, in their order"),
    ("seen", entry("seen.at_m", 0, INF), "not finite"),
    ("seen", entry("seen.at_m", 0, 1e9), "viewpoint 0 is more than"),
    ("grid", document(grid__resolution_m=1e-9), "resolution_m is 1e-09 instead of a number in 0.001..100"),
    ("grid", document(grid__resolution_m=1e6), "resolution_m is 1000000.0 instead"),
    ("grid", document(grid__resolution_m=-0.05), "resolution_m is -0.05 instead"),
    ("grid", document(grid__resolution_m=INF), "resolution_m is inf instead"),
    ("grid", document(grid__resolution_m=0.06), "resolution_m is 0.06 where 0.05 was stored"),
    ("grid", document(grid__origin_m=[INF, 0.0]), "origin_m is inf"),
    ("grid", document(grid__origin_m=[0.0, -1e9]), "origin_m is -1000000000.0"),
    ("grid", document(grid__origin_m=[0.0]), "instead of 2 values"),
    ("grid", document(grid__origin_m=0.0), "origin_m is 0.0 instead of a list"),
    ("grid", document(grid__cells=None), "grid.cells is None instead of an array"),
    ("grid", document(grid__floors=2), "grid: unknown floors"),
    ("grid", stored("grid.cells", shape="[-40,-60]"), "shape is -40 instead of a count"),
    ("grid", stored("grid.cells", shape="[1073741824,1073741824]"), "bytes, more than 1200000000"),
    ("grid", stored("grid.cells", data=b"junk"), "compressed data: "),
    ("grid", stored("grid.cells", data=zlib.compress(bytes(2399))), "does not hold the 2400 bytes"),
    ("grid", stored("grid.cells", data=zlib.compress(bytes(2400)) + b"more"), "does not hold the 2400 bytes"),
    ("grid", stored("grid.cells", data=zlib.compress(bytes(2401))), "does not hold the 2400 bytes"),
    ("grid", stored("grid.cells", data=bytes(2401)), "2401 bytes where .* needs 2400"),
    ("grid", entry("grid.cells", 5, 101), "a cell outside -1..100"),
    ("grid", entry("grid.cells", 5, -2), "a cell outside -1..100"),
    ("submaps", entry("submaps.center_m", 0, INF), "not finite"),
    ("submaps", entry("submaps.center_m", 5, 1e9), "submap 2 is more than"),
    ("submaps", entry("submaps.center_m", 0, 90.0), "submap 0 lies outside its map"),
    ("submaps", entry("submaps.center_m", 3, -90.0), "submap 1 lies outside its map"),
    ("submaps", entry("submaps.submap_id", 0, -1), "submap_id is -1 instead of a count"),
    ("submaps", entry("submaps.submap_id", 1, 0), "submap 0 comes after submap 0"),
    ("submaps", entry("submaps.boundary", 3, -0.5), "boundary histogram 0 has sum "),
    ("submaps", entry("submaps.boundary", slice(0, 50), 0.5), "boundary histogram 0 has sum 25 instead of"),
    ("submaps", entry("submaps.boundary", 0, NAN), "not finite"),
    ("submaps", entry("submaps.freespace", 0, INF), "not finite"),
    ("submaps", entry("submaps.freespace", slice(0, 3), [-2, 1, 2]), "freespace histogram 0"),
    ("submaps", entry("submaps.boundary", slice(0, 50), [-1, 2] + 48 * [0]), "0 has a negative share"),
    ("submaps", entry("submaps.symmetry", 0, -1), "submap 0 has a symmetry score below 0"),
    ("submaps", array("submaps.symmetry", np.zeros((3, 3), np.float32)), "expected shape"),
    ("submaps", array("submaps.boundary", np.zeros((2, 50), np.float32)), "expected shape"),
    ("submaps", info(submaps=4), "3 submaps where 4 were stored"),
    ("info", info(submaps=-3), "submaps is -3 instead of a count"),
    ("info", info(submaps="many"), "submaps is 'many' instead of a count"),
    ("info", info(submaps=True), "submaps is True instead of a count"),
    ("info", info(submaps=10**400), "submaps is 1000"),
    ("info", info(area_m2=NAN), "area_m2 is nan instead of a number"),
    ("info", info(path_m=-1.0), "path_m is -1.0 instead of a number"),
    ("info", info(duration_s=INF), "duration_s is inf"),
    ("info", info(provenance__start_s="0"), "start_s is '0' instead"),
    ("info", info(provenance__duration_s=[]), "duration_s is of type list instead"),
    ("info", info(provenance__digest=None), "digest is None instead of text"),
    ("info", info(provenance__versions={"numpy": 2}), "numpy is 2 instead of text"),
    ("info", info(provenance__versions=[]), "versions is of type list instead of an object"),
    ("info", info(provenance__source=7), "source is 7 instead of text"),
    ("info", info(report__scans_read=1.5), "scans_read is 1.5 instead of a count"),
    ("info", info(report__bytes_lost=-1), "bytes_lost is -1"),
    ("info", info(report__scans_skipped={"late": -1}), "late is -1"),
    ("info", info(report__warnings=[3]), "warnings is 3 instead of text"),
    ("info", info(report=None), "report is None instead of an object"),
    ("info", info(consistency__bent=1), "bent is 1 instead of true or false"),
    ("info", info(consistency__contradicted=1.5), "contradicted is 1.5 instead of a number in 0..1"),
    ("info", info(consistency__stretches=[{}]), "stretches: has no from_ns"),
    ("info", info(precision__stamps_ns=[0, 2**63]), "stamps_ns is 9223372036854775808"),
    ("info", info(consistency=[]), "consistency is of type list instead of an object"),
    ("info", info(precision__sigma_m=[-1.0, 0.1]), "sigma_m is -1.0 instead of a number"),
    ("info", info(precision__sigma_m=[0.1]), "expected as many stamps as sigmas"),
    ("info", info(precision__loose=[{}]), "loose: has no from_ns"),
    ("info", info(odometry__overruled=-1), "overruled is -1"),
    ("info", info(odometry__stretches=[{}]), "stretches: has no distance_m"),
    ("info", info(provenance__label__floor=2), "floor is 2 instead of text"),
    ("info", info(mood="fair"), "info: unknown mood"),
    ("info", info(name="tuesday"), "filed as 'monday', '', '', but is 'tuesday'"),
    ("info", row(floor="2"), "filed as 'monday', '', '2', but is 'monday' of no label"),
    ("info", row(document="[]"), "the document has no info"),
    ("info", row(document="{}"), "the document has no info"),
    ("info", row(document="{"), "JSONDecodeError"),
    ("info", row(document="[" * 100_000), "RecursionError"),
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


@pytest.mark.parametrize(("part", "change", "words"), CASES)
def test_what_cannot_be_true_is_refused_by_name(place: Any, part: str, change: Change, words: str) -> None:
    craft(place, change)
    where = "session 1" if part == "info" else f"{part}.* of session 'monday'"
    with open_database(place) as database:
        with pytest.raises(DatabaseCorrupt, match=words) as caught:
            READ[part](database)
        assert re.search(f"damaged: {where}: ", caught.value.message)
        assert "checksum" not in caught.value.message
    problems = maintenance.check(place)
    # The crafted row is all that is wrong: the rest is read, checked and copied as ever.
    assert any(re.match(where, problem.where) for problem in problems), problems
    assert all("1" in problem.where or "monday" in problem.where for problem in problems), problems
    if part in ("loops", "graph", "points", "seen"):  # the others are what a search rests on
        with open_database(place) as database:
            assert len(database.signatures()) == 8


def test_rounding_is_no_lie() -> None:
    """Deviations that rounding causes are accepted."""
    rng = np.random.default_rng(2)
    for scale in (1e-9, 1.0, 1e9):
        root = rng.normal(size=(3, 2))  # singular: one direction without information
        information = root @ root.T * scale
        information[0, 1] *= 1 + 1e-12
        loop = Loop(older=0, newer=5, T_older_newer=SE2(), information=information)
        validation.check_loops((loop,), 6)
    turned = np.tile(np.eye(4), (3, 1, 1))
    turned[0, :3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned[0, :3, :3] *= np.sign(np.linalg.det(turned[0, :3, :3])) * (1 + 1e-6)
    validation.check_trajectory(Trajectory(stamps_ns=np.array([5, 5, 6]), T_session_base=turned))
    histograms = rng.dirichlet(np.ones(80), 1000).astype(np.float32)
    histograms[7] = 0
    validation.check_histograms(histograms, "boundary")


def test_recovering_keeps_what_can_be_true(place: Any, tmp_path: Path) -> None:
    craft(place, entry("loops.newer", 1, 7))
    with open_database(place) as database:
        assert database.leave_out_damaged() == ()  # a search reads no loops
    craft(place, info(submaps=-3))
    with open_database(place) as database:
        (problem,) = database.leave_out_damaged()
        assert "session 1" in problem.where and "submaps is -3" in problem.what
        assert_holds(database, make_entry("tuesday", 1, submaps=5))
    target = tmp_path / "good.submaps"
    with pytest.raises(DatabaseCorrupt):
        maintenance.copy(place, target)
    assert len(maintenance.copy(place, target, recover=True)) == 1
    assert maintenance.check(target) == ()
    with open_database(target) as database:
        assert [info.name for info in database.sessions()] == ["tuesday"]


@pytest.mark.parametrize("width", [1, 20])
def test_histograms_of_other_widths_are_not_stretched(place: Any, width: int) -> None:
    """Each has a sum of 1, so only their number tells."""
    one = np.zeros((3, width), np.float32)
    one[:, 0] = 1.0
    craft(place, array("submaps.boundary", one))
    with open_database(place) as database, pytest.raises(DatabaseCorrupt, match="bins where its settings"):
        database.signatures()


def test_sessions_whose_settings_differ_are_not_searched_together(place: Any) -> None:
    """Each is sound by itself; a writer would not have put them into one database."""
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    other, bins = config.model_dump(mode="json"), boundary_bins(config.partition.radius_m, config.signature)
    craft(place, info(provenance__config=other), session_id=2)
    craft(place, array("submaps.boundary", np.full((5, bins), 1 / bins, np.float32)), session_id=2)
    assert maintenance.check(place) == ()
    with (
        open_database(place) as database,
        pytest.raises(DatabaseCorrupt, match=r"'tuesday'.* bins"),
    ):
        database.signatures()


def test_a_name_that_is_no_text(file: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    path.write_bytes(file)
    craft(path, row(name=b"\xff"))
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match="name is of type bytes"):
        database.sessions()
    assert maintenance.check(path) != ()


def test_arrays_of_no_session_and_of_no_part_are_found(file: bytes, tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    path.write_bytes(file)
    craft(path, array("mood", np.zeros(3)))
    craft(path, array("info.mood", np.zeros(3)), session_id=2)
    assert [(problem.where, problem.what) for problem in maintenance.check(path)] == [
        ("mood of session 'monday'", "no part of a session"),
        ("info.mood of session 'tuesday'", "no part of a session"),
    ]
    # Neither a search nor a copy needs them.
    with open_database(path) as database:
        assert database.leave_out_damaged() == ()
    good = tmp_path / "good.submaps"
    assert len(maintenance.copy(path, good, recover=True)) == 2
    assert maintenance.check(good) == ()
    with open_database(good) as database:
        assert_holds(database, make_entry("monday", 0))
        assert_holds(database, make_entry("tuesday", 1, submaps=5))
    sql(path, "DELETE FROM session WHERE id = 1")
    assert ("arrays of session 1", "belong to no session") in [
        (problem.where, problem.what) for problem in maintenance.check(path)
    ]


def test_settings_of_a_newer_version_are_named_with_that_version(place: Any) -> None:
    craft(place, info(provenance__versions={}, provenance__config={"partition": {"warp": 9}}))
    with open_database(place) as database, pytest.raises(DatabaseVersion, match="an unknown version"):
        database.sessions()


def test_submaps_and_signatures_that_their_settings_do_not_make_are_not_stored(place: Any) -> None:
    session_map, signatures, origin = make_entry("friday", 5)
    config = origin.config.model_copy(
        update={"partition": origin.config.partition.model_copy(update={"radius_m": 6.0})}
    )
    entry = session_map, signatures, replace(origin, config=config)
    with pytest.raises(ValueError, match="submap 0 has the radius 5 m where its settings make 6 m"):
        maintenance.store(place, [entry], keep=True)
    submaps = tuple(replace(submap, radius_m=6.0) for submap in session_map.submaps)
    entry = replace(session_map, submaps=submaps), signatures, replace(origin, config=config)
    with pytest.raises(ValueError, match=r"histograms of 50 and .* where its settings make 60"):
        maintenance.store(place, [entry], keep=True)


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
            points = database.points(info.name)
            assert points is None or np.isfinite(points.points_m()).all()
            database.seen_places(info.name)
        table = database.signatures()
        assert np.isfinite(table.boundary).all() and (table.boundary >= 0).all()


def test_fuzz_any_value_in_any_column_with_a_right_checksum(file: bytes, tmp_path: Path) -> None:
    """Whatever a row holds: reading gives plausible content or raises DatabaseCorrupt."""
    path = tmp_path / "x.submaps"
    path.write_bytes(file)
    names = [name for (name,) in sql(path, 'SELECT name FROM "array" WHERE session_id = 1')]
    rng = np.random.default_rng(11)
    refused = read = 0

    def other(value: Any) -> Any:
        """A value with bytes changed, or any value."""
        if isinstance(value, bytes | str) and len(value) and rng.random() < 0.7:
            data = bytearray(value.encode() if isinstance(value, str) else value)
            for at in rng.integers(0, len(data), rng.integers(1, 9)):
                data[at] = rng.integers(256)
            return bytes(data) if isinstance(value, bytes) else data.decode("latin1")
        return ODD[rng.integers(len(ODD))]

    for _ in range(min(FUZZ, 5000) or 150):

        def change(content: Content) -> None:
            column = str(rng.choice([*SESSION_COLUMNS[2:], *["data"] * 10, "dtype", "shape", "name"]))
            if column in ("floor", "document") or (column == "name" and rng.random() < 0.5):
                content.row[column] = other(content.row[column])
                return
            array = str(rng.choice(names))
            packed = pack(content.arrays[array])
            if column == "name":
                content.arrays[other(array)] = content.arrays.pop(array)
            else:
                content.arrays[array] = packed._replace(**{column: other(getattr(packed, column))})

        path.write_bytes(file)
        craft(path, change)
        try:
            _read_everything(path)
            read += 1
        except (DatabaseCorrupt, DatabaseVersion) as error:
            assert str(path) in error.message
            refused += 1
        maintenance.check(path)
    assert refused > read / 2
