"""The JSON documents of the commands as types, and their JSON Schemas (draft 2020-12).

The commands fill these types, so that mypy compares what is printed with what the schema says. They hold
frozen types of the program as they are: `plain` makes JSON of them. Metres, radians, int64 nanoseconds,
unless a name says otherwise. Within a `schema_version` documents only gain keys: a reader must ignore keys
that it does not know.
"""

from __future__ import annotations

from typing import Any, Literal, TypeVar

from pydantic import TypeAdapter

# Before Python 3.12 pydantic does not take the TypedDict of typing.
from typing_extensions import TypedDict

from pc2grid.model import Consistency, OdometryCheck, ThreeDigits, UncertainStretch
from signature.config import Config
from signature.database.protocol import Problem
from signature.localization.answer_json import (
    Labelled,
    Pose,
    PoseInSpace,
    QueryRecording,
    Result,
    Sessions,
    StampedPose,
    Status,
    Version,
)
from signature.localization.belief import State

Document = TypeVar("Document")
CheckStatus = Literal["fine", "lost", "unsure"]


class Printed(TypedDict):
    """What every document says."""

    schema_version: Version


class OfDatabase(Printed):
    """A document about a database: its path, or its URL without a password."""

    database: str


class OfFile(Printed):
    """A document about a file."""

    path: str
    format: str
    warnings: list[str]


class Live(TypedDict):
    """How a running robot is followed. scans: used so far. dropped: left out because the computer is too
    slow. reconnected: lost connections made again. lag_s, elapsed_s: seconds from a scan's arrival to its
    use, and for this estimate."""

    scans: int
    dropped: int
    reconnected: int
    lag_s: float
    elapsed_s: float


class Searched(Sessions):
    """Where it was looked for. left_out: damage that was not used."""

    path: str
    left_out: list[str]


class Relocalize(Result):
    """`pc2grid relocalize --json`. T_map_odom puts the query's own frame into the map. confidence: the
    probability that the best hypothesis is right. hypotheses: best first. map_sigma_m: standard deviation of
    the map itself there, relative to the rest of it; the covariance of the pose is about the walls around."""

    query: QueryRecording
    database: Searched
    map_sigma_m: float | None


class CheckedPose(Pose):
    """The pose at the last scan, in the map frame."""

    stamp_ns: int


class BetterPlace(Labelled):
    """Where the query is instead, with certainty."""

    session: str | None
    pose: StampedPose | None
    confidence: float


class CheckedAgainst(TypedDict):
    """The database."""

    path: str


class CheckedPoseJudgement(Printed):
    """What is said of a pose that the robot believes in.

    status: fine, lost, or unsure. probability: that the pose is right; an upper bound unless it is fine.
    off_m, off_rad: from the pose to the best fit near it, null if nothing fits there. comparable: false if
    registration was lost after the time of the pose. better: null unless another place is certain.
    """

    status: CheckStatus
    probability: float
    session: str
    pose: CheckedPose
    off_m: float | None
    off_rad: float | None
    comparable: bool
    better: BetterPlace | None
    database: CheckedAgainst


class RelocalizeCheck(CheckedPoseJudgement):
    """`pc2grid relocalize --check` and `--check-topic`, with `--json`."""

    query: QueryRecording


class WatchCheck(CheckedPoseJudgement, Live):
    """A line of `pc2grid watch --check-topic --json`. path_m: travel that the judgement rests on."""

    path_m: float


class WatchedMap(Labelled):
    """The map that a pose is in: its session, and the sha256 of what the session was made from, hex."""

    database: str
    session: str
    digest: str


class Watch(Printed, Live):
    """A line of `pc2grid watch --json`: what one search of the database said. state: searching (not located
    yet), located, doubtful (certain neither where it was nor elsewhere), lost, recovered (located elsewhere
    or again). pose: of the base at `stamp_ns`; null unless the status is `located`. T_map_odom: of
    the robot's own odometry frame. frame: of the building, in which the pose is; null: the map frame of the
    session. in_space: null if the map or the scans have no points. confidence: the probability that the best
    place is right. published: topics on which it was said."""

    state: State
    status: Status
    stamp_ns: int
    path_m: float
    map: WatchedMap | None
    frame: str | None
    pose: StampedPose | None
    T_map_odom: Pose | None
    in_space: PoseInSpace | None
    confidence: float
    published: list[str]


class Topic(TypedDict):
    """A topic of a recording; message_count is null if the file does not say."""

    topic: str
    type: str
    encoding: str
    message_count: int | None


class ChosenTopics(TypedDict):
    """What `convert` would use, and why. camera_topic: the calibration of depth images; else null."""

    topic: str
    sensor: str
    odometry_topic: str | None
    imu_topic: str | None
    camera_topic: str | None
    base_frame: str
    sensor_frame: str
    reason: str


class Info(OfFile):
    """`pc2grid info --json`. choice is null, and problem says why, if `convert` could not use the log."""

    size_bytes: int
    start_ns: int
    end_ns: int
    duration_s: float
    message_count: int | None
    topics: list[Topic]
    choice: ChosenTopics | None
    problem: str | None
    bytes_lost: int


class InfoMap(OfFile):
    """`pc2grid info MAP --json`. origin_m: x, y of the lower left corner; free_m2, occupied_m2: areas.
    Of a cloud or mesh, voxels: points of which it was drawn, one a voxel, floor_z_m, tilt_deg: height and
    tilt of the floor in the file; 0 for a nav2 map."""

    width: int
    height: int
    resolution_m: float
    origin_m: list[float]
    free_m2: float
    occupied_m2: float
    voxels: int
    floor_z_m: float
    tilt_deg: float


class Report(TypedDict):
    """What was read, and lost on the way; scans_skipped counts by reason."""

    scans_read: int
    points_dropped: int
    scans_skipped: dict[str, int]
    bytes_lost: int
    warnings: list[str]
    lossy: bool


class PrecisionSummary(TypedDict):
    """How exactly the places of a map lie to each other: standard deviations of a position in the least
    certain direction. median_m: half of the places are known better. worst_m: the largest. loose: stretches
    where it is too large to rely on, the least certain first."""

    median_m: ThreeDigits
    worst_m: ThreeDigits
    loose: list[UncertainStretch]


class Mapped(Labelled):
    """A session. digest: sha256 of what it was made from, hex. area_m2: free space. consistency, odometry,
    precision: null for an imported map."""

    source: str
    digest: str
    sensor: str
    scans: int
    path_m: float
    duration_s: float
    area_m2: float
    submaps: int
    consistency: Consistency | None
    odometry: OdometryCheck | None
    precision: PrecisionSummary | None


class Converted(Mapped):
    """What became of one input."""

    session: str
    report: Report


class JoinedSession(TypedDict):
    """Where a session lies in its building. frame: name of the building's frame. bent_m: how far the map is
    bent there at most, where another session straightens it."""

    session: str
    frame: str
    T_building_session: Pose
    covariance: list[list[float]]
    bent_m: float


class Convert(OfDatabase):
    """`pc2grid convert --json`. unchanged: sessions that were stored already; failed: inputs left out.
    joined: where those of the new sessions lie in a building that were joined with others."""

    lossy: bool
    sessions: list[Converted]
    unchanged: list[str]
    failed: list[str]
    joined: list[JoinedSession]


class StoredInfo(Mapped):
    """A session of a database, with the versions and settings that made it."""

    name: str
    resolution_m: float
    lossy: bool
    warnings: list[str]
    versions: dict[str, str]
    config: dict[str, Any]


class DbInfo(OfDatabase):
    """`pc2grid db info --json`."""

    sessions: list[StoredInfo]


class DbCheck(OfDatabase):
    """`pc2grid db check --json`; no problems: sound."""

    problems: list[Problem]


class DbWrite(OfDatabase):
    """`pc2grid db merge`, `copy`, `split`, `rename` and `remove` with `--json`. sessions: how many are in
    the database now; left_out: damage that was not copied."""

    sessions: int
    left_out: list[Problem]


class ComparedSessions(TypedDict):
    """Two sessions that were compared. status: joined, ambiguous, or different: nothing says that they show
    one building. accepted: the join counts; other pairs and labels do not contradict it. T_target_source:
    null if the status is `different`; covariance: (3, 3) of its x, y, yaw. probability: that it is right.
    agreement: of the walls where both know the ground, 0..1. common_m2: free ground that both know. nodes: of
    the junction graphs, that agree on it."""

    target: str
    source: str
    status: Literal["joined", "ambiguous", "different"]
    accepted: bool
    T_target_source: Pose | None
    covariance: list[list[float]] | None
    probability: float
    agreement: float
    common_m2: float
    nodes: int


class DbJoin(OfDatabase):
    """`pc2grid db join --json`. stored: false with --dry-run. sessions: those that were joined. alone: the
    names of the others."""

    stored: bool
    pairs: list[ComparedSessions]
    sessions: list[JoinedSession]
    alone: list[str]


class Export(OfDatabase):
    """`pc2grid export --json`; session is null if only a report was written."""

    session: str | None
    written: list[str]


class Simulate(Printed):
    """`pc2grid simulate --json`; clutter: objects that could be placed."""

    recording: str
    truth: str
    sensor: str
    scans: int
    duration_s: float
    length_m: float
    clutter: int


DOCUMENTS: dict[str, type] = {
    "convert": Convert,
    "db-check": DbCheck,
    "db-copy": DbWrite,
    "db-info": DbInfo,
    "db-join": DbJoin,
    "db-merge": DbWrite,
    "db-remove": DbWrite,
    "db-rename": DbWrite,
    "db-split": DbWrite,
    "export": Export,
    "info": Info,
    "info-map": InfoMap,
    "relocalize": Relocalize,
    "relocalize-check": RelocalizeCheck,
    "simulate": Simulate,
    "watch": Watch,
    "watch-check": WatchCheck,
}
"""By command."""


def plain(kind: type[Document], document: Document) -> Any:
    """A document of plain types: the frozen types in it become objects, with the digits that they declare."""
    return TypeAdapter(kind).dump_python(document, mode="json")


def schema(name: str) -> dict[str, Any]:
    """JSON Schema of a command's document, or of all `settings` as TOML holds them. Raises KeyError."""
    kind = Config if name == "settings" else DOCUMENTS[name]
    about = TypeAdapter(kind).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **about}
