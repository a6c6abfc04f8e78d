"""Where in the database was this recording made? Retrieve, verify, carry on, decide.

Hypotheses are carried along the query's travel: at every step the old ones are refined on what has been
seen since, and the database is asked anew, so a wrong first idea costs nothing and the right one gains
support. The answer is `located` only when one hypothesis stands clear of all others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pc2grid.alignment import LikelihoodField, prepare
from pc2grid.errors import NoScans
from pc2grid.geometry import F64, SE2
from pc2grid.model import Health, OccupancyGrid, RegisteredScan
from pc2grid.sweep import Sweep
from signature.confidence import CALIBRATION, Evidence
from signature.config import Config
from signature.query import QueryMap, Window, query_of
from signature.retrieve import Places, retrieve
from signature.verify import Hypothesis, carry_on, distinct, search_everywhere, verify

if TYPE_CHECKING:
    from signature.database import SubmapDatabase
    from signature.similarity import SignatureTable

SCHEMA_VERSION = 1

Status = Literal["located", "ambiguous", "not_found"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """The answer as it stood after `path_m` of travel; the pose is of the best hypothesis, if any."""

    stamp_ns: int
    path_m: float
    status: Status
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
    hypotheses : all that fit, best first. history : how the answer came to be.
    evidence : what the confidence rests on.
    """

    status: Status
    session: str | None
    stamp_ns: int
    T_map_base: SE2 | None
    covariance: F64 | None
    T_map_odom: SE2 | None
    confidence: float
    hypotheses: tuple[Hypothesis, ...]
    history: tuple[Moment, ...]
    T_odom_base: SE2
    path_m: float
    sessions: tuple[str, ...]
    submap_ids: tuple[int, ...]
    evidence: Evidence
    timing_ms: dict[str, float] = field(default_factory=dict)

    def to_json(
        self, *, query: dict[str, Any] | None = None, database: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """The document that `pc2grid relocalize --json` prints (plain types only)."""
        pose = self.T_map_base
        return {
            "schema_version": SCHEMA_VERSION,
            "status": self.status,
            "session": self.session,
            "pose": None
            if pose is None or self.covariance is None
            else {"stamp_ns": self.stamp_ns, **_plain(pose), "covariance": self.covariance.tolist()},
            "T_map_odom": None if self.T_map_odom is None else _plain(self.T_map_odom),
            "confidence": self.confidence,
            "hypotheses": [
                {
                    "session": self.sessions[h.session_index],
                    "submap_id": submap_id if submap_id >= 0 else None,
                    **_plain(h.fit.T_map_query @ self.T_odom_base),
                    "score": h.fit.score,
                    "overlap": h.fit.overlap,
                }
                for h, submap_id in zip(self.hypotheses, self.submap_ids, strict=True)
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


class Building:
    """Maps and their places made ready to be asked again and again: isovists and likelihood fields.

    Made once (tens of milliseconds a map), used for every query; it changes nothing.
    """

    def __init__(
        self, grids: Mapping[str, OccupancyGrid], table: SignatureTable, made_with: Config, config: Config
    ) -> None:
        """grids : map of each session, in the order that `table.session_index` counts.

        made_with : how the places were cut and described; queries are treated alike.
        config : its relocalize section says how to search and when to be sure.
        """
        self.made_with = made_with
        self.config = config.relocalize
        self.sessions = tuple(grids)
        maps = tuple(grids.values())
        self.places = Places.of(table, dict(enumerate(maps)), made_with.partition.radius_m)
        self.fields: tuple[LikelihoodField, ...] = tuple(prepare(grid) for grid in maps)
        self._free = tuple(free_squares(grid) for grid in maps)
        self._area_m2 = tuple(float(grid.free.sum()) * grid.resolution_m**2 for grid in maps)

    @staticmethod
    def of(database: SubmapDatabase, config: Config) -> Building:
        """Everything that is in a database."""
        grids = {info.name: database.grid(info.name) for info in database.sessions()}
        return Building(grids, database.signatures(), database.config(), config)

    def look_up(
        self, query: QueryMap, carried: tuple[Hypothesis, ...] = (), *, driven_m: float = 0.0
    ) -> tuple[Hypothesis, ...]:
        """Hypotheses for the query, best first: the carried ones, refined, and what retrieval proposes."""
        old = [carry_on(query, h, self.fields[h.session_index], driven_m) for h in carried]
        proposals = retrieve(query, self.places, signature=self.made_with.signature, config=self.config)
        new = verify(query, proposals, self.places, self.fields, self.config)
        return self._worth_keeping((*old, *new), query)

    def look_everywhere(self, query: QueryMap, known: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
        """`known` and whatever fits anywhere on the maps that are small enough to be searched as a whole."""
        found = list(known)
        for index, field_ in enumerate(self.fields):
            if self._area_m2[index] <= self.config.exhaustive_m2:
                found.extend(search_everywhere(query, index, field_, self._free[index], self.config))
        return self._worth_keeping(tuple(found), query)

    def _worth_keeping(self, found: tuple[Hypothesis, ...], query: QueryMap) -> tuple[Hypothesis, ...]:
        kept = distinct(found, query.T_odom_base)
        floor = 0.6 * kept[0].fit.score if kept else 0.0
        return tuple(h for h in kept if h.fit.score >= floor)[: self.config.hypotheses]

    def judge(self, hypotheses: tuple[Hypothesis, ...], query: QueryMap) -> tuple[Status, float]:
        """The status and the probability that the best hypothesis is right."""
        if not hypotheses:
            return "not_found", 0.0
        p = CALIBRATION.probabilities(Evidence.of(hypotheses, len(query.aligned.walls_m)))
        best, none = float(p[0]), float(p[-1])
        if best >= self.config.accept:
            return "located", best
        return ("ambiguous" if best > none else "not_found"), best


def free_squares(grid: OccupancyGrid, side_m: float = 0.8) -> F64:
    """Centres (K, 2) of the squares of `side_m` of a grid that hold any free space, map frame."""
    n = max(1, round(side_m / grid.resolution_m))
    height, width = grid.cells.shape
    if not height or not width:
        return np.empty((0, 2))
    rows, columns = np.arange(0, height, n), np.arange(0, width, n)
    free = np.add.reduceat(np.add.reduceat(grid.free.astype(np.int32), rows, axis=0), columns, axis=1)
    corners = np.argwhere(free > 0)[:, ::-1] * (n * grid.resolution_m)
    return np.asarray(corners + 0.5 * n * grid.resolution_m + np.asarray(grid.origin_m))


class Relocalizer:
    """Takes in a query scan by scan and can say at any time where it is.

    Scans on which registration was lost are not used, and nothing seen before them is kept: what lies
    between the two parts is unknown.
    """

    def __init__(self, building: Building) -> None:
        self._building = building
        self._clock = _Clock()
        self._history: list[Moment] = []
        self._forget()

    def _forget(self) -> None:
        self._window = Window(self._building.made_with.projection, self._building.config)
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._asked_m: float | None = None

    @property
    def path_m(self) -> float:
        """Metres driven since the start, or since registration was lost."""
        return self._window.path_m

    def add(self, registered: RegisteredScan, sweep: Sweep) -> None:
        """The next scan. Every `relocalize.step_m` of travel the database is asked again."""
        self._clock.lap("register")
        if registered.health is Health.LOST:
            self._forget()
            return
        self._window.add(sweep, SE2.flatten(registered.T_map_base))
        if self.path_m - (self._asked_m or 0.0) >= self._building.config.step_m:
            query, status, sure = self._ask()
            self._history.append(_moment(query, status, sure, self._hypotheses))

    def answer(self) -> Answer:
        """Where the query is by all that it has seen. Raises NoScans if no scan could be used."""
        self._clock.lap("register")
        if not len(self._window):
            raise NoScans("no scan of the query could be registered", hint="look at it with `pc2grid info`")
        query, status, sure = self._ask()
        if status != "located":
            # Signatures did not settle it: leave no place out, neither the right one nor a rival.
            self._hypotheses = self._building.look_everywhere(query, self._hypotheses)
            status, sure = self._building.judge(self._hypotheses, query)
            self._clock.lap("search_everywhere")
        history = (*self._history, _moment(query, status, sure, self._hypotheses))
        return _answer(
            self._building, query, status, sure, self._hypotheses, history, dict(self._clock.total_ms)
        )

    def query(self) -> QueryMap:
        """What the query has seen over its last metres, described as the database is."""
        return self._window.query(self._building.made_with.partition, self._building.made_with.signature)

    def _ask(self) -> tuple[QueryMap, Status, float]:
        building = self._building
        query = self.query()
        self._clock.lap("describe")
        driven = 0.0 if self._asked_m is None else self.path_m - self._asked_m
        self._asked_m = self.path_m
        self._hypotheses = building.look_up(query, self._hypotheses, driven_m=driven)
        status, sure = building.judge(self._hypotheses, query)
        self._clock.lap("look_up")
        return query, status, sure


def relocalize(
    query: Iterable[tuple[RegisteredScan, Sweep]],
    database: SubmapDatabase,
    config: Config,
    progress: Callable[[int, float], None] | None = None,
) -> Answer:
    """Find where a registered recording was made.

    query : scans with their sweeps, from `pc2grid.pipeline.follow`, in any frame of their own.
    progress : called with (scans so far, metres driven).

    Raises NoScans for a query without a usable scan.
    """
    relocalizer = Relocalizer(Building.of(database, config))
    for count, (registered, sweep) in enumerate(query, start=1):
        relocalizer.add(registered, sweep)
        if progress is not None:
            progress(count, relocalizer.path_m)
    return relocalizer.answer()


def locate_map(grid: OccupancyGrid, building: Building) -> Answer:
    """Find where a drawn map, say a nav2 map or a part of one, lies in the building.

    grid : the query, in any frame of its own; what it does not know is unknown, not empty.

    There is no robot in it, so the "base" of the answer is the map's own frame: `T_map_base` and
    `T_map_odom` both are T_map_query, and no way has been travelled.
    """
    clock = _Clock()
    made_with = building.made_with
    query = query_of(
        grid,
        np.empty((0, 2)),
        partition=made_with.partition,
        signature=made_with.signature,
        config=building.config,
        T_odom_base=SE2(),
    )
    # A map's origin may lie anywhere, far outside its walls too. Poses turn about the best observed
    # point instead: it is free, and the walls around it are known.
    if query.views:
        center = query.views[0].center_m
        query = replace(query, T_odom_base=SE2(*center), aligned=replace(query.aligned, center_m=center))
    clock.lap("describe")
    hypotheses = building.look_up(query)
    status, sure = building.judge(hypotheses, query)
    clock.lap("look_up")
    if status != "located":
        hypotheses = building.look_everywhere(query, hypotheses)
        status, sure = building.judge(hypotheses, query)
        clock.lap("search_everywhere")
    hypotheses = tuple(_at_origin(h, query.T_odom_base) for h in hypotheses)
    query = replace(query, T_odom_base=SE2())
    history = (_moment(query, status, sure, hypotheses),)
    return _answer(building, query, status, sure, hypotheses, history, dict(clock.total_ms))


def _at_origin(hypothesis: Hypothesis, at: SE2) -> Hypothesis:
    """Its covariance, known for the point `at` of the query, as that of the query's own frame."""
    fit = hypothesis.fit
    there = fit.T_map_query @ at
    J = np.eye(3)
    J[:2, 2] = there.y - fit.T_map_query.y, fit.T_map_query.x - there.x
    return replace(hypothesis, fit=replace(fit, covariance=J @ fit.covariance @ J.T))


def _moment(query: QueryMap, status: Status, sure: float, hypotheses: tuple[Hypothesis, ...]) -> Moment:
    pose = hypotheses[0].fit.T_map_query @ query.T_odom_base if hypotheses else None
    return Moment(stamp_ns=query.stamp_ns, path_m=query.path_m, status=status, pose=pose, confidence=sure)


def _answer(
    building: Building,
    query: QueryMap,
    status: Status,
    sure: float,
    hypotheses: tuple[Hypothesis, ...],
    history: tuple[Moment, ...],
    timing_ms: dict[str, float],
) -> Answer:
    located = hypotheses[0] if status == "located" else None
    table = building.places.table
    T_map_query = located.fit.T_map_query if located else None
    return Answer(
        status=status,
        session=building.sessions[located.session_index] if located else None,
        stamp_ns=query.stamp_ns,
        T_map_base=T_map_query @ query.T_odom_base if T_map_query else None,
        covariance=located.fit.covariance if located else None,
        T_map_odom=T_map_query,
        confidence=sure,
        hypotheses=hypotheses,
        history=history,
        T_odom_base=query.T_odom_base,
        path_m=query.path_m,
        sessions=building.sessions,
        submap_ids=tuple(int(table.submap_id[h.row]) if h.row >= 0 else -1 for h in hypotheses),
        evidence=Evidence.of(hypotheses, len(query.aligned.walls_m)),
        timing_ms=timing_ms,
    )


class _Clock:
    """Where the time went, by name, milliseconds."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.total_ms: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.total_ms[name] = self.total_ms.get(name, 0.0) + 1000.0 * (now - self._last)
        self._last = now
