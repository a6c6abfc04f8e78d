"""The answer to "where was this?", and how it reads as a document."""

from __future__ import annotations

from dataclasses import dataclass, field

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from signature.database.protocol import Label
from signature.relocalization.answer_json import AnswerDocument, document
from signature.relocalization.answer_json import Status as Status
from signature.relocalization.confidence import Evidence
from signature.relocalization.hypotheses import Hypothesis


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The decision over all hypotheses.

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
        """Building and floor of the session it was located in, as far as they are known."""
        return Label() if self.status != "located" else self.labels[self.hypotheses[0].session_index]

    def to_json(self) -> AnswerDocument:
        """The answer as plain types: most of what `pc2grid relocalize --json` prints."""
        return document(self)
