"""The types of the JSON documents about answers, of which JSON and JSON Schema are made.

Metres, radians, int64 nanoseconds. `signature.localization.answer` fills them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

# Before Python 3.12 pydantic does not take the TypedDict of typing. All documents take it from here.
from typing_extensions import TypedDict as TypedDict

from pc2grid.geometry import SE2

SCHEMA_VERSION = 1
"""Of all documents. Within a version they only gain keys: a reader must ignore keys that it does not know."""
Status = Literal["located", "ambiguous", "not_found"]
SpaceStatus = Literal["agrees", "unsure", "contradicts"]


class Pose(TypedDict):
    """A planar pose: metres, and radians counterclockwise."""

    x: float
    y: float
    yaw: float


class Labelled(TypedDict):
    """Where a session was recorded, in the user's words; null: not known."""

    building: str | None
    floor: str | None


class StampedPose(Pose):
    """The base in the map frame at the query's last scan; covariance (3, 3) of x, y, yaw."""

    stamp_ns: int
    covariance: list[list[float]]


class Hypothesis(Pose, Labelled):
    """A place that fits. Equal `place`: the same place in the maps of different sessions. frame: of the
    building, in which the pose is; null: the map frame of the session. submap_id is null if the whole map was
    searched. score and overlap: shares of what both sides see, 0..1."""

    session: str
    frame: str | None
    submap_id: int | None
    place: int
    score: float
    overlap: float


class Moment(TypedDict):
    """The answer as it stood after `path_m` of travel, with the best hypothesis, in the map of `session`, if
    there was any."""

    stamp_ns: int
    path_m: float
    status: Status
    session: str | None
    x: float | None
    y: float | None
    yaw: float | None
    confidence: float


class Travel(TypedDict):
    """How far the query travelled, and the stamp of its last scan."""

    path_m: float
    stamp_ns: int


class QueryRecording(Travel):
    """What was looked for. start_s, duration_s: the part of the recording that was read; null: to its end.
    sensor: lidar, laser, depth, or map. lossy: data was lost while reading."""

    source: str
    start_s: float
    duration_s: float | None
    scans: int
    sensor: str
    lossy: bool
    warnings: list[str]


class Sessions(TypedDict):
    """The sessions of the database."""

    sessions: list[str]


class PriorUse(TypedDict):
    """What became of the prior. status: used, lapsed if registration was lost after the time that it is
    about, or ahead if its time lies after the last scan. excluded: the best place that the prior excludes;
    null, unless nothing inside is certain and it fits better."""

    status: Literal["used", "lapsed", "ahead"]
    excluded: Moment | None


class PoseInSpace(TypedDict):
    """The base in space at the query's last scan: metres, radians; roll, pitch, yaw about the fixed axes
    (REP-103). covariance (6, 6) of x, y, z and of the rotation about the axes of the map. status: whether
    the points agree with the map. rays were compared; on, through, before: shares of them that end on a
    surface of the map, behind one, and before one where the map has none."""

    status: SpaceStatus
    x: float
    y: float
    z: float
    roll: float
    pitch: float
    yaw: float
    covariance: list[list[float]]
    rmse_m: float
    rays: int
    on: float
    through: float
    before: float


@dataclass(frozen=True, slots=True)
class Point:
    """A point of a map, metres."""

    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class AmbiguousLine:
    """Likely places that lie on one line, all with the heading `yaw`. begin, end: the places at its ends, in
    the frame of the best hypothesis. probability: that the base is at one of these places."""

    begin: Point
    end: Point
    yaw_rad: Annotated[float, Field(serialization_alias="yaw")]
    length_m: float
    probability: float


class OffMap(Pose):
    """The base at a place that the map does not show, by its odometry since the map showed where it was, in
    the map frame of `session` or, if `frame` is not null, in that of its building. covariance (3, 3) of
    x, y, yaw: how far odometry may have gone wrong since. probability: that it is there."""

    session: str
    frame: str | None
    covariance: list[list[float]]
    probability: float


class Result(Labelled):
    """What is found. frame: of the building, in which the poses are if the session was joined with others;
    null: the map frame of the session. T_map_odom puts the query's own frame into it. confidence: the
    probability that the best hypothesis is right. hypotheses: best first. prior: null if nothing was known
    beforehand. in_space: null if the map or the query has no points. line: null unless the answer is
    ambiguous, and most of the probability lies on one. off_map: null, unless the robot has most likely left
    what the map shows."""

    status: Status
    session: str | None
    frame: str | None
    pose: StampedPose | None
    T_map_odom: SE2 | None
    confidence: float
    hypotheses: list[Hypothesis]
    history: list[Moment]
    line: AmbiguousLine | None
    off_map: OffMap | None
    prior: PriorUse | None
    in_space: PoseInSpace | None
    timing_ms: dict[str, float]


class AnswerDocument(Result):
    """An answer alone; `pc2grid relocalize --json` adds where the query and the database come from."""

    query: Travel
    database: Sessions


adapter = cache(TypeAdapter)
"""What makes the JSON of a type, and its schema."""


def plain(kind: type, document: Any) -> Any:
    """Return a document of plain types: frozen types in it become objects, with the digits they declare."""
    return {
        "schema_version": SCHEMA_VERSION,
        **adapter(kind).dump_python(document, mode="json", by_alias=True),
    }
