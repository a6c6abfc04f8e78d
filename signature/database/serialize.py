"""A session as rows and bytes, and back: what the engines of the database share.

A session is a few rows of plain values (`Row`): one each of grid, trajectory, loops, junction graph, points,
isovists and signatures, and one for each submap. Every engine stores these rows with the checksum `row_crc`
of their values. Reading trusts nothing: lengths are compared with shapes, shapes with a limit, numbers must
be finite and plausible (`validation`). The readers of single values raise ValueError; `explained` turns that
into DatabaseCorrupt, which names the row.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import hand_over
from pc2grid.errors import DatabaseCorrupt, DatabaseError, DatabaseVersion
from pc2grid.geometry import SE2
from pc2grid.model import (
    POINT_STEPS,
    Consistency,
    Contradiction,
    Health,
    Loop,
    Loose,
    OccupancyGrid,
    OdometryCheck,
    Overruled,
    PointMap,
    Precision,
    ReadReport,
    SessionMap,
    Submap,
    Trajectory,
)
from signature.database import migrations, validation
from signature.database.protocol import Entry, Label, Provenance, SessionInfo

if TYPE_CHECKING:
    import networkx as nx

    from signature.config import Config
    from signature.seen_places import SeenPlaces

Row = dict[str, Any]
"""Column -> value."""
Value = int | float | str | bytes | None

SALVAGE = "`pc2grid db check` lists all damage, `pc2grid db copy --recover` keeps what is whole"
MAX_CELLS = 100_000_000
"""Cells of the largest grid that is read: 500 m x 500 m at 0.05 m."""
MAX_POINTS = 10_000_000
"""Points of the largest junction graph that is read; 260 times that of the map killian, 250 m x 200 m."""
MAX_POINTS_IN_SPACE = 100_000_000
"""Points of the largest cloud that is read: 50,000 m2 at 5 cm."""
_ZLIB_LEVEL = 6
"""zlib's own default; a part of the format only in that equal sessions give equal bytes."""
_HEALTH = tuple(Health)


# --- values to bytes, and back ------------------------------------------------------------------------


def row_crc(values: Iterable[Value]) -> int:
    """crc32 of a row's values, with their types and lengths, so that no two rows look alike by shifting."""
    crc = 0
    for value in values:
        if value is None:
            head, body = b"n", b""
        elif isinstance(value, bytes):
            head, body = b"b" + struct.pack("<q", len(value)), value
        elif isinstance(value, str):
            body = value.encode("utf-8", "surrogatepass")
            head = b"s" + struct.pack("<q", len(body))
        elif isinstance(value, float):
            head, body = b"f", struct.pack("<d", value + 0.0)  # SQLite keeps no sign of zero
        else:
            head, body = b"i", struct.pack("<q", value)
        crc = zlib.crc32(body, zlib.crc32(head, crc))
    return crc


def pack_array(array: NDArray[np.generic], dtype: str) -> bytes:
    """Little-endian bytes of an array, row by row."""
    return np.ascontiguousarray(array, dtype=dtype).tobytes()


def unpack_array(data: bytes, dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """The array back, without a copy and read-only. ValueError if length or numbers are impossible."""
    array = unpack_raw(data, dtype, shape)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError("a number that is not finite")
    return array


def unpack_raw(data: bytes, dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """The same, for the caller to look at the numbers. ValueError if the length is impossible."""
    if not all(isinstance(extent, int) and extent >= 0 for extent in shape):
        raise ValueError(f"{len(data)} bytes cannot be {shape} of {dtype}")
    wanted = math.prod(shape) * np.dtype(dtype).itemsize
    if len(data) != wanted:
        raise ValueError(f"{len(data)} bytes where {shape} of {dtype} needs {wanted}")
    return np.frombuffer(data, dtype=dtype).reshape(shape)


def pack_cells(grid: OccupancyGrid) -> bytes:
    """Cells compressed with zlib."""
    return zlib.compress(np.ascontiguousarray(grid.cells).tobytes(), _ZLIB_LEVEL)


def unpack_cells(data: bytes, height: int, width: int) -> NDArray[np.int8]:
    """(height, width) int8. Never expands to more than the shape says."""
    if height < 0 or width < 0 or height * width > MAX_CELLS:
        raise ValueError(f"a grid of {height} x {width} cells")
    cells = np.frombuffer(_inflate(data, height * width), dtype=np.int8).reshape(height, width)
    if cells.size and (cells.min() < -1 or cells.max() > 100):
        raise ValueError("a cell outside -1..100")
    return cells


def pack_poses(trajectory: Trajectory) -> bytes:
    """The upper three rows of each pose, component by component: what is constant compresses to nothing."""
    components = trajectory.T_session_base[:, :3, :].reshape(len(trajectory), 12).T
    return zlib.compress(np.ascontiguousarray(components, dtype="<f8").tobytes(), _ZLIB_LEVEL)


def unpack_poses(data: bytes, count: int) -> NDArray[np.float64]:
    """(count, 4, 4) float64."""
    raw = _inflate(data, count * 12 * 8)
    poses = np.zeros((count, 4, 4))
    poses[:, :3, :] = unpack_array(raw, "<f8", (12, count)).T.reshape(count, 3, 4)
    poses[:, 3, 3] = 1.0
    return poses


def pack_health(trajectory: Trajectory) -> bytes:
    """One byte per pose; empty if all are fine."""
    return bytes(_HEALTH.index(health) for health in trajectory.health)


def unpack_health(data: bytes) -> tuple[Health, ...]:
    """The other way round."""
    if any(code >= len(_HEALTH) for code in data):
        raise ValueError("an unknown health code")
    return tuple(_HEALTH[code] for code in data)


def _inflate(data: bytes, size: int) -> bytes:
    """Decompress exactly `size` bytes; never allocates more than that."""
    inflate = zlib.decompressobj()
    try:
        # max_length 0 would mean "no limit".
        raw = inflate.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"compressed data: {error}") from None
    if len(raw) != size or not inflate.eof:
        raise ValueError(f"compressed data does not hold the {size} bytes it should")
    return raw


# --- the content of a session to rows, and back -------------------------------------------------------


def storable(entry: Entry) -> Entry:
    """The entry as it can be stored: bytes of names that are not valid UTF-8 become escapes such as `\\xff`.

    Raises ValueError for a number of signatures other than that of the submaps, or of other lengths than
    the configuration makes.
    """
    session_map, signatures, provenance = entry
    if len(signatures) != len(session_map.submaps):
        raise ValueError(f"{len(session_map.submaps)} submaps but {len(signatures)} signatures")
    for signature in signatures:
        validation.check_bins(len(signature.boundary), len(signature.freespace), provenance.config)
    report, label = session_map.report, provenance.label
    report = replace(
        report,
        scans_skipped={_text(reason): count for reason, count in report.scans_skipped.items()},
        warnings=tuple(map(_text, report.warnings)),
    )
    label = Label(
        building=None if label.building is None else _text(label.building),
        floor=None if label.floor is None else _text(label.floor),
        told_apart=label.told_apart,
        floor_height_m=label.floor_height_m,
    )
    return (
        replace(session_map, session=_text(session_map.session), report=report),
        signatures,
        replace(provenance, source=_text(provenance.source), label=label),
    )


def stored_name(name: str) -> str:
    """The name of a session as it is stored; see `storable`. Raises DatabaseError if it is empty."""
    if not name.strip():
        raise DatabaseError("the name of a session is empty", hint="give it a name")
    return _text(name)


def _text(word: str) -> str:
    return word.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def rows_of(session_map: SessionMap, provenance: Provenance) -> dict[str, list[Row]]:
    """Rows of each table for one session, without the keys, which the engine adds.

    The table `signature` is not among them: each engine arranges the signatures in its own way.
    """
    session = {
        "name": session_map.session,
        "sensor": session_map.sensor,
        "document": document(session_map, provenance),
    }
    return {
        "session": [session],
        "grid": [grid_row(session_map.grid)],
        "trajectory": [trajectory_row(session_map.trajectory)],
        "loop": [loop_row(session_map.loops)],
        "graph": [graph_row(session_map.graph)],
        "points": [points_row(session_map.points)],
        "isovist": [isovist_row(_seen_places(session_map, provenance.config))],
        "submap": [submap_row(submap) for submap in session_map.submaps],
    }


def row_of_older_format(table: str) -> Row:
    """The row of a table for a session that was stored before the table existed: no loops, an empty graph,
    no points, no isovists."""
    import networkx as nx

    if table == "points":
        return points_row(None)
    if table == "isovist":
        return isovist_row(None)
    return loop_row(()) if table == "loop" else graph_row(nx.Graph())


def decode(table: str, row: Row, sizes: validation.Sizes | None) -> object:
    """Read a row of any table except `signature`. Raises ValueError and others for a damaged row.

    sizes : of the row's session; None if they are not known.
    """
    if table == "session":
        return read_info(row, 1.0, 0, "")
    if table == "grid":
        return read_grid(row)
    if table == "trajectory":
        return read_trajectory(row)
    if table == "loop":
        return read_loops(row, sizes)
    if table == "graph":
        return read_graph(row, sizes)
    if table == "points":
        return read_points(row)
    if table == "isovist":
        return read_isovists(row)
    assert table == "submap", table
    return read_submap(row, sizes)


def document(session_map: SessionMap, provenance: Provenance) -> str:
    """What is known about a session besides its data, as canonical JSON: equal content, equal bytes."""
    grid, trajectory, report = session_map.grid, session_map.trajectory, session_map.report
    path_m = trajectory.path_m()
    stamps = trajectory.stamps_ns
    content = {
        "digest": provenance.digest,
        "source": provenance.source,
        "start_s": provenance.start_s,
        "duration_s": provenance.duration_s,
        "versions": dict(provenance.versions),
        "building": provenance.label.building,
        "floor": provenance.label.floor,
        "config": provenance.config.model_dump(mode="json"),
        "submaps": len(session_map.submaps),
        "area_m2": round(grid.free_m2, 3),
        "path_m": round(float(path_m[-1]), 3) if len(path_m) else 0.0,
        "driven_s": round(float(stamps[-1] - stamps[0]) / 1e9, 3) if len(stamps) else 0.0,
        "report": {
            "scans_read": report.scans_read,
            "points_dropped": report.points_dropped,
            "scans_skipped": dict(report.scans_skipped),
            "bytes_lost": report.bytes_lost,
            "warnings": list(report.warnings),
        },
    }
    if provenance.label.told_apart:
        content["told_apart"] = True
    if provenance.label.floor_height_m is not None:
        content["floor_height_m"] = round(provenance.label.floor_height_m, 3)
    if session_map.consistency is not None:
        content["consistency"] = asdict(session_map.consistency)
    if session_map.odometry is not None:
        content["odometry"] = asdict(session_map.odometry)
    if session_map.precision is not None:
        content["precision"] = asdict(session_map.precision)
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def read_info(row: Row, resolution_m: float, scans: int, location: Path | str) -> SessionInfo:
    """A session row, with two numbers from its grid and trajectory, as a SessionInfo.

    location : path or URL of the database, for messages. Raises DatabaseVersion if the session was made with
    a setting that this version does not know.
    """
    from pydantic import ValidationError

    name, sensor = validation.text(row["name"], "name"), validation.text(row["sensor"], "sensor")
    content = json.loads(row["document"])
    versions = {validation.text(k, "version"): validation.text(v, k) for k, v in content["versions"].items()}
    try:
        config = _config(json.dumps(content["config"]))
    except ValidationError as error:
        what = ".".join(map(str, error.errors()[0]["loc"]))
        made_by = versions.get("pc2grid", "an unknown version")
        raise DatabaseVersion(
            f"{location}: session {name!r} was made by pc2grid {made_by} with the setting {what},"
            " which this version does not understand",
            hint="convert the recording again, or use that version",
        ) from None

    def not_negative(key: str) -> float:
        return validation.number(content[key], key, 0.0, validation.MOST)

    def text_or_none(key: str) -> str | None:
        return None if content.get(key) is None else validation.text(content[key], key)

    def number_or_none(key: str) -> float | None:
        return None if content.get(key) is None else validation.number(content[key], key)

    digest = validation.text(content["digest"], "digest")
    report = content["report"]
    return SessionInfo(
        name=name,
        sensor=sensor,
        digest=digest,
        submaps=validation.count(content["submaps"], "submaps"),
        resolution_m=validation.number(resolution_m, "resolution_m", *validation.RESOLUTION_M),
        area_m2=not_negative("area_m2"),
        path_m=not_negative("path_m"),
        duration_s=not_negative("driven_s"),
        scans=validation.count(scans, "scans"),
        report=ReadReport(
            scans_read=validation.count(report["scans_read"], "scans_read"),
            points_dropped=validation.count(report["points_dropped"], "points_dropped"),
            scans_skipped={
                validation.text(reason, "reason"): validation.count(skipped, reason)
                for reason, skipped in report["scans_skipped"].items()
            },
            bytes_lost=validation.count(report["bytes_lost"], "bytes_lost"),
            warnings=tuple(validation.text(warning, "warning") for warning in report["warnings"]),
        ),
        provenance=Provenance(
            source=validation.text(content["source"], "source"),
            digest=digest,
            config=config,
            start_s=validation.number(content["start_s"], "start_s"),
            duration_s=None if content["duration_s"] is None else not_negative("duration_s"),
            versions=versions,
            label=Label(
                building=text_or_none("building"),
                floor=text_or_none("floor"),
                told_apart=content.get("told_apart") is True,
                floor_height_m=number_or_none("floor_height_m"),
            ),
        ),
        consistency=_consistency(content.get("consistency")),
        odometry=_odometry(content.get("odometry")),
        precision=_precision(content.get("precision")),
    )


def _precision(content: Any) -> Precision | None:
    """The precision in a session's document; None for a session that has none."""
    if content is None:
        return None

    def not_negative(value: Any, what: str) -> float:
        return validation.number(value, what, 0.0, validation.MOST)

    return Precision(
        stamps_ns=tuple(validation.stamp(stamp, "stamps_ns") for stamp in content["stamps_ns"]),
        sigma_m=tuple(not_negative(sigma, "sigma_m") for sigma in content["sigma_m"]),
        loose=tuple(
            Loose(
                from_ns=validation.stamp(stretch["from_ns"], "from_ns"),
                to_ns=validation.stamp(stretch["to_ns"], "to_ns"),
                x_m=validation.number(stretch["x_m"], "x_m"),
                y_m=validation.number(stretch["y_m"], "y_m"),
                length_m=not_negative(stretch["length_m"], "length_m"),
                sigma_m=not_negative(stretch["sigma_m"], "sigma_m"),
            )
            for stretch in content["loose"]
        ),
    )


def _odometry(content: Any) -> OdometryCheck | None:
    """The check of odometry in a session's document; None for a session that has none."""
    if content is None:
        return None
    return OdometryCheck(
        compared=validation.count(content["compared"], "compared"),
        overruled=validation.count(content["overruled"], "overruled"),
        stretches=tuple(
            Overruled(
                from_ns=validation.stamp(stretch["from_ns"], "from_ns"),
                to_ns=validation.stamp(stretch["to_ns"], "to_ns"),
                distance_m=validation.number(stretch["distance_m"], "distance_m", 0.0),
                turn_rad=validation.number(stretch["turn_rad"], "turn_rad", 0.0),
            )
            for stretch in content["stretches"]
        ),
    )


def _consistency(content: Any) -> Consistency | None:
    """The consistency in a session's document; None for a session that has none."""
    if content is None:
        return None

    def share(value: Any, what: str) -> float:
        return validation.number(value, what, 0.0, 1.0)

    return Consistency(
        hits_on_free=share(content["hits_on_free"], "hits_on_free"),
        contradicted=share(content["contradicted"], "contradicted"),
        bent=validation.flag(content["bent"], "bent"),
        stretches=tuple(
            Contradiction(
                from_ns=validation.stamp(stretch["from_ns"], "from_ns"),
                to_ns=validation.stamp(stretch["to_ns"], "to_ns"),
                x_m=validation.number(stretch["x_m"], "x_m"),
                y_m=validation.number(stretch["y_m"], "y_m"),
                length_m=validation.number(stretch["length_m"], "length_m", 0.0, validation.MOST),
                share=share(stretch["share"], "share"),
            )
            for stretch in content["stretches"]
        ),
    )


@functools.lru_cache(maxsize=64)
def _config(text: str) -> Config:
    """The settings in a session's document. Cached: most sessions of a database have the same."""
    from signature.config import Config

    return Config.model_validate(migrations.without_removed_settings(json.loads(text)))


def grid_row(grid: OccupancyGrid) -> Row:
    """The inverse of `read_grid`."""
    return {
        "height": grid.cells.shape[0],
        "width": grid.cells.shape[1],
        "resolution_m": float(grid.resolution_m),
        "origin_x_m": float(grid.origin_m[0]),
        "origin_y_m": float(grid.origin_m[1]),
        "cells": pack_cells(grid),
    }


def read_grid(row: Row) -> OccupancyGrid:
    """A grid row, or the grid columns of a submap row."""
    height, width = (validation.count(row[name], name) for name in ("height", "width"))
    grid = OccupancyGrid(
        cells=unpack_cells(row["cells"], height, width),
        resolution_m=row["resolution_m"],
        origin_m=(row["origin_x_m"], row["origin_y_m"]),
    )
    validation.check_grid(grid)
    return grid


def trajectory_row(trajectory: Trajectory) -> Row:
    """The inverse of `read_trajectory`."""
    return {
        "count": len(trajectory),
        "stamps_ns": pack_array(trajectory.stamps_ns, "<i8"),
        "poses": pack_poses(trajectory),
        "health": pack_health(trajectory),
    }


def read_trajectory(row: Row) -> Trajectory:
    """A trajectory row."""
    n = row["count"]
    trajectory = Trajectory(
        stamps_ns=unpack_array(row["stamps_ns"], "<i8", (n,)),  # type: ignore[arg-type]
        T_session_base=unpack_poses(row["poses"], n),
        health=unpack_health(row["health"]),
    )
    validation.check_stamps(trajectory.stamps_ns)
    validation.check_poses(trajectory.T_session_base)
    return trajectory


def loop_row(loops: Sequence[Loop]) -> Row:
    """The inverse of `read_loops`."""
    relative = [loop.T_older_newer for loop in loops]
    return {
        "count": len(loops),
        "pairs": pack_array(np.array([(loop.older, loop.newer) for loop in loops]), "<i4"),
        "measured": pack_array(np.array([(T.x, T.y, T.yaw) for T in relative]), "<f8"),
        "information": pack_array(np.array([loop.information for loop in loops]), "<f8"),
        "accepted": pack_array(np.array([loop.accepted for loop in loops]), "u1"),
    }


def read_loops(row: Row, sizes: validation.Sizes | None) -> tuple[Loop, ...]:
    """A loop row: all loops of a session of these sizes. Raises ValueError for implausible arrays."""
    n = row["count"]
    pairs: Any = unpack_array(row["pairs"], "<i4", (n, 2))
    measured: Any = unpack_array(row["measured"], "<f8", (n, 3))
    information: Any = unpack_array(row["information"], "<f8", (n, 3, 3))
    accepted: Any = unpack_array(row["accepted"], "u1", (n,))
    validation.check_loops(pairs, measured, information, accepted, None if sizes is None else sizes.scans)
    return tuple(
        Loop(
            older=int(pairs[k, 0]),
            newer=int(pairs[k, 1]),
            T_older_newer=SE2(*measured[k].tolist()),
            information=information[k],
            accepted=bool(accepted[k]),
        )
        for k in range(n)
    )


def graph_row(graph: nx.Graph) -> Row:
    """The inverse of `read_graph`."""
    from pc2grid.submaps.junction_graph import graph_to_arrays

    arrays = graph_to_arrays(graph)
    points = len(arrays.path_m)
    if points > MAX_POINTS:
        raise ValueError(f"a junction graph of {points} points, more than {MAX_POINTS}")
    return {
        "nodes": len(arrays.kind),
        "edges": len(arrays.length_m),
        "points": points,
        "center_m": pack_array(arrays.center_m, "<f8"),
        "kind": pack_array(arrays.kind, "u1"),
        "pixels": pack_array(arrays.pixels, "<i4"),
        "ends": pack_array(arrays.edges, "<i4"),
        "length_m": pack_array(arrays.length_m, "<f8"),
        "path_start": pack_array(arrays.path_start, "<i8"),
        # All x, then all y: a way along an axis of the grid compresses to almost nothing.
        "path_m": zlib.compress(pack_array(arrays.path_m.T, "<f4"), _ZLIB_LEVEL),
    }


def read_graph(row: Row, sizes: validation.Sizes | None) -> nx.Graph:
    """The junction graph of a session of these sizes. Raises ValueError for implausible arrays."""
    from pc2grid.submaps.junction_graph import GraphArrays, graph_from_arrays

    n, m, points = (validation.count(row[name], name) for name in ("nodes", "edges", "points"))
    if points > MAX_POINTS:
        raise ValueError(f"a graph of {points} points")
    path_m: Any = unpack_array(_inflate(row["path_m"], points * 8), "<f4", (2, points))
    columns: dict[str, Any] = {
        "center_m": unpack_array(row["center_m"], "<f8", (n, 2)),
        "kind": unpack_array(row["kind"], "u1", (n,)),
        "pixels": unpack_array(row["pixels"], "<i4", (n,)),
        "edges": unpack_array(row["ends"], "<i4", (m, 2)),
        "length_m": unpack_array(row["length_m"], "<f8", (m,)),
        "path_start": unpack_array(row["path_start"], "<i8", (m + 1,)),
        "path_m": np.ascontiguousarray(path_m.T),
    }
    arrays = GraphArrays(**columns)
    validation.check_graph(arrays, sizes)
    return graph_from_arrays(arrays)


def points_row(points: PointMap | None) -> Row:
    """The inverse of `read_points`."""
    if points is None:
        points = PointMap(voxel_m=1.0, origin_m=np.zeros(3), steps=np.empty((0, 3), np.int32))
    if len(points) > MAX_POINTS_IN_SPACE:
        raise ValueError(f"{len(points)} points, more than {MAX_POINTS_IN_SPACE}")
    voxels = points.steps // POINT_STEPS
    return {
        "count": len(points),
        "voxel_m": float(points.voxel_m),
        **{f"origin_{axis}_m": float(v) for axis, v in zip("xyz", points.origin_m, strict=True)},
        # The voxels are in order, so most steps from one to the next are 0 or 1 and compress well.
        "voxels": zlib.compress(pack_array(np.diff(voxels, axis=0, prepend=0).T, "<i4"), _ZLIB_LEVEL),
        "within": zlib.compress(pack_array((points.steps % POINT_STEPS).T, "u1"), _ZLIB_LEVEL),
    }


def read_points(row: Row) -> PointMap | None:
    """The points of a session in space; None if it has none. Raises ValueError for implausible numbers."""
    n = validation.count(row["count"], "count")
    if n > MAX_POINTS_IN_SPACE:
        raise ValueError(f"{n} points")
    voxels: Any = unpack_array(_inflate(row["voxels"], 12 * n), "<i4", (3, n))
    within: Any = unpack_array(_inflate(row["within"], 3 * n), "u1", (3, n))
    origin_m = np.array([validation.number(row[f"origin_{axis}_m"], "origin_m") for axis in "xyz"])
    voxel_m = validation.number(row["voxel_m"], "voxel_m", *validation.VOXEL_M)
    indices = np.cumsum(voxels, axis=1, dtype=np.int64)
    validation.check_voxels(indices, within, voxel_m)
    steps = (indices * POINT_STEPS + within).T
    return (
        PointMap(voxel_m=voxel_m, origin_m=origin_m, steps=hand_over(steps.astype(np.int32))) if n else None
    )


def _seen_places(session_map: SessionMap, config: Config) -> SeenPlaces:
    """What is seen from the centres of the submaps of a session. It follows from the map, so it is computed
    whenever a session is stored."""
    from signature.seen_places import SeenPlaces

    centers_m = np.array([submap.center_m for submap in session_map.submaps], np.float64).reshape(-1, 2)
    return SeenPlaces.of(session_map.grid, centers_m, config.partition.radius_m)


def isovist_row(seen: SeenPlaces | None) -> Row:
    """The inverse of `read_isovists`."""
    bearings, columns = (0, 0) if seen is None else (seen.ranges.shape[1], seen.signatures.shape[1])
    return {
        "count": 0 if seen is None else len(seen),
        "bearings": bearings,
        "columns": columns,
        "sight_m": 0.0 if seen is None else float(seen.sight_m),
        "ranges": zlib.compress(b"" if seen is None else pack_array(seen.ranges, "u1"), _ZLIB_LEVEL),
        # Column by column: neighbouring places have similar shares in each bin.
        "seen": zlib.compress(b"" if seen is None else pack_array(seen.signatures.T, "u1"), _ZLIB_LEVEL),
    }


def read_isovists(row: Row) -> SeenPlaces | None:
    """What is seen from the places of a session; None if it was not stored. Raises ValueError for implausible
    numbers."""
    from signature.seen_places import PROFILE_BEARINGS, SIGNATURE_COLUMNS, SeenPlaces

    n, bearings, columns = (validation.count(row[name], name) for name in ("count", "bearings", "columns"))
    if not n:
        return None
    if (bearings, columns) != (PROFILE_BEARINGS, SIGNATURE_COLUMNS) or n > MAX_POINTS:
        raise ValueError(f"{n} isovists of {bearings} rays and {columns} columns")
    ranges: Any = unpack_array(_inflate(row["ranges"], n * bearings), "u1", (n, bearings))
    seen: Any = unpack_array(_inflate(row["seen"], n * columns), "u1", (columns, n))
    sight_m = validation.number(row["sight_m"], "sight_m", 1e-3, validation.MAX_RADIUS_M)
    return SeenPlaces(sight_m=sight_m, ranges=ranges, signatures=hand_over(np.ascontiguousarray(seen.T)))


def submap_row(submap: Submap) -> Row:
    """The inverse of `read_submap`."""
    return {
        "submap_id": int(submap.submap_id),
        "center_x_m": float(submap.center_m[0]),
        "center_y_m": float(submap.center_m[1]),
        "radius_m": float(submap.radius_m),
        **grid_row(submap.grid),
    }


def read_submap(row: Row, sizes: validation.Sizes | None) -> Submap:
    """A submap row of a session of these sizes."""
    submap = Submap(
        submap_id=row["submap_id"],
        center_m=(row["center_x_m"], row["center_y_m"]),
        radius_m=row["radius_m"],
        grid=read_grid(row),
    )
    validation.check_submap(submap, sizes)
    return submap


# --- several sessions and rows together ---------------------------------------------------------------


def refuse_other_settings(
    known: SessionInfo, config: Config, resolution_m: float, location: Path | str
) -> None:
    """Refuse to store signatures that cannot be compared with those of the session `known`.

    All sessions of a database share the settings that shape signatures, and the resolution of the map.
    Raises DatabaseError naming the first setting that differs.
    """
    pairs = [
        (f"{section}.{key}", getattr(getattr(known.provenance.config, section), key), value)
        for section in ("signature", "partition")
        for key, value in getattr(config, section)
    ]
    pairs.append(("the map's resolution", known.resolution_m, resolution_m))
    for name, was, now in pairs:
        if was != now:
            raise DatabaseError(
                f"{location}: sessions made with {name} = {was!r} and with {now!r} cannot be compared",
                hint="use the same settings, or another database",
            )


def refuse_same_name(name: str, location: Path | str) -> DatabaseError:
    """The error for a session whose name another session of the database has."""
    return DatabaseError(
        f"{location}: holds another session named {name!r} already",
        hint="--force replaces it; --name gives this one another name",
    )


def no_session(name: str, known: Iterable[str], location: Path | str) -> DatabaseError:
    """The error for a session that a database does not hold."""
    there = ", ".join(map(repr, known)) or "none"
    return DatabaseError(f"{location}: no session {name!r}", hint=f"there are: {there}")


def name_is_taken(name: str, location: Path | str) -> DatabaseError:
    """The error for the new name of a session that another session has already."""
    return DatabaseError(f"{location}: holds a session {name!r} already", hint="choose another name")


def mismatch(
    submaps: Sequence[tuple[int, float, float]],
    signatures: Sequence[tuple[int, float, float]],
    isovists: int,
    count: int,
) -> str | None:
    """How the submaps and the signatures of a session differ, given the id and centre of each; None if not.

    isovists : how many isovists the session has; 0: none were stored. count : how many submaps it was stored
    with.
    """
    if not len(submaps) == len(signatures) == count or [s[0] for s in submaps] != [s[0] for s in signatures]:
        return f"has {len(submaps)} submaps and {len(signatures)} signatures where {count} were stored"
    if isovists not in (0, count):
        return f"has {isovists} isovists where {count} were stored"
    for submap, signature in zip(submaps, signatures, strict=True):
        if submap != signature:
            return f"submap {submap[0]} lies elsewhere than its signature says"
    return None


# --- damage -------------------------------------------------------------------------------------------


def corrupt(location: Path | str, where: str, what: str) -> DatabaseCorrupt:
    """The error for damage: in which database, where in it, and what."""
    return DatabaseCorrupt(f"{location}: damaged: {where}: {what}", hint=SALVAGE)


@contextlib.contextmanager
def explained(location: Path | str, where: str) -> Iterator[None]:
    """Turn every exception that decoding a damaged row can raise into DatabaseCorrupt."""
    try:
        yield
    except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, RecursionError) as error:
        # The message of our own ValueErrors is complete; others are understood only with their type.
        what = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
        raise corrupt(location, where, what) from error
