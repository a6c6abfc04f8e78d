"""What a database stores of a session, as one frozen type: the session map, its submaps and signatures.

`StoredSession` is all there is to say about the content of a database: `signature.database.codec` turns it
into a document and arrays by its fields. A field of one of its types is stored without another line.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.arrays import F32, F64, freeze
from pc2grid.errors import DatabaseError
from pc2grid.model import Loop, OccupancyGrid, PointMap, Trajectory
from pc2grid.submaps.junction_graph import GraphArrays, graph_from_arrays, graph_to_arrays, junction_graph
from pc2grid.submaps.partition import divide
from signature.database import codec, validation
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
        return SubmapArrays(**{name: getattr(table, name) for name in codec.fields_of(SubmapArrays)})


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
    submaps: SubmapArrays = field(metadata=codec.UNCOMPRESSED)
    seen: SeenPlaces
    frame: BuildingFrame | None = None


PARTS = tuple(codec.fields_of(StoredSession))
"""The parts of a session; all but the first are read only when they are asked for."""
SEARCHED = ("info", "grid", "submaps")
"""The parts that every search reads."""
RECOVERED = ("graph", "points", "submaps", "seen", "frame")
"""The parts that a session can lose: see `completed`."""
ADDED = ("frame",)
"""The parts that a session gets after it was stored; without them, nothing in its document tells of them."""


def stored_session(entry: Entry) -> StoredSession:
    """A session as it is stored. Raises ValueError for what its settings do not make."""
    session_map, signatures, provenance = entry
    grid, config, graph = session_map.grid, provenance.config, session_map.graph
    submaps = SubmapArrays.of(session_map.submaps, signatures, config)
    session = StoredSession(
        info=SessionInfo(
            name=stored_name(session_map.session),
            sensor=session_map.sensor,
            submaps=len(submaps),
            resolution_m=grid.resolution_m,
            area_m2=round(grid.free_m2, 3),
            path_m=round(session_map.trajectory.length_m, 3),
            duration_s=round(session_map.trajectory.duration_s, 3),
            scans=len(session_map.trajectory),
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
    _check_submaps(submaps, session.info, grid)
    return session


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
    found.setdefault("seen", seen_from(found["submaps"], grid, config))
    return StoredSession(**found)


def seen_from(submaps: SubmapArrays, grid: OccupancyGrid, config: Config) -> SeenPlaces:
    """What is seen from the centres of submaps."""
    return SeenPlaces.of(grid, submaps.center_m, config.partition.radius_m)


def stored_name(name: str) -> str:
    """The name of a session as it is stored. Raises DatabaseError if it is empty."""
    if not name.strip():
        raise DatabaseError("the name of a session is empty", hint="give it a name")
    return codec.clean(name)


def encode(session: StoredSession) -> tuple[str, dict[str, codec.Packed]]:
    """The document and the arrays of a session."""
    content: dict[str, Any] = {}
    packed: dict[str, codec.Packed] = {}
    for part in fields(StoredSession):
        arrays: dict[str, codec.Array] = {}
        value = getattr(session, part.name)
        if part.name in ADDED and value is None:
            continue
        content[part.name] = codec.encode(codec.fields_of(StoredSession)[part.name], value, part.name, arrays)
        compress = part.metadata.get("compress", True)
        packed |= {name: codec.pack(array, compress=compress) for name, array in arrays.items()}
    return codec.to_json(content), packed


def with_frame(document: str, frame: BuildingFrame | None) -> str:
    """The document of a session with another place in its building; None: with none."""
    content = json.loads(document)
    content.pop("frame", None)
    if frame is not None:
        content["frame"] = codec.encode(BuildingFrame, frame, "frame", {})
    return codec.to_json(content)


def decode(part: str, content: Any, arrays: dict[str, codec.Array], others: Mapping[str, Any]) -> Any:
    """A part of a session. Raises ValueError for implausible content, and many others for damaged content.

    content : the document. arrays : those of the part, by their path. others : the parts that it is compared
    with: always the info, and the grid if that is known.
    """
    if isinstance(content, dict) and part in ADDED and part not in content:
        return None
    if not isinstance(content, dict) or part not in content:
        raise ValueError(f"the document has no {part}")
    value = codec.decode(codec.fields_of(StoredSession)[part], content[part], part, arrays)
    if arrays:
        raise ValueError(f"{min(arrays)} is not one of its arrays")
    if part in _CHECKS:
        _CHECKS[part](value, others["info"], others.get("grid"))
    return value


def _check_grid(grid: OccupancyGrid, info: SessionInfo, _: object) -> None:
    validation.check_grid(grid)
    if grid.resolution_m != info.resolution_m:
        raise ValueError(f"resolution_m is {grid.resolution_m} where {info.resolution_m} was stored")


def _check_trajectory(trajectory: Trajectory, info: SessionInfo, _: object) -> None:
    validation.check_trajectory(trajectory)
    _expect(len(trajectory), info.scans, "poses")


def _check_graph(graph: GraphArrays, _: SessionInfo, grid: OccupancyGrid | None) -> None:
    validation.check_graph(graph, grid)
    graph_from_arrays(graph)


def _check_submaps(submaps: SubmapArrays, info: SessionInfo, grid: OccupancyGrid | None) -> None:
    _expect(len(submaps), info.submaps, "submaps")
    validation.check_ids(submaps.submap_id)
    validation.check_near(submaps.center_m, "submap")
    if grid is not None:
        validation.check_on_map(submaps.center_m, grid, "submap")
    if len(submaps):
        bins = submaps.boundary.shape[1], submaps.freespace.shape[1]
        validation.check_bins(*bins, info.provenance.config)
    for name in ("boundary", "freespace"):
        validation.check_histograms(getattr(submaps, name), name)
    if (submaps.symmetry < 0).any():
        row = int((submaps.symmetry < 0).any(axis=1).argmax())
        raise ValueError(f"submap {submaps.submap_id[row]} has a symmetry score below 0")


def _check_seen(seen: SeenPlaces, info: SessionInfo, _: object) -> None:
    validation.check_seen(seen, info.submaps)


def _check_frame(frame: BuildingFrame | None, _: SessionInfo, __: object) -> None:
    if frame is not None:
        validation.check_covariance(frame.covariance)


def _expect(found: int, stored: int, what: str) -> None:
    if found != stored:
        raise ValueError(f"{found} {what} where {stored} were stored")


_CHECKS: dict[str, Callable[[Any, SessionInfo, OccupancyGrid | None], None]] = {
    "grid": _check_grid,
    "trajectory": _check_trajectory,
    "loops": lambda loops, info, grid: validation.check_loops(loops, info.scans),
    "graph": _check_graph,
    "points": lambda points, info, grid: validation.check_points(points),
    "submaps": _check_submaps,
    "seen": _check_seen,
    "frame": _check_frame,
}
"""What must be true of a part, beside the types of its fields."""
