"""The JSON document of an answer: its type, of which the JSON Schema is made, and what fills it.

Metres, radians, int64 nanoseconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

# Before Python 3.12 pydantic, which makes the schema, does not take the TypedDict of typing.
from typing_extensions import TypedDict

if TYPE_CHECKING:
    from pc2grid.geometry import SE2
    from signature.localization import answer

Status = Literal["located", "ambiguous", "not_found"]
Version = Literal[1]


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
    """The answer as it stood after `path_m` of travel, with the best hypothesis if there was any."""

    stamp_ns: int
    path_m: float
    status: Status
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


class Excluded(TypedDict):
    """The best place that the prior excludes."""

    session: str | None
    status: Status
    x: float | None
    y: float | None
    yaw: float | None
    confidence: float


class PriorUse(TypedDict):
    """What became of the prior. status: used, or lapsed if registration was lost after the time that it is
    about. excluded: null, unless nothing inside is certain and a place outside fits better."""

    status: Literal["used", "lapsed"]
    excluded: Excluded | None


class PoseInSpace(TypedDict):
    """The base in space at the query's last scan: metres, radians; roll, pitch, yaw about the fixed axes
    (REP-103). covariance (6, 6) of x, y, z and of the rotation about the axes of the map. status: whether
    the points agree with the map. rays were compared; on, through, before: shares of them that end on a
    surface of the map, behind one, and before one where the map has none."""

    status: Literal["agrees", "unsure", "contradicts"]
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


class Result(Labelled):
    """What is found. frame: of the building, in which the poses are if the session was joined with others;
    null: the map frame of the session. T_map_odom puts the query's own frame into it. confidence: the
    probability that the best hypothesis is right. hypotheses: best first. prior: null if nothing was known
    beforehand. in_space: null if the map or the query has no points."""

    schema_version: Version
    status: Status
    session: str | None
    frame: str | None
    pose: StampedPose | None
    T_map_odom: Pose | None
    confidence: float
    hypotheses: list[Hypothesis]
    history: list[Moment]
    prior: PriorUse | None
    in_space: PoseInSpace | None
    timing_ms: dict[str, float]


class AnswerDocument(Result):
    """An answer alone; `pc2grid relocalize --json` adds where the query and the database come from."""

    query: Travel
    database: Sessions


def document(answer: answer.Answer) -> AnswerDocument:
    """An answer as plain types."""
    pose = answer.T_map_base
    stamped: StampedPose | None = None
    if pose is not None and answer.covariance is not None:
        stamped = {"stamp_ns": answer.stamp_ns, **_pose(pose), "covariance": answer.covariance.tolist()}
    return {
        "schema_version": 1,
        "status": answer.status,
        "session": answer.session,
        "frame": answer.frame,
        "building": answer.label.building,
        "floor": answer.label.floor,
        "pose": stamped,
        "T_map_odom": None if answer.T_map_odom is None else _pose(answer.T_map_odom),
        "confidence": answer.confidence,
        "hypotheses": [
            {
                "session": answer.sessions[h.session_index],
                "frame": answer.frame_of(h),
                "building": answer.labels[h.session_index].building,
                "floor": answer.labels[h.session_index].floor,
                "submap_id": submap_id if submap_id >= 0 else None,
                "place": place,
                **_pose(h.fit.T_map_query @ answer.T_odom_base),
                "score": h.fit.score,
                "overlap": h.fit.overlap,
            }
            for h, submap_id, place in zip(answer.hypotheses, answer.submap_ids, answer.places, strict=True)
        ],
        "history": [_moment(moment) for moment in answer.history],
        "prior": _prior(answer),
        "in_space": in_space_document(answer),
        "query": {"path_m": answer.path_m, "stamp_ns": answer.stamp_ns},
        "database": {"sessions": list(answer.sessions)},
        "timing_ms": answer.timing_ms,
    }


def _prior(answer: answer.Answer) -> PriorUse | None:
    if answer.prior is None:
        return None
    moment = answer.excluded
    if moment is None:
        return {"status": answer.prior, "excluded": None}
    x, y, yaw = _coordinates(moment.pose)
    excluded: Excluded = {
        "session": moment.session,
        "status": moment.status,
        "x": x,
        "y": y,
        "yaw": yaw,
        "confidence": moment.confidence,
    }
    return {"status": answer.prior, "excluded": excluded}


def in_space_document(answer: answer.Answer) -> PoseInSpace | None:
    """The pose with six degrees of freedom; None if the map or the query has no points."""
    pose = answer.in_space
    if pose is None:
        return None
    x, y, z = pose.T_map_base[:3, 3].tolist()
    roll, pitch, yaw = pose.rpy_rad
    return {
        "status": pose.status,
        "x": x,
        "y": y,
        "z": z,
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "covariance": pose.covariance.tolist(),
        "rmse_m": pose.rmse_m,
        "rays": pose.rays,
        "on": pose.on,
        "through": pose.through,
        "before": pose.before,
    }


def _moment(moment: answer.Moment) -> Moment:
    x, y, yaw = _coordinates(moment.pose)
    return {
        "stamp_ns": moment.stamp_ns,
        "path_m": moment.path_m,
        "status": moment.status,
        "x": x,
        "y": y,
        "yaw": yaw,
        "confidence": moment.confidence,
    }


def _coordinates(pose: SE2 | None) -> tuple[float, float, float] | tuple[None, None, None]:
    return (None, None, None) if pose is None else (float(pose.x), float(pose.y), float(pose.yaw))


def _pose(pose: SE2) -> Pose:
    return {"x": float(pose.x), "y": float(pose.y), "yaw": float(pose.yaw)}
