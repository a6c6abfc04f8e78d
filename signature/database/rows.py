"""A session as rows of the file, and back."""

from __future__ import annotations

import contextlib
import functools
import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.errors import DatabaseCorrupt, DatabaseError, DatabaseVersion
from pc2grid.geometry import SE2
from pc2grid.model import Loop, OccupancyGrid, ReadReport, SessionMap, Submap, Trajectory
from signature.database import codec, plausible, schema
from signature.database.protocol import Entry, Label, Provenance, SessionInfo

if TYPE_CHECKING:
    from signature.config import Config
    from signature.describe import Signature

Row = dict[str, Any]


def insert(connection: sqlite3.Connection, table: str, row: Row) -> None:
    """Add a row with its checksum."""
    columns = schema.COLUMNS[table]
    values = [row[column] for column in columns]
    marks = ", ".join("?" * (len(columns) + 1))
    connection.execute(
        f"INSERT INTO {table} ({', '.join(columns)}, crc32) VALUES ({marks})",
        [*values, codec.row_crc(values)],
    )


def select(
    connection: sqlite3.Connection, table: str, where: str = "1", *values: Any
) -> Iterator[tuple[Row, bool]]:
    """Rows with whether they match their checksum."""
    columns = schema.COLUMNS[table]
    order = "submap_id" if table == "submap" else columns[0]
    query = f"SELECT {', '.join(columns)}, crc32 FROM {table} WHERE {where} ORDER BY {order}"
    for *row, crc in connection.execute(query, values):
        yield dict(zip(columns, row, strict=True)), codec.row_crc(row) == crc


def storable(entry: Entry) -> Entry:
    """The entry with words that are text: what is none in the name of a file, or typed, is shown as `\\xff`.

    Raises ValueError for signatures that its settings do not make.
    """
    session_map, signatures, provenance = entry
    for signature in signatures:
        plausible.check_bins(len(signature.boundary), len(signature.freespace), provenance.config)
    report, label = session_map.report, provenance.label
    report = replace(
        report,
        scans_skipped={_text(reason): count for reason, count in report.scans_skipped.items()},
        warnings=tuple(map(_text, report.warnings)),
    )
    label = Label(
        building=None if label.building is None else _text(label.building),
        floor=None if label.floor is None else _text(label.floor),
    )
    return (
        replace(session_map, session=_text(session_map.session), report=report),
        signatures,
        replace(provenance, source=_text(provenance.source), label=label),
    )


def _text(word: str) -> str:
    return word.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def insert_session(
    connection: sqlite3.Connection,
    session_id: int,
    session_map: SessionMap,
    signatures: Sequence[Signature],
    provenance: Provenance,
) -> None:
    """Store everything of one session."""
    submaps = session_map.submaps
    if len(signatures) != len(submaps):
        raise ValueError(f"{len(submaps)} submaps but {len(signatures)} signatures")
    session = {
        "id": session_id,
        "name": session_map.session,
        "sensor": session_map.sensor,
        "document": document(session_map, provenance),
    }
    insert(connection, "session", session)
    insert(connection, "grid", {"session_id": session_id, **grid_row(session_map.grid)})
    insert(connection, "trajectory", {"session_id": session_id, **trajectory_row(session_map.trajectory)})
    insert(connection, "loop", {"session_id": session_id, **loop_row(session_map.loops)})
    for submap in submaps:
        insert(connection, "submap", {"session_id": session_id, **submap_row(submap)})
    insert(connection, "signature", {"session_id": session_id, **signature_row(submaps, signatures)})


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
        "area_m2": round(int(np.count_nonzero(grid.free)) * grid.resolution_m**2, 3),
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
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def read_info(row: Row, resolution_m: float, scans: int, path: Path | str) -> SessionInfo:
    """A session row as the caller sees it. Raises DatabaseVersion if its settings are from the future."""
    from pydantic import ValidationError

    name, sensor = plausible.text(row["name"], "name"), plausible.text(row["sensor"], "sensor")
    content = json.loads(row["document"])
    versions = {plausible.text(k, "version"): plausible.text(v, k) for k, v in content["versions"].items()}
    try:
        config = _config(json.dumps(content["config"]))
    except ValidationError as error:
        what = ".".join(map(str, error.errors()[0]["loc"]))
        made_by = versions.get("pc2grid", "an unknown version")
        raise DatabaseVersion(
            f"{path}: session {name!r} was made by pc2grid {made_by} with the setting {what},"
            " which this version does not understand",
            hint="convert the recording again, or use that version",
        ) from None

    def not_negative(key: str) -> float:
        return plausible.number(content[key], key, 0.0, plausible.MOST)

    def text_or_none(key: str) -> str | None:
        return None if content.get(key) is None else plausible.text(content[key], key)

    digest = plausible.text(content["digest"], "digest")
    report = content["report"]
    return SessionInfo(
        name=name,
        sensor=sensor,
        digest=digest,
        submaps=plausible.count(content["submaps"], "submaps"),
        resolution_m=plausible.number(resolution_m, "resolution_m", *plausible.RESOLUTION_M),
        area_m2=not_negative("area_m2"),
        path_m=not_negative("path_m"),
        duration_s=not_negative("driven_s"),
        scans=plausible.count(scans, "scans"),
        report=ReadReport(
            scans_read=plausible.count(report["scans_read"], "scans_read"),
            points_dropped=plausible.count(report["points_dropped"], "points_dropped"),
            scans_skipped={
                plausible.text(reason, "reason"): plausible.count(skipped, reason)
                for reason, skipped in report["scans_skipped"].items()
            },
            bytes_lost=plausible.count(report["bytes_lost"], "bytes_lost"),
            warnings=tuple(plausible.text(warning, "warning") for warning in report["warnings"]),
        ),
        provenance=Provenance(
            source=plausible.text(content["source"], "source"),
            digest=digest,
            config=config,
            start_s=plausible.number(content["start_s"], "start_s"),
            duration_s=None if content["duration_s"] is None else not_negative("duration_s"),
            versions=versions,
            label=Label(building=text_or_none("building"), floor=text_or_none("floor")),
        ),
    )


@functools.lru_cache(maxsize=64)
def _config(text: str) -> Config:
    """The settings in a session's document: of a database with thousands, most sessions have the same."""
    from signature.config import Config

    return Config.model_validate(json.loads(text))


def signature_row(submaps: Sequence[Submap], signatures: Sequence[Signature]) -> Row:
    """All signatures of a session in one row."""

    def stack(name: str, width: int) -> Any:
        rows = [getattr(signature, name) for signature in signatures]
        return np.stack(rows) if rows else np.empty((0, width), np.float32)

    boundary, freespace = stack("boundary", 0), stack("freespace", 0)
    return {
        "count": len(submaps),
        "boundary_bins": boundary.shape[1],
        "freespace_bins": freespace.shape[1],
        "submap_id": codec.pack_array(np.array([s.submap_id for s in submaps], np.int32), "<i4"),
        "center_m": codec.pack_array(
            np.array([s.center_m for s in submaps], np.float64).reshape(-1, 2), "<f8"
        ),
        "boundary": codec.pack_array(boundary, "<f4"),
        "freespace": codec.pack_array(freespace, "<f4"),
        "symmetry": codec.pack_array(stack("symmetry", 2), "<f4"),
    }


def read_signature_arrays(row: Row) -> dict[str, Any]:
    """The arrays of a signature row by the names of SignatureTable. ValueError if they cannot be true."""
    n = row["count"]
    arrays: dict[str, Any] = {
        "submap_id": codec.unpack_array(row["submap_id"], "<i4", (n,)),
        "center_m": codec.unpack_array(row["center_m"], "<f8", (n, 2)),
        "boundary": codec.unpack_raw(row["boundary"], "<f4", (n, row["boundary_bins"])),
        "freespace": codec.unpack_raw(row["freespace"], "<f4", (n, row["freespace_bins"])),
        "symmetry": codec.unpack_array(row["symmetry"], "<f4", (n, 2)),
    }
    for name in ("boundary", "freespace"):
        plausible.check_histograms(arrays[name], name)
    plausible.check_described(arrays["submap_id"], arrays["center_m"], arrays["symmetry"])
    plausible.check_order(arrays["submap_id"])
    return arrays


def read_grid(row: Row) -> OccupancyGrid:
    """A grid row, or the grid half of a submap row."""
    height, width = (plausible.count(row[name], name) for name in ("height", "width"))
    grid = OccupancyGrid(
        cells=codec.unpack_cells(row["cells"], height, width),
        resolution_m=row["resolution_m"],
        origin_m=(row["origin_x_m"], row["origin_y_m"]),
    )
    plausible.check_grid(grid)
    return grid


def read_submap(row: Row, sizes: plausible.Sizes | None) -> Submap:
    """A submap row of a session of these sizes."""
    submap = Submap(
        submap_id=row["submap_id"],
        center_m=(row["center_x_m"], row["center_y_m"]),
        radius_m=row["radius_m"],
        grid=read_grid(row),
    )
    plausible.check_submap(submap, sizes)
    return submap


def read_trajectory(row: Row) -> Trajectory:
    """A trajectory row."""
    n = row["count"]
    trajectory = Trajectory(
        stamps_ns=codec.unpack_array(row["stamps_ns"], "<i8", (n,)),  # type: ignore[arg-type]
        T_map_base=codec.unpack_poses(row["poses"], n),
        health=codec.unpack_health(row["health"]),
    )
    plausible.check_stamps(trajectory.stamps_ns)
    plausible.check_poses(trajectory.T_map_base)
    return trajectory


def read_loops(row: Row, sizes: plausible.Sizes | None) -> tuple[Loop, ...]:
    """A loop row: all loops of a session of these sizes. ValueError if its arrays cannot be true."""
    n = row["count"]
    pairs: Any = codec.unpack_array(row["pairs"], "<i4", (n, 2))
    measured: Any = codec.unpack_array(row["measured"], "<f8", (n, 3))
    information: Any = codec.unpack_array(row["information"], "<f8", (n, 3, 3))
    accepted: Any = codec.unpack_array(row["accepted"], "u1", (n,))
    plausible.check_loops(pairs, measured, information, accepted, None if sizes is None else sizes.scans)
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


def refuse_other_settings(known: SessionInfo, config: Config, resolution_m: float, path: Path | str) -> None:
    """Signatures made differently must never be compared: all sessions share what shapes them.

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
                f"{path}: sessions made with {name} = {was!r} and with {now!r} cannot be compared",
                hint="use the same settings, or another database",
            )


def unlike(
    stored: Sequence[tuple[int, float, float]], described: Sequence[tuple[int, float, float]], count: int
) -> str | None:
    """What is wrong between submaps and signatures, each by its number and centre; None if nothing is.

    count : how many the session was stored with.
    """
    if not len(stored) == len(described) == count or [s[0] for s in stored] != [d[0] for d in described]:
        return f"has {len(stored)} submaps and {len(described)} signatures where {count} were stored"
    for submap, signature in zip(stored, described, strict=True):
        if submap != signature:
            return f"submap {submap[0]} lies elsewhere than its signature says"
    return None


def corrupt(path: Path | str, where: str, what: str) -> DatabaseCorrupt:
    """The error for a row that cannot be believed."""
    return DatabaseCorrupt(f"{path}: damaged: {where}: {what}", hint=schema.SALVAGE)


@contextlib.contextmanager
def explained(path: Path | str, where: str) -> Iterator[None]:
    """Whatever SQLite, the decoding or a model says about unbelievable content is DatabaseCorrupt.

    Not sqlite3.ProgrammingError: to use a database that was closed is a mistake of the caller."""
    try:
        yield
    except sqlite3.ProgrammingError:
        raise
    except (
        sqlite3.Error,
        ValueError,
        TypeError,
        ArithmeticError,
        LookupError,
        AttributeError,
        RecursionError,
    ) as error:
        # What we say of a value ourselves needs no name; what others stumble over does.
        said = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
        raise corrupt(path, where, said) from error


def grid_row(grid: OccupancyGrid) -> Row:
    """The other way round of `read_grid`."""
    return {
        "height": grid.cells.shape[0],
        "width": grid.cells.shape[1],
        "resolution_m": float(grid.resolution_m),
        "origin_x_m": float(grid.origin_m[0]),
        "origin_y_m": float(grid.origin_m[1]),
        "cells": codec.pack_cells(grid),
    }


def trajectory_row(trajectory: Trajectory) -> Row:
    """The other way round of `read_trajectory`."""
    return {
        "count": len(trajectory),
        "stamps_ns": codec.pack_array(trajectory.stamps_ns, "<i8"),
        "poses": codec.pack_poses(trajectory),
        "health": codec.pack_health(trajectory),
    }


def loop_row(loops: Sequence[Loop]) -> Row:
    """The other way round of `read_loops`."""
    relative = [loop.T_older_newer for loop in loops]
    return {
        "count": len(loops),
        "pairs": codec.pack_array(np.array([(loop.older, loop.newer) for loop in loops]), "<i4"),
        "measured": codec.pack_array(np.array([(T.x, T.y, T.yaw) for T in relative]), "<f8"),
        "information": codec.pack_array(np.array([loop.information for loop in loops]), "<f8"),
        "accepted": codec.pack_array(np.array([loop.accepted for loop in loops]), "u1"),
    }


def submap_row(submap: Submap) -> Row:
    """The other way round of `read_submap`."""
    return {
        "submap_id": int(submap.submap_id),
        "center_x_m": float(submap.center_m[0]),
        "center_y_m": float(submap.center_m[1]),
        "radius_m": float(submap.radius_m),
        **grid_row(submap.grid),
    }


def decode(
    table: str,
    row: Row,
    where: Path | str,
    read_signatures: Callable[[Row], object],
    sizes: plausible.Sizes | None,
) -> None:
    """Decode a row of any table, to see whether it can be; raises whatever its damage leads to.

    read_signatures : decodes a row of the table `signature`, the one that engines store differently.
    sizes : of the row's session; None if they are not known.
    """
    if table == "session":
        read_info(row, 1.0, 0, where)
    elif table == "grid":
        read_grid(row)
    elif table == "trajectory":
        read_trajectory(row)
    elif table == "loop":
        read_loops(row, sizes)
    elif table == "submap":
        read_submap(row, sizes)
    else:
        read_signatures(row)
