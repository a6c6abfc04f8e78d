"""The answer to "where was this?", and how it reads as a document."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from pc2grid.geometry import F64, SE2
from signature.confidence import Evidence
from signature.database.protocol import Label
from signature.verify import Hypothesis

SCHEMA_VERSION = 1

Status = Literal["located", "ambiguous", "not_found"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What all hypotheses together say.

    confidence : probability that the best hypothesis is right.
    hypotheses : all that fit, best first. places : parallel to them, which of them are the same place, seen
    in the maps of different sessions; numbered from 0, best first.
    evidence : what the confidence rests on: the best hypothesis of each place.
    """

    status: Status
    confidence: float
    hypotheses: tuple[Hypothesis, ...]
    places: tuple[int, ...]
    evidence: Evidence


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The answer as it stood after `path_m` of travel.

    pose : of the best hypothesis, if any, in the map of `session`.
    """

    stamp_ns: int
    path_m: float
    status: Status
    session: str | None
    pose: SE2 | None
    confidence: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Where the query was.

    status : located, ambiguous (several places fit) or not_found (none does).
    session : name of the session whose map frame `T_map_base` is in; None unless located.
    T_map_base : base at the query's last scan. covariance : (3, 3) of x, y, yaw.
    T_map_odom : puts the whole query trajectory into the map.
    confidence : probability that the best hypothesis is right.
    hypotheses : all that fit, best first. places : the place each of them is at, see `Verdict`.
    history : how the answer came to be. evidence : what the confidence rests on.
    sessions, labels : all of the database, that `Hypothesis.session_index` counts.
    """

    status: Status
    session: str | None
    stamp_ns: int
    T_map_base: SE2 | None
    covariance: F64 | None
    T_map_odom: SE2 | None
    confidence: float
    hypotheses: tuple[Hypothesis, ...]
    places: tuple[int, ...]
    history: tuple[Moment, ...]
    T_odom_base: SE2
    path_m: float
    sessions: tuple[str, ...]
    labels: tuple[Label, ...]
    submap_ids: tuple[int, ...]
    evidence: Evidence
    timing_ms: dict[str, float] = field(default_factory=dict)

    @property
    def label(self) -> Label:
        """Building and floor of the session it was located in, as far as they were ever told."""
        return Label() if self.status != "located" else self.labels[self.hypotheses[0].session_index]

    def to_json(
        self, *, query: dict[str, Any] | None = None, database: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """The document that `pc2grid relocalize --json` prints (plain types only)."""
        pose = self.T_map_base
        return {
            "schema_version": SCHEMA_VERSION,
            "status": self.status,
            "session": self.session,
            "building": self.label.building,
            "floor": self.label.floor,
            "pose": None
            if pose is None or self.covariance is None
            else {"stamp_ns": self.stamp_ns, **_plain(pose), "covariance": self.covariance.tolist()},
            "T_map_odom": None if self.T_map_odom is None else _plain(self.T_map_odom),
            "confidence": self.confidence,
            "hypotheses": [
                {
                    "session": self.sessions[h.session_index],
                    "building": self.labels[h.session_index].building,
                    "floor": self.labels[h.session_index].floor,
                    "submap_id": submap_id if submap_id >= 0 else None,
                    "place": place,
                    **_plain(h.fit.T_map_query @ self.T_odom_base),
                    "score": h.fit.score,
                    "overlap": h.fit.overlap,
                }
                for h, submap_id, place in zip(self.hypotheses, self.submap_ids, self.places, strict=True)
            ],
            "history": [
                {
                    "stamp_ns": m.stamp_ns,
                    "path_m": m.path_m,
                    "status": m.status,
                    **(_plain(m.pose) if m.pose is not None else {"x": None, "y": None, "yaw": None}),
                    "confidence": m.confidence,
                }
                for m in self.history
            ],
            "query": {"path_m": self.path_m, "stamp_ns": self.stamp_ns, **(query or {})},
            "database": {"sessions": list(self.sessions), **(database or {})},
            "timing_ms": self.timing_ms,
        }


def _plain(pose: SE2) -> dict[str, float]:
    return {"x": float(pose.x), "y": float(pose.y), "yaw": float(pose.yaw)}
