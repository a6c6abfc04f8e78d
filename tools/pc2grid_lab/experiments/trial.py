"""One answer together with the truth: the type that all measurements of relocalization are made of."""

from __future__ import annotations

import math
from dataclasses import dataclass

from signature.localization.answer_json import Status


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgementParameters:
    """When an answer counts as right. All chosen by hand.

    right_m, right_rad : the pose is right within this of the true one.
    right_recorded_m : the same for real recordings, whose truth is another program's map and has an error of
        a few centimetres itself.
    mapped : a query counts as lying in the map if at least this share of its walls lies on ground that the
        map knows. Where the mapping robot has never been no answer could be right.
    retrieved_m : a retrieved place is right within this of the true position of the view that retrieved it.
    """

    right_m: float = 0.25
    right_rad: float = math.radians(3.0)
    right_recorded_m: float = 0.3
    mapped: float = 0.5
    retrieved_m: float = 1.0


JUDGEMENT = JudgementParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A query whose true place is known, and the answer to it.

    building: of the map. in_building: the query comes from that building; if not, nothing is right. mapped:
    share of the query's walls, placed as they truly are, that lie on ground that the map knows, 0..1. status,
    confidence, error_m, error_rad: of the best hypothesis; the errors are null if there is none. right: the
    error of the best hypothesis is small enough. rank: of the first right place among those retrieved, -1 if
    there is none; alone: the same by each combination of signatures, without isovists. forward, walls,
    backward, looked_at, lead, likeness: the evidence of the decision, see
    `signature.localization.posterior`; agreement: the better one of forward and backward. In the results
    of earlier versions, forward, backward, looked_at and likeness are null. query_building: of
    the query; null in the results of earlier versions.
    """

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
    agreement: float
    walls: float
    lead: float
    look_up_ms: float
    forward: float | None = None
    backward: float | None = None
    looked_at: float | None = None
    likeness: float | None = None
    query_building: str | None = None

    @property
    def buildings(self) -> frozenset[str]:
        """The buildings of the map and of the query, as far as they are known."""
        return frozenset({self.building, self.query_building or self.building})

    @property
    def in_map(self) -> bool:
        """Whether the query lies where the map has been made, so that there is a right answer."""
        return self.in_building and self.mapped >= JUDGEMENT.mapped
