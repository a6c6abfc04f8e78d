"""What a database stores of a session, as one frozen type: the session map, its submaps and signatures.

`StoredSession` is all there is to say about the content of a database: pydantic turns its parts into plain
values and back, by the types of their fields. A field of one of its types is stored without another line.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Optional, get_type_hints

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from pc2grid.arrays import F32, F64, freeze
from pc2grid.errors import DatabaseError
from pc2grid.model import Loop, OccupancyGrid, PointMap, Trajectory
from pc2grid.submaps.junction_graph import GraphArrays, graph_to_arrays, junction_graph
from pc2grid.submaps.partition import divide
from signature.database.arrays import clean, pack, to_json, unpack
from signature.database.protocol import BuildingFrame, Entry, SessionInfo
from signature.describe import describe
from signature.seen_places import SeenPlaces
from signature.similarity import I32, SignatureTable

if TYPE_CHECKING:
    from pc2grid.model import Submap
    from signature.config import Config
    from signature.describe import Signature


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapArrays:
    """The N submaps of a session: where they are, and their signatures.

    A submap is the part of the map around its centre that the settings of the session define
    (`pc2grid.submaps.partition.view_at`), so its cells are not stored twice.

    submap_id (N,) : int32, increasing. center_m (N, 2) : float64, in the map frame.
    boundary (N, Nb), freespace (N, Nf), symmetry (N, 2) : float32, as in `Signature`.
    """

    submap_id: I32
    center_m: F64
    boundary: F32
    freespace: F32
    symmetry: F32

    def __post_init__(self) -> None:
        n = len(self.submap_id)
        freeze(self, "submap_id", np.int32, (n,))
        freeze(self, "center_m", np.float64, (n, 2))
        for name, width in (("boundary", None), ("freespace", None), ("symmetry", 2)):
            freeze(self, name, np.float32, (n, width))

    def __len__(self) -> int:
        return len(self.submap_id)

    @staticmethod
    def of(submaps: Sequence[Submap], signatures: Sequence[Signature], config: Config) -> SubmapArrays:
        """Raises ValueError for a number of signatures other than that of the submaps, and for submaps or
        signatures that the configuration does not make."""
        if len(signatures) != len(submaps):
            raise ValueError(f"{len(submaps)} submaps but {len(signatures)} signatures")
        for submap in submaps:
            if submap.radius_m != config.partition.radius_m:
                raise ValueError(
                    f"submap {submap.submap_id} has the radius {submap.radius_m:g} m where its settings"
                    f" make {config.partition.radius_m:g} m"
                )
        table = SignatureTable.of(
            signatures,
            np.array([submap.center_m for submap in submaps]),
            submap_id=[submap.submap_id for submap in submaps],
        )
        return SubmapArrays(**{field.name: getattr(table, field.name) for field in fields(SubmapArrays)})


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredSession:
    """Everything that is stored of a session.

    graph : its junction graph. submaps : where they are, and their signatures. seen : what is seen from their
    centres. frame : where it lies in its building; None if it was not joined with another session.
    """

    info: SessionInfo
    grid: OccupancyGrid
    trajectory: Trajectory
    loops: tuple[Loop, ...]
    graph: GraphArrays
    points: PointMap | None
    submaps: SubmapArrays
    seen: SeenPlaces
    frame: BuildingFrame | None = None


PARTS = tuple(field.name for field in fields(StoredSession))[1:]
"""The parts of a session beside its info; each is read only when it is asked for."""
SEARCHED = ("grid", "submaps")
"""The parts that every search reads."""
RECOVERED = ("graph", "points", "submaps", "seen", "frame")
"""The parts that a session can lose: see `completed`."""
_UNCOMPRESSED = ("submaps",)
"""Stored as they are, because a search reads all of them."""
_CONFIG = ConfigDict(arbitrary_types_allowed=True, extra="forbid", allow_inf_nan=False)


def _adapter(kind: Any) -> TypeAdapter[Any]:
    """pydantic takes a configuration for a type that may be None, and none for a dataclass alone."""
    optional: Any = Optional[kind]  # noqa: UP045 - a type that is made here
    return TypeAdapter(optional, config=_CONFIG)


_ADAPTERS = {
    name: _adapter(kind) for name, kind in get_type_hints(StoredSession, include_extras=True).items()
}
"""What turns a part into plain values and back, by the types of its fields."""


def stored_session(entry: Entry) -> StoredSession:
    """A session as it is stored. Raises ValueError for what its settings do not make."""
    session_map, signatures, provenance = entry
    grid, config, graph = session_map.grid, provenance.config, session_map.graph
    submaps = SubmapArrays.of(session_map.submaps, signatures, config)
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
        graph=graph_to_arrays(graph if len(graph) else junction_graph(grid, config.partition)),
        points=session_map.points,
        submaps=submaps,
        seen=seen_from(submaps, grid, config),
    )


def completed(parts: Mapping[str, Any]) -> StoredSession:
    """A session of which parts were lost: those that follow from its grid are computed again, and its points
    and its place in the building are left out.

    parts : the others, at least info, grid, trajectory and loops.
    """
    found, grid, config = (
        {"points": None, "frame": None, **parts},
        parts["grid"],
        parts["info"].provenance.config,
    )
    if not {"graph", "submaps"} <= found.keys():
        graph, submaps = divide(grid, config.partition)
        found.setdefault("graph", graph_to_arrays(graph))
        if "submaps" not in found:
            signatures = [describe(submap, config.signature) for submap in submaps]
            found["submaps"] = SubmapArrays.of(submaps, signatures, config)
            found["info"] = replace(found["info"], submaps=len(submaps))
            found.pop("seen", None)
    if found["points"] is None:
        found["info"] = replace(found["info"], points=0)
    found.setdefault("seen", seen_from(found["submaps"], grid, config))
    return StoredSession(**found)


def seen_from(submaps: SubmapArrays, grid: OccupancyGrid, config: Config) -> SeenPlaces:
    """What is seen from the centres of submaps."""
    return SeenPlaces.of(grid, submaps.center_m, config.partition.radius_m)


def stored_name(name: str) -> str:
    """The name of a session as it is stored. Raises DatabaseError if it is empty."""
    if not name.strip():
        raise DatabaseError("the name of a session is empty", hint="give it a name")
    return clean(name)


def encode_info(info: SessionInfo) -> str:
    """The document of a session."""
    return to_json(_ADAPTERS["info"].dump_python(info, round_trip=True))


@functools.lru_cache(maxsize=256)
def decode_info(document: str) -> SessionInfo:
    """The inverse of `encode_info`. Raises ValidationError. Cached: each part is compared with it."""
    info: SessionInfo | None = _ADAPTERS["info"].validate_json(document)
    if info is None:
        raise ValueError("a document without content")
    return info


def encode(part: str, value: Any) -> bytes:
    """A part of a session as it is stored."""
    content, arrays = _ADAPTERS[part].dump_python(value), {}
    if isinstance(content, dict):
        arrays = {name: field for name, field in content.items() if isinstance(field, np.ndarray)}
        content = {name: field for name, field in content.items() if name not in arrays}
    return pack(content, arrays, compress=part not in _UNCOMPRESSED)


def decode(part: str, data: bytes) -> Any:
    """The inverse of `encode`. Raises ValueError and others for damaged content."""
    content, arrays = unpack(data)
    value = _ADAPTERS[part].validate_python({**content, **arrays} if isinstance(content, dict) else content)
    if value is None and part not in ("points", "frame"):
        raise ValueError("is not there")
    return value
