"""Databases with right checksums and implausible content: refused by name, whatever a row holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseVersion
from pc2grid.model import Trajectory
from signature.boundary import boundary_bins
from signature.config import Config
from signature.database import document as validation
from signature.database import maintenance, open_database
from signature.database.rows import SESSION_COLUMNS
from tests.helpers.databases import READ_PART, TUESDAY, Content, assert_holds, craft, make_entry, sql

FUZZ = int(os.environ.get("PC2GRID_FUZZ", "0"))
Change = Callable[[Content], Any]


def entry(path: str, index: Any, value: Any) -> Change:
    """Change entries of the array `part.name`, counted in its flat form."""

    def change(content: Content) -> None:
        part, name = path.split(".")
        arrays = content.parts[part][1]
        arrays[name] = arrays[name].copy()
        arrays[name].reshape(-1)[index] = value

    return change


def array(path: str, value: Any) -> Change:
    """Another array."""
    part, name = path.split(".")
    return lambda content: content.parts[part][1].update({name: value})


def without(path: str) -> Change:
    part, name = path.split(".")
    return lambda content: content.parts[part][1].pop(name)


def document(path: str, value: Any) -> Change:
    """A value in the document of a part, `grid.origin_m`, or in that of the session, `info.report.lossy`."""

    def change(content: Content) -> None:
        part, *outer, last = path.split(".")
        place = content.document if part == "info" else content.parts[part][0]
        for name in outer:
            place = place[int(name) if isinstance(place, list) else name]
        place[int(last) if isinstance(place, list) else last] = value

    return change


def whole(part: str, value: Any) -> Change:
    """Another document and arrays of a part, or other bytes."""
    return lambda content: content.parts.update({part: value})


def row(**values: Any) -> Change:
    """Columns of a session's row."""
    return lambda content: content.row.update(values)


NAN, INF = float("nan"), float("inf")
READ: dict[str, Callable[[Any], object]] = {
    "info": lambda database: database.sessions(),
    **READ_PART,
    "submaps": lambda database: (database.signatures(), list(database.submaps("monday"))),
    "frame": lambda database: database.frames(),
}
POSES, STEPS, FLAT = "trajectory.T_session_base", "points.steps", slice(0, 50)
CASES: list[tuple[Change, str]] = [
    (entry("trajectory.stamps_ns", 4, 5), "trajectory: the stamp after 3 is earlier"),
    (entry(POSES, 48, 1.001), "trajectory: pose 3 is not rigid"),
    (entry(POSES, 48 + 10, -1.0), "trajectory: pose 3 is not rigid"),  # a mirror
    (entry(POSES, 48 + 15, 2.0), "trajectory: pose 3 is not rigid"),
    (entry(POSES, 48 + 3, NAN), "trajectory: .* not finite"),
    (entry(POSES, 48 + 11, 1e9), "trajectory: pose 3 is more than 1e\\+08 m"),
    (array(POSES, np.zeros((6, 4, 4))), "trajectory: .*expected shape"),
    (without(POSES), "trajectory: T_session_base: Field required"),
    (array("trajectory.speed", np.zeros(7)), "trajectory: speed: Unexpected"),
    (document("trajectory.health", ["fine"] * 6 + ["gone"]), "trajectory: health.6: Input should be"),
    (document("trajectory.health", ["fine"]), "trajectory: .*expected 7 entries, got 1"),
    (document("info.scans", 8), "trajectory: 7 poses where 8 were stored"),
    (document("loops.1.newer", 7), "loops: loop 1 is not between two of 7 poses"),
    (document("loops.1.older", -1), "loops: loop 1 is not between two of 7 poses"),
    (document("loops.1.T_older_newer.yaw", NAN), "loops: 1.T_older_newer.yaw: .* finite number"),
    (document("loops.1.information", [1.0]), "loops: 1: .*expected shape"),
    (whole("loops", ({}, {})), "loops: Input should be a valid tuple"),
    (entry("graph.edges", 3, 3), "graph: .*edges: not that of a junction graph"),
    (entry("graph.kind", 2, 2), "graph: .*kind: not that of a junction graph"),
    (entry("graph.center_m", 4, 1.9), "graph: node 2 lies outside its map"),
    (entry("graph.length_m", 1, -1.0), "graph: .*length_m: not that of a junction graph"),
    (entry("graph.path_start", 1, 7), "graph: .*path_start: not that of a junction graph"),
    (entry(STEPS, 3, -20 * 64), "points: a voxel outside 0"),
    (entry(STEPS, 0, 2**21 * 64), "points: a voxel outside 0"),
    (array(STEPS, np.zeros((40, 3), np.int32)), "points: the voxel after 0 is not after it"),
    (document("points.voxel_m", 0.0), "points: cells of 0 m"),
    (entry("points.origin_m", 2, 1e9), "points: origin 0 is more than"),
    (array("seen.signatures", np.zeros((4, 111), np.uint8)), "seen: .*expected shape"),
    (array("seen.signatures", np.zeros((3, 110), np.uint8)), "seen: signatures of 110 columns"),
    (entry("seen.place", 0, 5), "seen: viewpoints that do not belong to 3 places"),
    (document("grid.resolution_m", 1e-9), "grid: cells of 1e-09 m instead of 0.001..100"),
    (document("grid.resolution_m", 0.06), "grid: resolution_m is 0.06 where 0.05 was stored"),
    (document("grid.origin_m", [INF, 0.0]), "grid: origin_m.0: .* finite number"),
    (document("grid.origin_m", [0.0, -1e9]), "grid: corner 0 is more than"),
    (document("grid.origin_m", [0.0]), "grid: origin_m.1: Field required"),
    (document("grid.floors", 2), "grid: floors: Unexpected"),
    (entry("grid.cells", 5, 101), "grid: a cell outside -1..100"),
    (whole("grid", (None, {})), "grid: is not there"),
    (whole("grid", b"junk"), "grid: BadZipFile"),
    (entry("submaps.center_m", 3, -90.0), "submaps: submap 1 lies outside its map"),
    (entry("submaps.submap_id", 0, -1), "submaps: the number of submap 0 does not increase"),
    (entry("submaps.submap_id", 1, 0), "submaps: the number of submap 1 does not increase"),
    (entry("submaps.boundary", FLAT, 0.5), "submaps: boundary histogram 0 does not have the sum 1"),
    (entry("submaps.boundary", FLAT, [-1, 2] + 48 * [0]), "boundary histogram 0 has a negative share"),
    (entry("submaps.freespace", 0, INF), "submaps: .*not finite"),
    (array("submaps.boundary", np.eye(3, 20, dtype=np.float32)), "submaps: .* bins where its settings"),
    (document("info.submaps", 4), "submaps: 3 submaps where 4 were stored"),
    (document("info.submaps", "many"), "info: submaps: Input should be a valid integer"),
    (document("info.area_m2", NAN), "info: area_m2: .*"),
    (document("info.provenance.source", 7), "info: provenance.source: Input should be a valid string"),
    (document("info.precision.sigma_m", [0.1]), "info: precision: .*as many stamps as sigmas"),
    (document("info.mood", "fair"), "info: mood: Unexpected"),
    (document("info.name", "tuesday"), "info: filed as 'monday', '', '', but is 'tuesday'"),
    (row(floor="2"), "info: filed as 'monday', '', '2', but is 'monday' of no label"),
    (row(document="null"), "info: a document without content"),
    (row(document="{"), "info: Invalid JSON"),
    (row(document="[" * 100_000), "info: Invalid JSON"),
    (whole("frame", ({"name": 3}, {})), "frame: name: Input should be a valid string"),
]


@pytest.mark.parametrize(("change", "words"), CASES)
def test_what_cannot_be_true_is_refused_by_name(path: Path, change: Change, words: str) -> None:
    part = words.partition(":")[0] if ": " in words else "submaps"
    craft(path, change)
    where = "session 1" if part == "info" else f"{part} of session 'monday'"
    with open_database(path) as database:
        with pytest.raises(DatabaseCorrupt, match=words.removeprefix(f"{part}: ")) as caught:
            READ[part](database)
        assert f"damaged: {where}: " in caught.value.message
        assert "checksum" not in caught.value.message
    problems = maintenance.check(path)
    # The crafted row is all that is wrong: the rest is read, checked and copied as ever.
    assert any(problem.where == where for problem in problems), problems
    assert all("1" in problem.where or "monday" in problem.where for problem in problems), problems
    if part in ("loops", "graph", "points", "seen"):  # the others are what a search rests on
        with open_database(path) as database:
            assert len(database.signatures()) == 8


def test_rounding_is_no_lie() -> None:
    """Deviations that rounding causes are accepted."""
    rng = np.random.default_rng(2)
    turned = np.tile(np.eye(4), (3, 1, 1))
    turned[0, :3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned[0, :3, :3] *= np.sign(np.linalg.det(turned[0, :3, :3])) * (1 + 1e-6)
    three: Any = SimpleNamespace(scans=3)
    validation.check_trajectory(Trajectory(stamps_ns=np.array([5, 5, 6]), T_session_base=turned), three)
    histograms = rng.dirichlet(np.ones(80), 1000).astype(np.float32)
    histograms[7] = 0
    validation.check_histograms(histograms, "boundary")


def test_recovering_keeps_what_can_be_true(place: str | Path, tmp_path: Path) -> None:
    craft(place, document("loops.1.newer", 7))
    with open_database(place) as database:
        assert database.leave_out_damaged() == ()  # a search reads no loops
    craft(place, document("info.submaps", None))
    with open_database(place) as database:
        (problem,) = database.leave_out_damaged()
        assert "session 1" in problem.where and "submaps" in problem.what
        assert_holds(database, TUESDAY)
    target = tmp_path / "good.submaps"
    with pytest.raises(DatabaseCorrupt):
        maintenance.copy(place, target)
    assert len(maintenance.copy(place, target, recover=True)) == 1
    assert maintenance.check(target) == ()
    with open_database(target) as database:
        assert [info.name for info in database.sessions()] == ["tuesday"]


def test_sessions_whose_settings_differ_are_not_searched_together(path: Path) -> None:
    """Each is sound by itself; a writer would not have put them into one database."""
    config = Config.model_validate({"signature": {"boundary_bin_m": 0.3}})
    other, bins = config.model_dump(mode="json"), boundary_bins(config.partition.radius_m, config.signature)
    craft(path, document("info.provenance.config", other), session_id=2)
    craft(path, array("submaps.boundary", np.full((5, bins), 1 / bins, np.float32)), session_id=2)
    assert maintenance.check(path) == ()
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match=r"'tuesday'.* bins"):
        database.signatures()


def test_submaps_and_signatures_that_their_settings_do_not_make_are_not_stored(path: Path) -> None:
    session_map, signatures, origin = make_entry("friday", 5)
    wide = origin.config.partition.model_copy(update={"radius_m": 6.0})
    origin = replace(origin, config=origin.config.model_copy(update={"partition": wide}))
    with pytest.raises(ValueError, match="submap 0 has the radius 5 m where its settings make 6 m"):
        maintenance.store(path, [(session_map, signatures, origin)], keep=True)
    submaps = tuple(replace(submap, radius_m=6.0) for submap in session_map.submaps)
    with pytest.raises(ValueError, match=r"histograms of 50 and .* where its settings make 60"):
        maintenance.store(path, [(replace(session_map, submaps=submaps), signatures, origin)], keep=True)


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


def test_fuzz_any_value_in_any_column_with_a_right_checksum(two: bytes, path: Path) -> None:
    """Whatever a row holds: reading gives plausible content or raises DatabaseCorrupt."""
    names = [name for (name,) in sql(path, "SELECT name FROM part WHERE session_id = 1")]
    blobs = dict(sql(path, "SELECT name, data FROM part WHERE session_id = 1"))
    rng = np.random.default_rng(11)
    refused = read = 0

    def changed(data: bytes) -> bytes:
        """The same length with bytes changed."""
        found = np.frombuffer(data, np.uint8).copy()
        at = rng.integers(0, len(found), rng.integers(1, 9)) if len(found) else []
        found[at] = rng.integers(0, 256, len(at))
        return found.tobytes()

    def other(value: Any) -> Any:
        """A value with bytes changed, or any value."""
        if isinstance(value, str) and value and rng.random() < 0.7:
            return changed(value.encode()).decode("latin1")
        return ODD[rng.integers(len(ODD))]

    def odd_array(content: Content) -> None:
        """Bytes changed in an array whose own checksum is right as well."""
        arrays = content.parts[str(rng.choice(["grid", "trajectory", "graph", "points", "submaps", "seen"]))][
            1
        ]
        name = str(rng.choice(sorted(arrays)))
        was = arrays[name]
        arrays[name] = np.frombuffer(changed(was.tobytes()), was.dtype).reshape(was.shape)

    def change(content: Content) -> None:
        kind = rng.random()
        if kind < 0.3:
            column = str(rng.choice(SESSION_COLUMNS[2:]))
            content.row[column] = other(content.row[column])
        elif kind < 0.5:
            name = str(rng.choice(names))
            content.parts[other(name)] = content.parts.pop(name)
        elif kind < 0.7:
            name = str(rng.choice(names))
            content.parts[name] = changed(blobs[name])
        else:
            odd_array(content)

    for _ in range(min(FUZZ, 5000) or 40):
        path.write_bytes(two)
        craft(path, change)
        try:
            _read_everything(path)
            read += 1
        except (DatabaseCorrupt, DatabaseVersion) as error:
            assert str(path) in error.message
            refused += 1
        maintenance.check(path)
    assert refused > read / 2


def test_a_name_that_is_no_text(path: Path) -> None:
    craft(path, row(name=b"\xff"))
    with open_database(path) as database, pytest.raises(DatabaseCorrupt, match="filed as"):
        database.sessions()
    assert "session 1" in maintenance.check(path)[0].where
