"""The JSON documents of the commands as types, and their JSON Schemas (draft 2020-12).

Metres, radians, int64 nanoseconds, unless a name says otherwise. Within a `schema_version` documents only
gain keys: a reader must not mind keys it does not know.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import TypeAdapter

# Before Python 3.12 pydantic does not take typing's own.
from typing_extensions import TypedDict

Status = Literal["located", "ambiguous", "not_found"]
Version = Literal[1]


class Pose(TypedDict):
    """A planar pose: metres, and radians counterclockwise."""

    x: float
    y: float
    yaw: float


class StampedPose(Pose):
    """The base in the map frame at the query's last scan; covariance (3, 3) of x, y, yaw."""

    stamp_ns: int
    covariance: list[list[float]]


class Hypothesis(Pose):
    """A place that fits. Equal `place`: the same place in the maps of different sessions. submap_id is null
    if the whole map was searched. score and overlap: shares of what both sides see, 0..1."""

    session: str
    building: str | None
    floor: str | None
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


class Query(TypedDict):
    """What was looked for. sensor: lidar, laser, depth, or map. lossy: data was lost while reading."""

    path_m: float
    stamp_ns: int
    source: str
    scans: int
    sensor: str
    lossy: bool
    warnings: list[str]


class Searched(TypedDict):
    """Where it was looked for. left_out: damage that was not used."""

    sessions: list[str]
    path: str
    left_out: list[str]


class Relocalize(TypedDict):
    """`pc2grid relocalize --json`. T_map_odom puts the query's own frame into the map. confidence: the
    probability that the best hypothesis is right. hypotheses: best first."""

    schema_version: Version
    status: Status
    session: str | None
    building: str | None
    floor: str | None
    pose: StampedPose | None
    T_map_odom: Pose | None
    confidence: float
    hypotheses: list[Hypothesis]
    history: list[Moment]
    query: Query
    database: Searched
    timing_ms: dict[str, float]


class Topic(TypedDict):
    """A topic of a recording; message_count is null if the file does not say."""

    topic: str
    type: str
    encoding: str
    message_count: int | None


class Choice(TypedDict):
    """What `convert` would use, and why."""

    topic: str
    sensor: str
    odometry_topic: str | None
    base_frame: str
    sensor_frame: str
    reason: str


class Info(TypedDict):
    """`pc2grid info --json`. choice is null, and problem says why, if `convert` could not use the log."""

    schema_version: Version
    path: str
    format: str
    size_bytes: int
    start_ns: int
    end_ns: int
    duration_s: float
    message_count: int | None
    topics: list[Topic]
    choice: Choice | None
    problem: str | None
    bytes_lost: int
    warnings: list[str]


class Report(TypedDict):
    """What was read, and lost on the way; scans_skipped counts by reason."""

    scans_read: int
    points_dropped: int
    scans_skipped: dict[str, int]
    bytes_lost: int
    warnings: list[str]
    lossy: bool


class Converted(TypedDict):
    """What became of one input. digest: sha256 of it, hex. area_m2: free space."""

    session: str
    building: str | None
    floor: str | None
    source: str
    digest: str
    sensor: str
    scans: int
    path_m: float
    duration_s: float
    area_m2: float
    submaps: int
    report: Report


class Convert(TypedDict):
    """`pc2grid convert --json`. unchanged: sessions that were stored already; failed: inputs left out."""

    schema_version: Version
    database: str
    lossy: bool
    sessions: list[Converted]
    unchanged: list[str]
    failed: list[str]


class Session(TypedDict):
    """A session of a database, with the versions and settings that made it."""

    name: str
    sensor: str
    building: str | None
    floor: str | None
    source: str
    digest: str
    submaps: int
    resolution_m: float
    area_m2: float
    path_m: float
    duration_s: float
    scans: int
    lossy: bool
    warnings: list[str]
    versions: dict[str, str]
    config: dict[str, Any]


class DbInfo(TypedDict):
    """`pc2grid db info --json`."""

    schema_version: Version
    database: str
    sessions: list[Session]


class Damage(TypedDict):
    """One thing that is wrong."""

    where: str
    what: str


class DbCheck(TypedDict):
    """`pc2grid db check --json`; no problems: sound."""

    schema_version: Version
    database: str
    problems: list[Damage]


class DbWrite(TypedDict):
    """`pc2grid db merge --json` and `pc2grid db copy --json`; left_out: damage that was not copied."""

    schema_version: Version
    database: str
    sessions: int
    left_out: list[Damage]


class Export(TypedDict):
    """`pc2grid export --json`; session is null if only a report was written."""

    schema_version: Version
    database: str
    session: str | None
    written: list[str]


class Simulate(TypedDict):
    """`pc2grid simulate --json`; clutter: pieces that found room."""

    schema_version: Version
    recording: str
    truth: str
    sensor: str
    scans: int
    duration_s: float
    length_m: float
    clutter: int


class Trial(TypedDict):
    """A query whose true place is known. mapped: share of what it saw that the map covers, 0..1. error_m and
    error_rad are of the best hypothesis, null if there is none. rank: of the right place among those
    retrieved, -1 if it is not; alone: the same by each combination of signatures."""

    building: str
    map_sensor: str
    query_sensor: str
    seed: int
    travel_m: float
    in_building: bool
    mapped: float
    status: Status
    confidence: float
    right: bool
    error_m: float | None
    error_rad: float | None
    rank: int
    alone: dict[str, int]
    scores: list[float]
    walls: float
    look_up_ms: float


class CompareLog(TypedDict):
    """`pc2grid compare log --json`. map_s: from and to, seconds of the recording. tally: what became of how
    many."""

    schema_version: Version
    log: str
    map_s: list[float]
    length_s: float
    without_truth: int
    tally: dict[str, int]
    trials: list[Trial]


class CompareMaps(TypedDict):
    """`pc2grid compare maps --json`: a row a session, with the errors of its trajectory and of its cells."""

    schema_version: Version
    rows: list[dict[str, Any]]


class ComparePaper(TypedDict):
    """`pc2grid compare paper --json`: a cell a map, method and noise level, measured beside published."""

    schema_version: Version
    version: str
    queries: int
    seed: int
    cells: list[dict[str, Any]]


class MatrixCell(TypedDict):
    """Queries of one sensor in maps by another after some metres. Shares 0..1 of its trials; wrong: of those
    answered located; recall by how many are retrieved; errors in metres, null if none was located rightly."""

    map_sensor: str
    query_sensor: str
    travel_m: float
    trials: int
    located_right: float
    wrong: float
    ambiguous: float
    not_found: float
    recall: dict[str, float]
    median_error_m: float | None
    p95_error_m: float | None
    look_up_ms: float


class Truthfulness(TypedDict):
    """Whether confidence is true; null without trials. reliability: for each band of confidence its mean, the
    share that was right, and how many."""

    trials: int
    brier: float | None
    expected_error: float | None
    reliability: list[tuple[float, float, int]]


class Elsewhere(TypedDict):
    """What was answered to queries from another building."""

    trials: int
    not_found: int
    located: int


class Apart(TypedDict):
    """How well distances tell one place seen by two sensors from two places; auc is null if nothing was
    compared."""

    auc: float | None
    same: int
    other: int


class Ablation(TypedDict):
    """Recall after travel_m metres by query sensor, by what is used, and by how many are retrieved."""

    travel_m: float
    recall: dict[str, dict[str, dict[str, float | None]]]


class CompareSensors(TypedDict):
    """`pc2grid compare sensors --json`, and its matrix.json. outside_the_map: trials where the map has not
    been."""

    schema_version: Version
    plans: list[str]
    queries: int
    setting: dict[str, float]
    cells: list[MatrixCell]
    confidence: dict[str, Truthfulness]
    outside_the_map: int
    elsewhere: Elsewhere
    independence: dict[str, Apart]
    ablation: Ablation


DOCUMENTS: dict[str, type] = {
    "compare-log": CompareLog,
    "compare-maps": CompareMaps,
    "compare-paper": ComparePaper,
    "compare-sensors": CompareSensors,
    "convert": Convert,
    "db-check": DbCheck,
    "db-copy": DbWrite,
    "db-info": DbInfo,
    "db-merge": DbWrite,
    "export": Export,
    "info": Info,
    "relocalize": Relocalize,
    "simulate": Simulate,
}
"""By command."""


def schema(name: str) -> dict[str, Any]:
    """JSON Schema of a command's document, or of all `settings` as TOML holds them. Raises KeyError."""
    if name == "settings":
        from signature.config import Config

        about = Config.model_json_schema()
    else:
        about = TypeAdapter(DOCUMENTS[name]).json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **about}
