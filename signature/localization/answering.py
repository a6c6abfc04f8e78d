"""From a query and the hypotheses for it to its answer.

By what it has seen over the last metres, and by what was known before; refined and checked in space, where
both sides have points.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from pc2grid.threads import one_blas_thread
from signature.localization.answer import Answer, Moment, OffMap, Verdict
from signature.localization.belief import Masses
from signature.localization.decision import PriorOf, beside_map, decide, judge, with_slip
from signature.localization.hypotheses import Hypothesis, moved_to_origin
from signature.localization.in_space import settle_in_space
from signature.localization.map_index import MapIndex
from signature.localization.query import Query, QueryMap, map_as_query


class Clock:
    """Adds up elapsed times by name, milliseconds. All time since the last lap belongs to the next one."""

    def __init__(self) -> None:
        self.total_ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add the time since the last lap to `name`."""
        now = time.perf_counter()
        self.total_ms[name] = self.total_ms.get(name, 0.0) + 1000.0 * (now - self._last)
        self._last = now


def answer_query(
    index: MapIndex,
    query: Query,
    seen: QueryMap,
    known: tuple[Hypothesis, ...],
    *,
    prior_of: PriorOf,
    off_map: Sequence[OffMap],
    session_index: int | None,
    history: tuple[Moment, ...],
    clock: Clock,
) -> Answer:
    """Where a query is.

    seen : `query` drawn. known : hypotheses that are compared, too. prior_of : what was known before it, of
    each place. off_map : where it may be beside the map, see `signature.localization.belief.Belief.off_map`.
    session_index : of the map that is preferred among several that show the place.
    """
    verdict, found = decide(index, seen, known, prior_of)
    clock.lap("search")
    prior, excluded = _with_prior(index, seen, verdict, found)
    verdict = beside_map(verdict, seen, prior_of, off_map, index.config.accept)
    verdict = _in_map(_with_slip(index, query, verdict), session_index)
    clock.lap("decide")
    in_space = None
    if query.in_space is not None:
        verdict, in_space = settle_in_space(verdict, query.in_space, index.surface, index.config.accept)
        clock.lap("in_space")
    answer = _answer(index, seen, verdict, history)
    timing_ms = dict(clock.total_ms)
    return replace(answer, prior=prior, excluded=excluded, in_space=in_space, timing_ms=timing_ms)


def _with_prior(
    index: MapIndex, query: QueryMap, verdict: Verdict, found: tuple[Hypothesis, ...]
) -> tuple[Literal["used", "lapsed", "ahead"] | None, Moment | None]:
    """What became of the prior, and the best place of those found that it excludes, where nothing is certain
    that it allows."""
    if index.whole is None or index.region is None:
        return None, None
    if not index.prior_applies(query):
        return "ahead" if index.region.is_ahead(query) else "lapsed", None
    if verdict.status == "located":
        return "used", None
    best = judge(index.whole, query, found)
    excluded = best.hypotheses and not index.allows(query, best.hypotheses[0])
    return "used", moment_of(index.whole, query, best) if excluded else None


def _with_slip(index: MapIndex, query: Query, verdict: Verdict) -> Verdict:
    """The verdict, by what the scans since the likeliest slip say alone."""
    evidence = verdict.evidence
    if not evidence.tail or min(evidence.tail) >= 0.0:
        return verdict
    since = query.since(evidence.scans_since).map()
    alone, _ = decide(index, since)
    here = Masses.of(since, alone).mass([verdict.hypotheses[0]])
    found = alone.confidence and math.exp(alone.evidence.log_odds()) / alone.confidence
    elsewhere = 1.0 + found * (sum(alone.masses) - here)
    return with_slip(verdict, elsewhere, index.config.accept)


def _in_map(verdict: Verdict, session_index: int | None) -> Verdict:
    """The verdict in which, of each place, the hypothesis in the map of one session comes first."""
    ordered = sorted(
        zip(verdict.places, verdict.hypotheses, strict=True),
        key=lambda each: (each[0], each[1].session_index != session_index),
    )
    return replace(verdict, hypotheses=tuple(h for _, h in ordered))


@one_blas_thread
def locate_map(grid: OccupancyGrid, index: MapIndex) -> Answer:
    """Find where a drawn map, for example a nav2 map or a part of one, lies in the building.

    grid : the query, in any frame of its own; cells that it does not know must be unknown, not free.

    There is no robot in it, so the "base" of the answer is the map's own frame: `T_map_base` and
    `T_map_odom` both are T_map_query, and the travelled path is 0 m long.

    >>> import pc2grid, signature
    >>> with signature.open_database("plan.submaps") as database:
    ...     answer = locate_map(pc2grid.load_map("part.yaml"), MapIndex.of(database, database.config()))
    >>> answer.status, round(answer.T_map_base.x, 1), round(answer.T_map_base.y, 1)
    ('located', 4.0, 3.0)
    """
    clock = Clock()
    query = map_as_query(grid, index.made_with, index.config, drawn=True)
    clock.lap("describe")
    verdict, _ = decide(index, query)
    clock.lap("search")
    at_origin = tuple(_at_origin(h, query.T_odom_base) for h in verdict.hypotheses)
    verdict = replace(verdict, hypotheses=at_origin)
    answer = _answer(index, replace(query, T_odom_base=SE2()), verdict, ())
    return replace(answer, timing_ms=clock.total_ms)


def _at_origin(hypothesis: Hypothesis, at: SE2) -> Hypothesis:
    """The hypothesis with its covariance, known for the point `at` of the query, at the query's origin."""
    fit = hypothesis.fit
    covariance = moved_to_origin(fit.covariance, fit.T_map_query, at)
    return replace(hypothesis, fit=replace(fit, covariance=covariance))


def moment_of(index: MapIndex, query: QueryMap, verdict: Verdict) -> Moment:
    """The state of the answer now."""
    best = verdict.hypotheses[0] if verdict.hypotheses else None
    return Moment(
        stamp_ns=query.stamp_ns,
        path_m=query.path_m,
        status=verdict.status,
        session=index.sessions[best.session_index] if best else None,
        pose=best.fit.T_map_query @ query.T_odom_base if best else None,
        confidence=verdict.confidence,
    )


def _answer(index: MapIndex, query: QueryMap, verdict: Verdict, history: tuple[Moment, ...]) -> Answer:
    located = verdict.hypotheses[0] if verdict.status == "located" else None
    table = index.places.table
    T_map_query = located.fit.T_map_query if located else None
    return Answer(
        status=verdict.status,
        session=index.sessions[located.session_index] if located else None,
        stamp_ns=query.stamp_ns,
        T_map_base=T_map_query @ query.T_odom_base if T_map_query else None,
        covariance=located.fit.covariance if located else None,
        T_map_odom=T_map_query,
        confidence=verdict.confidence,
        hypotheses=verdict.hypotheses,
        places=verdict.places,
        masses=verdict.masses,
        off_map=verdict.off_map,
        history=(*history, moment_of(index, query, verdict)),
        T_odom_base=query.T_odom_base,
        path_m=query.path_m,
        sessions=index.sessions,
        labels=index.labels,
        submap_ids=tuple(int(table.submap_id[h.row]) if h.row >= 0 else -1 for h in verdict.hypotheses),
        evidence=verdict.evidence,
        local_map=query.grid,
        map=index.grids[verdict.hypotheses[0].session_index] if verdict.hypotheses else None,
        views_m=tuple(view.center_m for view in query.views),
    )
