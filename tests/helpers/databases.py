"""Databases for tests: sessions with random content, and what must come out of a database again."""

import contextlib
import hashlib
import io
import json
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import (
    Consistency,
    Contradiction,
    Health,
    Loop,
    OccupancyGrid,
    OdometryCheck,
    OdometryOutlier,
    PointMap,
    Precision,
    ReadReport,
    SessionMap,
    Trajectory,
    UncertainSegment,
)
from pc2grid.submaps.submaps import view_at
from signature.boundary import boundary_bins
from signature.config import Config
from signature.database import Label, Provenance, SubmapDatabase, open_database
from signature.database.database import PART_COLUMNS, SESSION_COLUMNS
from signature.database.document import row_crc, unpack
from signature.database.protocol import Entry
from signature.freespace import freespace_bins
from signature.paper import Signature
from signature.sessions import add_sessions, provenance
from tests.helpers import postgresql


def make_entry(name: str = "monday", seed: int = 0, submaps: int = 3, config: Config | None = None) -> Entry:
    """A session of random cells and signatures, with a trajectory of seven poses and three loops."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(np.array([-1, 0, 100, 37], np.int8), size=(40, 60))
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-1.25, 2.0 / 3.0))
    poses = np.stack([SE2(0.1 * i, 0.01 * i * i, 0.02 * i).lift() for i in range(7)])
    trajectory = Trajectory(
        stamps_ns=np.arange(7, dtype=np.int64) * 100_000_000 + 1_700_000_000_000_000_001,
        T_session_base=poses,
        health=(Health.FINE, Health.DEGENERATE, *[Health.FINE] * 4, Health.LOST),
    )
    config = config or Config()
    centers = [(0.1 * i % 1.4 + 1 / 3, 0.2 * i % 1.9 + 0.7) for i in range(submaps)]
    parts = tuple(view_at(grid, center, config.partition, submap_id=i) for i, center in enumerate(centers))
    bins = [f(config.partition.radius_m, config.signature) for f in (boundary_bins, freespace_bins)]
    signatures = [
        Signature(
            boundary=rng.dirichlet(np.ones(bins[0])),
            freespace=rng.dirichlet(np.ones(bins[1])),
            symmetry=rng.random(2),
        )
        for _ in parts
    ]
    t = trajectory.stamps_ns.tolist()
    session_map = SessionMap(
        session=name,
        sensor="lidar",
        grid=grid,
        submaps=parts,
        trajectory=trajectory,
        loops=tuple(
            Loop(
                older=k, newer=6 - k, T_older_newer=SE2(*(rng.random(3) / 3).tolist()),
                information=np.diag(rng.random(3) * 1e4), accepted=k != 1,
            )
            for k in range(3)
        ),
        odometry=OdometryCheck(
            compared=9, overruled=2,
            stretches=(OdometryOutlier(from_ns=10**9, to_ns=2 * 10**9, distance_m=0.3, turn_rad=0.5),),
        ),
        consistency=Consistency(
            hits_on_free=1 / 7, contradicted=0.25, bent=True,
            stretches=(
                Contradiction(from_ns=t[2], to_ns=t[4], x_m=0.3, y_m=-0.1, length_m=2 / 3, share=0.5),
            ),
        ),
        precision=Precision(
            stamps_ns=(t[0], t[-1]), sigma_m=(0.05, 0.7),
            loose=(
                UncertainSegment(
                    from_ns=t[3], to_ns=t[-1], x_m=1 / 3, y_m=-0.2, length_m=5.5, sigma_m=0.7
                ),
            ),
        ),
        points=PointMap.of(rng.uniform(-1.0, 1.0, (40, 3)), 0.1),
        report=ReadReport(scans_read=7, warnings=("no per-point time",)),
    )  # fmt: skip
    digest = hashlib.sha256(f"{name}{seed}".encode()).hexdigest()
    origin = Provenance(source=f"{name}.mcap", digest=digest, config=config, versions={"pc2grid": "0.1.0"})
    return session_map, signatures, origin


MONDAY, TUESDAY = make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)
READ_PART: dict[str, Callable[[Any], object]] = {
    "grid": lambda database: database.grid("monday"),
    "trajectory": lambda database: database.trajectory("monday"),
    "loops": lambda database: database.loops("monday"),
    "points": lambda database: database.points("monday"),
    "seen": lambda database: database.seen_places("monday"),
    "submaps": lambda database: (list(database.submaps("monday")), database.signatures()),
    "frame": lambda database: database.frames(),
}
"""What reads a part of the session "monday"."""


def assert_holds(database: SubmapDatabase, entry: Entry) -> None:
    """The database gives back what was stored."""
    session_map, signatures, origin = entry
    name = session_map.session
    index = [info.name for info in database.sessions()].index(name)
    info = database.sessions()[index]
    assert (info.provenance.digest, info.provenance.config, info.submaps) == (
        origin.digest,
        origin.config,
        len(signatures),
    )
    assert info.report.warnings == session_map.report.warnings
    grid = database.grid(name)
    assert np.array_equal(grid.cells, session_map.grid.cells)
    assert (grid.resolution_m, grid.origin_m) == (session_map.grid.resolution_m, session_map.grid.origin_m)
    trajectory = database.trajectory(name)
    assert np.array_equal(trajectory.stamps_ns, session_map.trajectory.stamps_ns)
    assert np.array_equal(trajectory.T_session_base, session_map.trajectory.T_session_base)
    assert trajectory.health == session_map.trajectory.health
    assert info.consistency == session_map.consistency
    assert info.precision == session_map.precision
    assert info.odometry == session_map.odometry
    places = np.unique(database.seen_places(name).place)
    assert np.array_equal(places, np.arange(len(session_map.submaps)))
    points, wanted_points = database.points(name), session_map.points
    assert (points is None) == (wanted_points is None)
    if points is not None and wanted_points is not None:
        assert points.voxel_m == wanted_points.voxel_m
        assert np.array_equal(points.origin_m, wanted_points.origin_m)
        assert np.array_equal(points.steps, wanted_points.steps)
    for loop, stored_loop in zip(session_map.loops, database.loops(name), strict=True):
        assert np.array_equal(stored_loop.information, loop.information)
        assert (stored_loop.older, stored_loop.newer) == (loop.older, loop.newer)
        assert (stored_loop.T_older_newer, stored_loop.accepted) == (loop.T_older_newer, loop.accepted)
    for wanted, got in zip(session_map.submaps, database.submaps(name), strict=True):
        assert (got.submap_id, got.center_m, got.radius_m) == (
            wanted.submap_id,
            wanted.center_m,
            wanted.radius_m,
        )
        assert np.array_equal(got.grid.cells, wanted.grid.cells)
    table = database.signatures()
    mine = table.session_index == index
    for field in ("boundary", "freespace", "symmetry"):
        stored = getattr(table, field)[mine]
        assert np.array_equal(stored, np.array([getattr(s, field) for s in signatures]).reshape(stored.shape))
    assert [tuple(c) for c in table.center_m[mine]] == [s.center_m for s in session_map.submaps]


def everything(place: str | Path) -> dict[str, str]:
    """A digest of all content of each session of a database."""
    with open_database(place) as database:
        return digests_of(database)


def digests_of(database: SubmapDatabase) -> dict[str, str]:
    """The same, of an open database."""
    digests = {}
    for number, info in enumerate(database.sessions()):
        digest = hashlib.sha256(repr(info).encode())
        digest.update(database.grid(info.name).cells.tobytes())
        trajectory = database.trajectory(info.name)
        digest.update(trajectory.stamps_ns.tobytes() + trajectory.T_session_base.tobytes())
        digest.update(repr((trajectory.health, database.loops(info.name))).encode())
        seen = database.seen_places(info.name)
        digest.update(seen.place.tobytes() + seen.signatures.tobytes())
        points = database.points(info.name)
        digest.update(b"" if points is None else points.points_m().tobytes())
        for submap in database.submaps(info.name):
            digest.update(repr((submap.submap_id, submap.center_m, submap.radius_m)).encode())
            digest.update(submap.grid.cells.tobytes())
        table = database.signatures()
        for field in ("boundary", "freespace", "symmetry", "submap_id", "center_m"):
            digest.update(np.ascontiguousarray(getattr(table, field)[table.session_index == number]))
        digests[info.name] = digest.hexdigest()
    return digests


def stored(path: Path, *made: SessionMap, **labels: Label) -> Path:
    """The database of session maps, as if each was made of a recording of its name."""
    config, none = Config(), Label()
    origins = [
        provenance(
            Path(f"{one.session}.mcap"),
            one.session.encode().hex(),
            config,
            label=labels.get(one.session, none),
        )
        for one in made
    ]
    add_sessions(path, list(zip(made, origins, strict=True)), config, keep=False)
    return path


# --- rows as SQL sees them, of either engine ----------------------------------------------------------


def sql(place: str | Path, statement: str, *values: object) -> list[tuple[Any, ...]]:
    """Run a statement, with `?` for values, on the tables of a database; what it returns."""
    connection: Any = postgresql.connect(place) if isinstance(place, str) else sqlite3.connect(place)
    with contextlib.closing(connection):
        if isinstance(place, str):
            connection.execute("SET search_path = pc2grid")
            statement = statement.replace("?", "%s")
        cursor = connection.execute(statement, values)
        found = cursor.fetchall() if cursor.description else []
        connection.commit()
        return found


@dataclass
class Content:
    """What is stored of a session: its own row, its document, and of each part document and arrays, or
    its bytes."""

    row: dict[str, Any]
    document: dict[str, Any]
    parts: dict[str, Any]


def craft(place: str | Path, change: Callable[[Content], None], session_id: int = 1) -> None:
    """Change what is stored of a session, and make the checksums right again."""
    (found,) = sql(place, f"SELECT {', '.join(SESSION_COLUMNS)} FROM session WHERE id = ?", session_id)
    row = dict(zip(SESSION_COLUMNS, found, strict=True))
    stored = sql(place, "SELECT name, data FROM part WHERE session_id = ? ORDER BY 1", session_id)
    content = Content(row, json.loads(row["document"]), {name: unpack(data) for name, data in stored})
    change(content)
    building = row["building"]
    if row["document"] == found[-1]:
        row["document"] = json.dumps(content.document)
    values = [content.row[column] for column in SESSION_COLUMNS]
    sql(place, "DELETE FROM part WHERE session_id = ?", session_id)
    sets = ", ".join(f"{column} = ?" for column in (*SESSION_COLUMNS, "crc32"))
    sql(place, f"UPDATE session SET {sets} WHERE id = ?", *values, row_crc(values), session_id)
    for name, part in content.parts.items():
        values = [building, session_id, name, part if isinstance(part, bytes) else _packed(*part)]
        marks = ", ".join("?" * (len(values) + 1))
        statement = f"INSERT INTO part ({', '.join(PART_COLUMNS)}, crc32) VALUES ({marks})"
        sql(place, statement, *values, row_crc(values))


def _packed(document: Any, arrays: dict[str, Any]) -> bytes:
    """A part, also with numbers in its document that are not finite."""
    stream, text = io.BytesIO(), np.frombuffer(json.dumps(document).encode(), np.uint8)
    np.savez(stream, document=text, **arrays)
    return stream.getvalue()
