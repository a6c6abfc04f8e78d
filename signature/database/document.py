"""The content of a database for a session, as one frozen type: the session map, its submaps and signatures.

pydantic turns the parts of `StoredSession` into plain values and back, by the types of their fields. A field
of one of its types is stored without another line.

A part of a session is one `.npz`: its arrays in numpy's own format (`numpy.lib.format`), and its document as
the bytes of its JSON. Whatever it claims, no more than `MOST_BYTES` are unpacked. Every row has a checksum,
and damage is reported by name.

A checksum shows only that nothing changed. So `check` tests whether the content is plausible: each test
raises ValueError with the fault; the caller adds the place. Arrays are tested as a whole: a million
signatures take a fraction of a second.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import io
import json
import re
import threading
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, TypeAdapter, ValidationError

from pc2grid.errors import DatabaseCorrupt, DatabaseError, Pc2GridError
from pc2grid.geometry import F32, F64
from pc2grid.io.messages.types import EDGES_M, FARTHEST_M
from pc2grid.model import POINT_STEPS, Loop, OccupancyGrid, PointMap, Submap, Trajectory
from pc2grid.submaps.submaps import divide
from signature.boundary import boundary_bins
from signature.config import Config
from signature.database.protocol import BuildingFrame, Entry, Problem, SessionInfo
from signature.freespace import freespace_bins
from signature.paper import Signature, SignatureTable, describe
from signature.visible import SIGNATURE_COLUMNS, SeenPlaces


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredSession:
    """Everything that is stored of a session.

    submaps : their centres and signatures; `session_index` is 0, and not stored. A submap is the part of the
    map around its centre that the settings of the session define (`pc2grid.submaps.submaps.view_at`), so its
    cells are not stored twice. seen : visible surroundings of their centres. frame : its place in its
    building; None if it was not joined with another session.
    """

    info: SessionInfo
    grid: OccupancyGrid
    trajectory: Trajectory
    loops: tuple[Loop, ...]
    points: PointMap | None
    submaps: SignatureTable
    seen: SeenPlaces
    frame: BuildingFrame | None = None


PARTS = tuple(field.name for field in fields(StoredSession))[1:]
"""The parts of a session beside its info; each is read only when it is asked for."""
SEARCHED = ("grid", "submaps")
"""The parts that every search reads."""
RECOVERED = ("points", "submaps", "seen", "frame")
"""The parts that a session can lose: see `completed`."""
_UNCOMPRESSED = ("submaps",)
"""Stored as they are, because a search reads all of them."""
_CONFIG = ConfigDict(arbitrary_types_allowed=True, extra="forbid", allow_inf_nan=False)


_ADAPTERS: dict[str, TypeAdapter[Any]] = {
    name: TypeAdapter(kind | None, config=_CONFIG)
    for name, kind in get_type_hints(StoredSession, include_extras=True).items()
}
"""What turns a part into plain values and back, by the types of its fields. pydantic takes a configuration
for a type that may be None, and none for a dataclass alone."""


def stored_session(entry: Entry) -> StoredSession:
    """Return a session as it is stored. Raises ValueError for content that its settings do not make."""
    session_map, signatures, provenance = entry
    grid, config = session_map.grid, provenance.config
    submaps = _table(session_map.submaps, signatures, config)
    return StoredSession(
        info=SessionInfo(
            name=stored_name(session_map.session),
            sensor=session_map.sensor,
            submaps=len(submaps),
            resolution_m=grid.resolution_m,
            area_m2=round(grid.free_m2, 3),
            path_m=round(session_map.trajectory.length_m, 3),
            duration_s=round(session_map.trajectory.duration_s, 3),
            scans=len(session_map.trajectory),
            points=0 if session_map.points is None else len(session_map.points),
            report=session_map.report,
            provenance=provenance,
            consistency=session_map.consistency,
            odometry=session_map.odometry,
            precision=session_map.precision,
        ),
        grid=grid,
        trajectory=session_map.trajectory,
        loops=session_map.loops,
        points=session_map.points,
        submaps=submaps,
        seen=SeenPlaces.of(grid, submaps.center_m, config.partition.radius_m),
    )


def _table(submaps: Sequence[Submap], signatures: Sequence[Signature], config: Config) -> SignatureTable:
    """Return the centres and signatures of submaps.

    Raises ValueError for a number of signatures other than that of the submaps, and for submaps that the
    configuration does not make.
    """
    if len(signatures) != len(submaps):
        raise ValueError(f"{len(submaps)} submaps but {len(signatures)} signatures")
    for submap in submaps:
        if submap.radius_m != config.partition.radius_m:
            raise ValueError(
                f"submap {submap.submap_id} has the radius {submap.radius_m:g} m where its settings"
                f" make {config.partition.radius_m:g} m"
            )
    centers_m, ids = np.array([submap.center_m for submap in submaps]), [s.submap_id for s in submaps]
    return SignatureTable.of(signatures, centers_m, submap_id=ids)


def completed(parts: Mapping[str, Any]) -> StoredSession:
    """Complete a session of which parts were lost.

    The parts that follow from its grid are computed again; its points and its place in the building are left
    out. parts : the others, at least info, grid, trajectory and loops.
    """
    found, grid, config = (
        {"points": None, "frame": None, **parts},
        parts["grid"],
        parts["info"].provenance.config,
    )
    if "submaps" not in found:
        _, submaps = divide(grid, config.partition)
        signatures = [describe(submap, config.signature) for submap in submaps]
        found["submaps"] = _table(submaps, signatures, config)
        found["info"] = replace(found["info"], submaps=len(submaps))
        found.pop("seen", None)
    if found["points"] is None:
        found["info"] = replace(found["info"], points=0)
    if "seen" not in found:
        found["seen"] = SeenPlaces.of(grid, found["submaps"].center_m, config.partition.radius_m)
    return StoredSession(**found)


def stored_name(name: str) -> str:
    """Return the name of a session as it is stored. Raises DatabaseError if it is empty."""
    if not name.strip():
        raise DatabaseError("the name of a session is empty", hint="give it a name")
    return clean(name)


def encode_info(info: SessionInfo) -> str:
    """Return the document of a session."""
    return to_json(_ADAPTERS["info"].dump_python(info, round_trip=True))


@functools.lru_cache(maxsize=256)
def decode_info(document: str) -> SessionInfo:
    """Return the inverse of `encode_info`. Raises ValidationError. Cached: each part is compared with it."""
    info: SessionInfo | None = _ADAPTERS["info"].validate_json(document)
    if info is None:
        raise ValueError("a document without content")
    return info


def encode(part: str, value: Any) -> bytes:
    """Return a part of a session as it is stored."""
    content, arrays = _ADAPTERS[part].dump_python(value), {}
    if isinstance(content, dict):
        content.pop("session_index", None)
        arrays = {name: field for name, field in content.items() if isinstance(field, np.ndarray)}
        content = {name: field for name, field in content.items() if name not in arrays}
    return pack(content, arrays, compress=part not in _UNCOMPRESSED)


def decode(part: str, data: bytes) -> Any:
    """Return the inverse of `encode`. Raises ValueError and others for damaged content."""
    content, arrays = unpack(data)
    if part == "submaps":
        arrays["session_index"] = np.zeros(len(arrays.get("submap_id", ())), np.int32)
    value = _ADAPTERS[part].validate_python({**content, **arrays} if isinstance(content, dict) else content)
    if value is None and part not in ("points", "frame"):
        raise ValueError("is not there")
    return value


# --- bytes and checksums ------------------------------------------------------------------------------

Array = NDArray[Any]
SALVAGE = "`pc2grid db check` lists all damage, `pc2grid db copy --recover` keeps what is whole"
MOST_BYTES = 1_200_000_000
"""Largest part that is read: the steps of 100 million points in space, 50,000 m2 at 5 cm."""
_DOCUMENT = "document"
"""The array with the bytes of the document."""
_HEADERS = threading.Lock()
"""One thread at a time reads headers of arrays."""
_NO_UTF8 = re.compile("[\udc80-\udcff]")
"""Bytes of a name that are no UTF-8, as Python reads them (`surrogateescape`)."""


def clean(word: str) -> str:
    r"""Return text as it can be stored: bytes of a name that are not valid UTF-8 become escapes such as
    `\xff`."""
    return _NO_UTF8.sub(lambda found: rf"\x{ord(found[0]) - 0xDC00:02x}", word)


def to_json(document: Any) -> str:
    """Return canonical JSON: equal content, equal bytes. Raises ValueError for a number that is not
    finite."""

    def plain(value: Any) -> Any:
        return value.value if isinstance(value, enum.Enum) else value.tolist()

    text = json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False, default=plain
    )
    return _NO_UTF8.sub(lambda found: rf"\\x{ord(found[0]) - 0xDC00:02x}", text)


def pack(document: Any, arrays: Mapping[str, Array], *, compress: bool = True) -> bytes:
    """Pack a document and its arrays into the bytes of an `.npz`. Equal content, equal bytes."""
    stream, text = io.BytesIO(), np.frombuffer(to_json(document).encode(), np.uint8)
    save: Any = np.savez_compressed if compress else np.savez
    save(stream, **{_DOCUMENT: text, **arrays})
    return stream.getvalue()


def unpack(data: bytes) -> tuple[Any, dict[str, Array]]:
    """Return the document and arrays of `pack`. Raises ValueError, BadZipFile and others for other bytes."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        size = sum(member.file_size for member in file.infolist())
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes, more than {MOST_BYTES}")
    # numpy parses the header of each array by `ast`, which before Python 3.11.9 must not run in two threads
    # at once ("AST constructor recursion depth mismatch", python/cpython#106905).
    with _HEADERS, np.load(io.BytesIO(data)) as members:
        arrays = dict(members)
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name}: a number that is not finite")
    return json.loads(arrays.pop(_DOCUMENT).tobytes()), arrays


def row_crc(values: Iterable[Any]) -> int:
    """Return the crc32 of a row's values, with their types and lengths, so that no shifted row has the
    same."""
    crc = 0
    for value in values:
        body = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
        crc = zlib.crc32(body, zlib.crc32(f"{type(value).__name__} {len(body)} ".encode(), crc))
    return crc


class DatabaseDamage(DatabaseCorrupt):
    """Damage at a known place: the database, the place in it, and the fault."""

    def __init__(self, location: Path | str, where: str, what: str) -> None:
        super().__init__(f"{location}: damaged: {where}: {what}", hint=SALVAGE)
        self.problem = Problem(where, what)


@contextlib.contextmanager
def explained(location: Path | str, where: str) -> Iterator[None]:
    """Turn every exception that decoding damaged content can raise into DatabaseDamage."""
    try:
        yield
    except Pc2GridError:
        raise
    except Exception as error:
        # The message of our own ValueErrors is complete; others are understood only with their type.
        what = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            what = ": ".join((*[".".join(map(str, first["loc"]))] * bool(first["loc"]), first["msg"]))
        raise DatabaseDamage(location, where, what) from error


# --- plausible content --------------------------------------------------------------------------------

# All chosen by hand: wide enough for every real session.
MOST_VOXELS = 1 << 21
"""Voxels along an axis; 104 km of 5 cm."""
_ROUNDING = 1e-4
"""Largest deviation of R R^T from the identity, and of the sum of a histogram, which is float32, from 1."""


def check(part: str, value: Any, others: Mapping[str, Any]) -> None:
    """Check a part of a session for plausible content, beyond the types of its fields.

    others : the parts that it is compared with: always the info, and the grid if that is known.
    """
    if part in _CHECKS:
        _CHECKS[part](value, others["info"], others.get("grid"))


def check_grid(grid: OccupancyGrid, info: SessionInfo, _: object = None) -> None:
    """Check that the cells of a grid are unknown, or percents, and that it lies at plausible coordinates."""
    _edge(grid.resolution_m)
    _near(np.array([grid.origin_m]), "corner")
    if grid.cells.size and (grid.cells.min() < -1 or grid.cells.max() > 100):
        raise ValueError("a cell outside -1..100")
    if grid.resolution_m != info.resolution_m:
        raise ValueError(f"resolution_m is {grid.resolution_m} where {info.resolution_m} was stored")


def check_trajectory(trajectory: Trajectory, info: SessionInfo, _: object = None) -> None:
    """Check that stamps do not decrease and that poses are rigid.

    That is an orthonormal rotation with determinant > 0, the last row of a pose, and a translation that is
    not too far.
    """
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_session_base
    _each(stamps_ns[1:] >= stamps_ns[:-1], "the stamp after {} is earlier")
    turns = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        rigid = (off <= _ROUNDING) & (np.linalg.det(turns) > 0) & (poses[:, 3] == np.eye(4)[3]).all(axis=1)
    _each(rigid, "pose {} is not rigid")
    _near(poses[:, :3, 3], "pose")
    _as_many(len(trajectory), info.scans, "poses")


def check_loops(loops: tuple[Loop, ...], info: SessionInfo, _: object = None) -> None:
    """Check that loops are between two of the poses."""
    between = [0 <= loop.older < loop.newer < info.scans for loop in loops]
    _each(np.array(between, bool), f"loop {{}} is not between two of {info.scans} poses")


def check_points(points: PointMap | None, info: SessionInfo, _: object = None) -> None:
    """Check that the voxels of points increase by x, then y, then z, none twice. None: there are no
    points."""
    _as_many(0 if points is None else len(points), info.points, "points")
    if points is None:
        return
    _edge(points.voxel_m)
    _near(points.origin_m[None], "origin")
    if len(points) and (points.steps.min() < 0 or points.steps.max() >= MOST_VOXELS * POINT_STEPS):
        raise ValueError(f"a voxel outside 0..{MOST_VOXELS}")
    x, y, z = (points.steps // POINT_STEPS).astype(np.int64).T
    code = (x << 42) + (y << 21) + z
    _each(code[1:] > code[:-1], "the voxel after {} is not after it")


def check_submaps(submaps: SignatureTable, info: SessionInfo, grid: OccupancyGrid | None) -> None:
    """Check that submap ids increase, submaps lie on their map, and histograms have the sum 1, or 0."""
    _as_many(len(submaps), info.submaps, "submaps")
    _each(np.diff(submaps.submap_id, prepend=-1) > 0, "the number of submap {} does not increase")
    if grid is not None:  # on the map, or within a cell of it
        low_m = np.array(grid.origin_m) - grid.resolution_m
        high_m = low_m + grid.resolution_m * np.array([grid.cells.shape[1] + 2, grid.cells.shape[0] + 2])
        inside = (submaps.center_m >= low_m) & (submaps.center_m <= high_m)
        _each(inside.all(axis=1), "submap {} lies outside its map")
    check_bins(submaps, info.provenance.config)
    for name in ("boundary", "freespace"):
        check_histograms(getattr(submaps, name), name)


def check_histograms(histograms: F32, what: str) -> None:
    """Check histograms (N, K): no negative share, each row of sum 1, or all 0."""
    sums = histograms @ np.ones(histograms.shape[1], np.float32)
    _each((np.abs(sums - 1.0) <= _ROUNDING) | (sums == 0.0), f"{what} histogram {{}} does not have the sum 1")
    _each((histograms >= 0).all(axis=1), f"{what} histogram {{}} has a negative share")


def check_bins(submaps: SignatureTable, config: Config) -> None:
    """Check the number of bins against the configuration; other histograms cannot be compared with a
    query's."""
    radius_m, bins = config.partition.radius_m, (submaps.boundary.shape[1], submaps.freespace.shape[1])
    wanted = boundary_bins(radius_m, config.signature), freespace_bins(radius_m, config.signature)
    if len(submaps) and bins != wanted:
        raise ValueError(
            f"histograms of {bins[0]} and {bins[1]} bins where its settings make {wanted[0]} and {wanted[1]}"
        )


def check_seen(seen: SeenPlaces, info: SessionInfo, _: object = None) -> None:
    """Check that visible surroundings have the columns of queries, and each place a viewpoint, in order."""
    columns = seen.signatures.shape[1]
    if columns != SIGNATURE_COLUMNS:
        raise ValueError(f"signatures of {columns} columns; this version compares {SIGNATURE_COLUMNS}")
    _near(seen.at_m, "viewpoint")
    if not np.array_equal(np.unique(seen.place), np.arange(info.submaps)) or (np.diff(seen.place) < 0).any():
        raise ValueError(f"viewpoints that do not belong to {info.submaps} places, in their order")


_CHECKS: dict[str, Callable[[Any, SessionInfo, OccupancyGrid | None], None]] = {
    "grid": check_grid,
    "trajectory": check_trajectory,
    "loops": check_loops,
    "points": check_points,
    "submaps": check_submaps,
    "seen": check_seen,
}


def _each(right: Any, what: str) -> None:
    """Raise ValueError with the number of the first of `right` (N,) that is false, in place of `{}`."""
    if not right.all():
        raise ValueError(what.format(int(right.argmin())))


def _edge(edge_m: float) -> None:
    low, high = EDGES_M
    if not low <= edge_m <= high:
        raise ValueError(f"cells of {edge_m:g} m instead of {low:g}..{high:g}")


def _near(points_m: F64 | F32, what: str) -> None:
    """Check that points (N, 2 or 3) are at plausible coordinates."""
    _each((np.abs(points_m) <= FARTHEST_M).all(axis=1), f"{what} {{}} is more than {FARTHEST_M:g} m away")


def _as_many(found: int, stored: int, what: str) -> None:
    if found != stored:
        raise ValueError(f"{found} {what} where {stored} were stored")
