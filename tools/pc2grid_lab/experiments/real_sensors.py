"""Maps by one sensor, queries by another, on real data of one floor.

Two sources show the floor, recorded in different years. Its 3D scan is driven through with a lidar and a
depth camera, whose true poses are known in the frame of the scan ("floor"); it is a map itself, too. The log
of a real 2D laser has its poses in a frame of its own ("log"). Nobody has measured how the two frames lie to
each other, but all right answers across them imply the same rigid transform, and wrong ones imply scattered
ones. So the transform that most answers agree with is taken for the truth. Each answer is judged by the
transform that is fitted to the other queries only.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import SensorKind
from pc2grid_lab.experiments.calibration import share_by_session
from pc2grid_lab.experiments.frames import apart, fit_frame
from pc2grid_lab.experiments.judgement import judge
from pc2grid_lab.experiments.metrics import QueryCounts, errors_m
from pc2grid_lab.experiments.sensor_map import MapKind, SensorMap
from pc2grid_lab.experiments.trial import Trial
from signature.localization.localizer import Answer
from signature.localization.query import QueryMap

Frame = Literal["floor", "log"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameAgreementParameters:
    """How the transform between the two frames is found. All chosen by hand.

    near_m, near_rad : an answer agrees with a transform within this. Maps of two sensors and years differ by
        some centimetres; the next place that looks alike is a metre or more away.
    lever_m : the heading of an answer counts as much as the position of a point so far ahead.
    rounds : how often the transform is fitted to the answers that agree with it.
    right_m : largest error of position of a right answer.
    resamples : of the bootstrap.
    """

    near_m: float = 0.5
    near_rad: float = math.radians(5.0)
    lever_m: float = 1.0
    rounds: int = 5
    right_m: float = 0.5
    resamples: int = 2000


AGREEMENT = FrameAgreementParameters()


def frame_of(sensor: MapKind) -> Frame:
    """The frame that true poses of a sensor, or the places of a map, are in: only the laser is real."""
    return "log" if sensor == "laser" else "floor"


@dataclass(frozen=True, slots=True, kw_only=True)
class RealQuery:
    """A query and its answers in several maps.

    seed : number of the session, for a window of the log its first second.
    T_frame_base : true pose of the base at the last scan, in the frame of the sensor.
    answers, look_up_ms : by the name of the map.
    """

    sensor: SensorKind
    seed: int
    T_frame_base: SE2
    query: QueryMap
    answers: Mapping[str, Answer]
    look_up_ms: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class _Clue:
    """One answer across the frames: the pose of the base in both. query : number of the query."""

    query: int
    T_floor_base: SE2
    T_log_base: SE2

    @property
    def T_floor_log(self) -> SE2:
        """The transform that it implies."""
        return self.T_floor_base @ self.T_log_base.inverse()

    def agrees(self, T_floor_log: SE2) -> bool:
        """Whether the transform brings the two poses together."""
        metres, radians = apart(self.T_floor_base, T_floor_log @ self.T_log_base)
        return metres <= AGREEMENT.near_m and radians <= AGREEMENT.near_rad


@dataclass(frozen=True, slots=True)
class FrameAgreement:
    """The rigid transform between the frames.

    T_floor_log : fitted to all answers that agree with it; None without an answer across the frames.
    agreeing : how many of `clues` agree.
    """

    T_floor_log: SE2 | None
    agreeing: int
    clues: tuple[_Clue, ...]

    @staticmethod
    def of(queries: Sequence[RealQuery], maps: Mapping[str, SensorMap]) -> FrameAgreement:
        """Of the best hypothesis of every answer across the frames, whatever its status is.

        Each implies a transform; the one that most answers agree with is kept and fitted to them.
        """
        clues = tuple(
            _clue(number, query, maps[name], answer)
            for number, query in enumerate(queries)
            for name, answer in query.answers.items()
            if answer.hypotheses and frame_of(query.sensor) != frame_of(maps[name].sensor)
        )
        if not clues:
            return FrameAgreement(None, 0, clues)

        def agreeing(T_floor_log: SE2) -> list[_Clue]:
            return [clue for clue in clues if clue.agrees(T_floor_log)]

        best = max((clue.T_floor_log for clue in clues), key=lambda T: len(agreeing(T)))
        for _ in range(AGREEMENT.rounds):
            best = _fit(agreeing(best)) or best
        return FrameAgreement(best, len(agreeing(best)), clues)

    def without(self, query: int) -> SE2 | None:
        """The same transform fitted without the answers to one query, so that none is judged by itself."""
        best = self.T_floor_log
        if best is None:
            return None
        return _fit([clue for clue in self.clues if clue.query != query and clue.agrees(best)])


def _clue(number: int, query: RealQuery, sensor_map: SensorMap, answer: Answer) -> _Clue:
    found = sensor_map.T_plan_map @ answer.hypotheses[0].fit.T_map_query @ answer.T_odom_base
    if frame_of(query.sensor) == "log":
        return _Clue(number, found, query.T_frame_base)
    return _Clue(number, query.T_frame_base, found)


def _fit(clues: Sequence[_Clue]) -> SE2 | None:
    """The transform nearest to all of them, least squares; None for fewer than two."""
    if len(clues) < 2:
        return None
    return fit_frame([(clue.T_log_base, clue.T_floor_base) for clue in clues], AGREEMENT.lever_m)


def judge_all(
    queries: Sequence[RealQuery], maps: Mapping[str, SensorMap], agreement: FrameAgreement
) -> list[Trial]:
    """Every answer with its truth. Answers across the frames are left out where no transform is known."""
    trials = []
    for number, query in enumerate(queries):
        T_floor_log = agreement.without(number)
        for name, answer in query.answers.items():
            T_plan_base: SE2 | None = query.T_frame_base
            if frame_of(query.sensor) != frame_of(maps[name].sensor):
                T_plan_base = _across(T_floor_log, query)
            if T_plan_base is None:
                continue
            trials.append(
                judge(
                    maps[name],
                    query.query,
                    answer,
                    T_plan_base,
                    building=maps[name].name,
                    query_sensor=query.sensor,
                    seed=query.seed,
                    travel_m=answer.path_m,
                    look_up_ms=query.look_up_ms[name],
                    right_m=AGREEMENT.right_m,
                )
            )
    return trials


def _across(T_floor_log: SE2 | None, query: RealQuery) -> SE2 | None:
    """The true pose of a query in the other frame."""
    if T_floor_log is None:
        return None
    is_log = frame_of(query.sensor) == "log"
    return (T_floor_log if is_log else T_floor_log.inverse()) @ query.T_frame_base


@dataclass(frozen=True, slots=True, kw_only=True)
class RealCell:
    """Queries of one sensor in the map by another.

    queries: all of them. right_first: those whose best hypothesis is right, whatever the status is.
    located_right: those located and right, wherever they lie. in_map: those that lie where the map has been
    made, so that there is a right answer; the next four count these. right: located and right; wrong: located
    and not right. right_share: right of in_map, with the 95 % interval low..high of a bootstrap by session.
    refused_outside, wrong_outside: of the queries that lie elsewhere, not located, and located and wrong.
    median_error_m, p95_error_m: of those located and right. All shares and errors are null where there is
    nothing to count.
    """

    map_sensor: str
    query_sensor: str
    queries: int
    right_first: int
    located_right: int
    in_map: int
    right: int
    wrong: int
    ambiguous: int
    not_found: int
    right_share: float | None
    low: float | None
    high: float | None
    refused_outside: int
    wrong_outside: int
    median_error_m: float | None
    p95_error_m: float | None


def real_cells(trials: Sequence[Trial]) -> list[RealCell]:
    """A cell for each pair of sensors that was tried."""
    groups: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.map_sensor, trial.query_sensor), []).append(trial)
    return [_cell(*pair, members) for pair, members in sorted(groups.items())]


def _cell(map_sensor: str, query_sensor: str, trials: Sequence[Trial]) -> RealCell:
    counts = QueryCounts.of(trials)
    inside = [t for t in trials if t.in_map]
    statuses = Counter(t.status for t in inside)
    right = [t for t in trials if t.status == "located" and t.right]
    low, high = share_interval(inside)
    return RealCell(
        map_sensor=map_sensor,
        query_sensor=query_sensor,
        queries=len(trials),
        right_first=sum(t.right for t in trials),
        located_right=len(right),
        in_map=counts.inside,
        right=counts.right,
        wrong=counts.wrong,
        ambiguous=statuses["ambiguous"],
        not_found=statuses["not_found"],
        right_share=counts.right / counts.inside if inside else None,
        low=low,
        high=high,
        refused_outside=counts.refused,
        wrong_outside=counts.wrong_outside,
        **errors_m(right),
    )


def share_interval(trials: Sequence[Trial]) -> tuple[float | None, float | None]:
    """95 % interval of the share located and right, by resampling whole sessions (percentile bootstrap).

    Answers to one session depend on each other, so they are drawn together. Where all answers are alike the
    interval has no width; with n sessions the true share may still differ by about 3 / n.
    """
    if not trials:
        return None, None
    right = np.array([t.status == "located" and t.right for t in trials])
    seeds = [t.seed for t in trials]
    return share_by_session(seeds, right, draws=AGREEMENT.resamples, percentiles=(2.5, 97.5))[1:]
