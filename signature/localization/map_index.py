"""The maps and places of a database, prepared to be searched."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.errors import ConfigError, DatabaseCorrupt
from pc2grid.geometry import SE2
from pc2grid.matching.refinement import refine
from pc2grid.matching.two_way_score import Fit, score_fit
from pc2grid.matching.window_search import SearchMap
from pc2grid.model import OccupancyGrid, same_recording
from pc2grid.observer import Observer
from signature.config import Config
from signature.database.protocol import Label
from signature.localization.answer import Status, Verdict
from signature.localization.hypotheses import (
    HYPOTHESES,
    Hypothesis,
    coarse_score,
    distinct,
    fitted,
    search_whole_map,
    verify,
)
from signature.localization.in_space import PointsOf, points_reader
from signature.localization.lazy_maps import DatabaseGrids, LazySequence
from signature.localization.posterior import (
    NO_EVIDENCE,
    POSTERIOR,
    Evidence,
    alike,
    evidence_of,
    in_the_map,
    masses,
    off_map,
    tail_of,
)
from signature.localization.prior import PRIOR, Prior
from signature.localization.query import QueryMap, query_of
from signature.localization.same_place import same_place, share_known, surroundings_agree
from signature.retrieval.viewpoints import AT_ONCE_M2, Places
from signature.retrieval.vote import retrieve
from signature.seen_places import SeenPlaces
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    from signature.database import SubmapDatabase


@dataclass(frozen=True, slots=True, kw_only=True)
class AlikeFloors:
    """When the maps of two floors look alike, and when the query may have been made on either. By hand.

    agreement, overlap : the maps of two floors look alike if so much of what both know agrees, and so much of
        the walls of one is known to the other. Simulated floors with one plan and other furniture reach 0.82
        and 0.45; a mirrored plan reaches 0.88, but 0.24.
    seen_there : where two floors look alike, and the map of the other one shows less than this share of what
        the query has seen, the query may have been made there as well; and so it may if what is known there
        agrees with it as well as here.
    """

    agreement: float = 0.8
    overlap: float = 0.35
    seen_there: float = 0.6


ALIKE_FLOORS = AlikeFloors()
_KEEP = 0.6
"""Hypotheses scoring below this share of the best are dropped: a place so far behind has no mass."""
SEARCHED = 0.9
"""Whole maps are searched for what reaches this share of the best coarse score: takes half as long as 0.8."""
_COMPARED = 5
"""Places that hypotheses of other sessions are compared with; further ones have no mass."""


NOTHING = Verdict(status="not_found", confidence=0.0, hypotheses=(), places=(), evidence=NO_EVIDENCE)
"""The verdict on a query for which nothing is found."""


class MapIndex:
    """The maps of a database and their places, prepared to be searched again and again.

    Each map is prepared (in tens of milliseconds) when it first matters to a query, and kept.

    prior : what is known of the pose beforehand, see `within`. whole : the index without the prior.
    points_of : the points of the maps, which answers are refined and checked with; None if they have none.
    """

    prior: Prior | None = None
    whole: MapIndex | None = None
    points_of: PointsOf | None = None

    def __init__(
        self,
        grids: Mapping[str, OccupancyGrid],
        table: SignatureTable,
        made_with: Config,
        config: Config,
        labels: Mapping[str, Label] | None = None,
        areas_m2: Mapping[str, float] | None = None,
        stored: Callable[[str], SeenPlaces | None] = lambda session: None,
    ) -> None:
        """grids : map of each session, in the order of `table.session_index`.

        made_with : how the places were cut and described; queries are described in the same way.
        config : its relocalize section says how to search and when to be sure.
        labels : building and floor of sessions, where known.
        areas_m2 : free space of each map, for maps that are not to be read before they are needed.
        stored : what is seen from the places of a session; None: it is computed from the map when it is
            needed.
        """
        self.made_with = made_with
        self.config = config.relocalize
        self.sessions = tuple(grids)
        self.labels = tuple((labels or {}).get(name, Label()) for name in grids)
        count = len(grids)
        areas_m2 = areas_m2 or {name: grid.free_m2 for name, grid in grids.items()}
        self._areas_m2 = tuple(areas_m2[name] for name in self.sessions)
        # Of a large database, about as many grids are kept as are searched at once, and as many prepared
        # maps, which take ten times as much memory, as one look uses.
        area_m2 = sum(self._areas_m2)
        most = most_prepared = None
        if area_m2 > AT_ONCE_M2:
            most = math.ceil(count * AT_ONCE_M2 / area_m2)
            most_prepared = self.config.top_k + self.config.hypotheses
        self.grids: LazySequence[OccupancyGrid] = LazySequence(lambda i: grids[self.sessions[i]], count, most)
        self.maps: LazySequence[SearchMap] = LazySequence(
            lambda i: SearchMap.of(self.grids[i]), count, most_prepared
        )
        self._alike: dict[tuple[int, int], SE2 | None] = {}  # see `_aligned`
        self._free: LazySequence[F64] = LazySequence(lambda i: free_squares(self.grids[i]), count)
        self.places = Places(
            table,
            self.grids,
            made_with.partition.radius_m,
            self._areas_m2,
            stored=lambda i: stored(self.sessions[i]),
        )

    @staticmethod
    def of(database: SubmapDatabase, config: Config, observer: Observer = Observer()) -> MapIndex:
        """Everything that is in a database.

        If that is more than `signature.retrieval.viewpoints.AT_ONCE_M2` of free floor, maps are read when
        they first matter, and points always are, so the database must stay open as long as the index is used.

        observer : gets the progress where places have to be selected, and a warning if what is seen from them
            is damaged and has to be computed.
        """
        infos = {info.name: info for info in database.sessions()}
        areas_m2 = {name: info.area_m2 for name, info in infos.items()}
        grids: Mapping[str, OccupancyGrid] = DatabaseGrids(database, tuple(infos))
        is_large = sum(areas_m2.values()) > AT_ONCE_M2
        if not is_large:
            grids = dict(grids)
        labels = {name: info.provenance.label for name, info in infos.items()}
        lacking: list[str] = []

        def stored(name: str) -> SeenPlaces | None:
            # What is seen from a place follows from the map, so damage to it costs time and no answer.
            with contextlib.suppress(DatabaseCorrupt):
                return database.seen_places(name)
            lacking.append(name)
            return None

        table, by_paper = database.signatures(), config.relocalize.select_by == "paper"
        if is_large and not by_paper:
            table = table.without_histograms()
        made_with = database.config()
        index = MapIndex(grids, table, made_with, config, labels, areas_m2, stored)
        index.points_of = points_reader(database)
        if by_paper:
            return index
        with observer.step("prepare places"):
            index.places.index(observer.on_progress)
        if lacking:
            observer.on_warning(
                f"{database.location}: lacks what is seen from the places of {len(lacking)} of its"
                f" {len(infos)} sessions, so it was computed now; `pc2grid db copy --recover` makes it whole"
            )
        return index

    def within(self, prior: Prior) -> MapIndex:
        """An index of which only places that the prior allows are answers; all that is prepared is shared.

        Raises ConfigError if the prior does not name its session where there are several, or an unknown one.
        """
        self._prior_session(prior)
        restricted = copy.copy(self)
        restricted.prior, restricted.whole = prior, self.whole or self
        return restricted

    def _prior_session(self, prior: Prior) -> int:
        """The session in whose map frame the prior is."""
        names = ", ".join(self.sessions[:12]) + (", ..." if len(self.sessions) > 12 else "")
        if prior.session is None and len(self.sessions) > 1:
            raise ConfigError(
                f"near: the database holds {len(self.sessions)} sessions, each with a map frame of its own",
                hint=f"--session NAME says whose frame is meant: {names}",
            )
        if prior.session is not None and prior.session not in self.sessions:
            raise ConfigError(
                f"near: no session {prior.session!r} where it is looked for", hint=f"there is: {names}"
            )
        return 0 if prior.session is None else self.sessions.index(prior.session)

    def prior_applies(self, query: QueryMap) -> bool:
        """Whether there is a prior, and the motion of the query since its time is known."""
        return self.prior is not None and self._T_odom_prior(query) is not None

    def _T_odom_prior(self, query: QueryMap) -> SE2 | None:
        """The base at the time that the prior is about."""
        assert self.prior is not None
        return query.T_odom_base if self.prior.stamp_ns is None else query.T_odom_prior

    def allowed(self, found: tuple[Hypothesis, ...], query: QueryMap) -> tuple[Hypothesis, ...]:
        """The hypotheses that the prior allows."""
        prior = self.prior
        if prior is None or (T_odom_prior := self._T_odom_prior(query)) is None:
            return found
        session = self._prior_session(prior)
        return tuple(
            h
            for h in found
            if h.session_index == session
            and prior.allows(h.fit.T_map_query @ T_odom_prior, query.since_prior_m)
        )

    def _region(self, query: QueryMap) -> tuple[int, F64] | None:
        """The session of the prior, and the free squares (K, 2) of its map that may hold the base now; None
        without a prior."""
        prior = self.prior
        if prior is None or (T_odom_prior := self._T_odom_prior(query)) is None or not self.sessions:
            return None
        session = self._prior_session(prior)
        step = T_odom_prior.inverse() @ query.T_odom_base
        free = self._free[session]
        moved_m = math.hypot(step.x, step.y)
        return session, free[prior.may_hold(free, HYPOTHESES.square_m, moved_m, query.since_prior_m)]

    def look_up(
        self, query: QueryMap, carried: tuple[Hypothesis, ...] = (), *, rows: I64 | None = None
    ) -> tuple[Hypothesis, ...]:
        """Hypotheses for the query, best first: the carried ones, refined, and what retrieval proposes.

        rows : places that retrieval compares, instead of those it selects.
        """
        old = [
            fitted(query, h.session_index, h.row, self.maps[h.session_index], h.fit.T_map_query)
            for h in carried
        ]
        base_m = (query.T_odom_base.x, query.T_odom_base.y)
        proposals = retrieve(
            query.views,
            base_m,
            self.places,
            signature=self.made_with.signature,
            config=self.config,
            rows=rows,
        )
        found = (*old, *verify(query, proposals, self.places, self.maps, self.config))
        region = self._region(query)
        if region is not None and len(region[1]) * HYPOTHESES.square_m**2 <= PRIOR.searched_m2:
            return self.search_whole_maps(query, found)
        return self._worth_keeping(found, query)

    def search_whole_maps(
        self, query: QueryMap, known: tuple[Hypothesis, ...], least: float = 0.0
    ) -> tuple[Hypothesis, ...]:
        """`known` and whatever fits anywhere on the maps that are small enough to be searched as a whole; in
        a large database, on those that look most like the query. With a prior: anywhere in its region.

        least : what has a lower coarse score is left out, see `hypotheses.search_whole_map`; and so is what
        has less than the share `SEARCHED` of the best.
        """
        found = list(known)
        config = self.config.model_copy(update={"coarse_keep": SEARCHED})
        region = self._region(query)
        if region is not None:
            index, free = region
            if len(free) * HYPOTHESES.square_m**2 <= self.config.exhaustive_m2:
                found.extend(search_whole_map(query, index, self.maps[index], free, config, least))
            return self._worth_keeping(tuple(found), query)
        for index in self.places.sessions(query.views, self.made_with.signature, self.config):
            if self._areas_m2[index] <= self.config.exhaustive_m2:
                found.extend(
                    search_whole_map(query, index, self.maps[index], self._free[index], config, least)
                )
        return self._worth_keeping(tuple(found), query)

    def judge(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...], odds: float = 1.0) -> Verdict:
        """The posterior over the hypotheses, see `signature.localization.posterior`.

        odds : prior of each place, relative to that of "not in this map".

        A place that the prior excludes has no mass. But it shows what wrong places score for this query, so
        it remains a rival, unless it fits as well as the best one that is allowed: between equal places the
        prior decides. Otherwise any place in a small region, which has few rivals, would look certain.
        """
        places, rivals = self._places_by_prior(query, hypotheses)
        if not places:
            return NOTHING
        evidence, places = self._evidence(query, places, rivals)
        # The same place on a floor that looks alike and is not contradicted has the same mass.
        unseen = self._unseen_alike(query, places[0][0]) if evidence[0].log_odds() > 0.0 else []
        mass = masses([evidence[0]] * len(unseen) + evidence, odds)
        named = [h for h in unseen if not any(same_place(query, h, o) for place in places for o in place)]
        return _verdict(
            [*places, *([h] for h in named)], evidence, float(mass[len(unseen)]), self.config.accept
        )

    def _places_by_prior(
        self, query: QueryMap, hypotheses: tuple[Hypothesis, ...]
    ) -> tuple[list[list[Hypothesis]], list[Fit]]:
        """The places that the prior allows, and fits of others that tell what wrong places score."""
        allowed = {id(h) for h in self.allowed(hypotheses, query)}
        groups = self._places(query, hypotheses)
        places = [inside for group in groups if (inside := [h for h in group if id(h) in allowed])]
        highest = max((place[0].fit.score for place in places), default=0.0)
        excluded = [group[0].fit for group in groups if not any(id(h) in allowed for h in group)]
        return places, [fit for fit in excluded if not alike(fit.score, highest)]

    def _evidence(
        self, query: QueryMap, places: list[list[Hypothesis]], rivals: list[Fit]
    ) -> tuple[list[Evidence], list[list[Hypothesis]]]:
        """What tells for each place, and the places, both by mass; what the last scans tell, of the first."""
        told = [
            replace(one, off_map=off_map(query, h.fit, self.maps[h.session_index].field))
            for one, (h, *_) in zip(
                evidence_of([place[0].fit for place in places], query, rivals), places, strict=True
            )
        ]
        by_mass = sorted(zip(told, places, strict=True), key=lambda known: -known[0].log_odds())
        evidence, ordered = [one for one, _ in by_mass], [place for _, place in by_mass]
        best = ordered[0][0]
        tail = tail_of(query, best.fit, self.maps[best.session_index].field)
        return [replace(evidence[0], tail=tail), *evidence[1:]], ordered

    def _unseen_alike(self, query: QueryMap, best: Hypothesis) -> list[Hypothesis]:
        """The same place on other floors of the building that look alike, where what their maps show does not
        contradict the query: they show too little of it, or agree with it as well as the best floor does.
        None with a prior, which names the floor.

        A score tells the two apart by what is unknown there, which says nothing.
        """
        if self.prior is not None:
            return []
        here, base = best.session_index, query.T_odom_base
        least = best.fit.known_agreement_both_ways - POSTERIOR.alike
        found = []
        for there in self.places.sessions(query.views, self.made_with.signature, self.config):
            if not self._other_floor(here, there):
                continue
            T_there_here = self._aligned(here, there)
            if T_there_here is None:
                continue
            target, pose = self.maps[there], T_there_here @ best.fit.T_map_query
            unseen = share_known(self.grids[there], query.grid, pose) < ALIKE_FLOORS.seen_there
            refined, covariance = refine(target.field, query.walls.points_m, pose, (base.x, base.y))
            fit = score_fit(target.walls, query.walls, refined, covariance)
            if unseen or fit.known_agreement_both_ways >= least:
                found.append(Hypothesis(session_index=there, row=-1, fit=fit))
        return found

    def _other_floor(self, here: int, there: int) -> bool:
        """Whether two sessions are of one building, and of different floors of it."""
        label, other = self.labels[here], self.labels[there]
        one_recording = same_recording(self.sessions[here], self.sessions[there])
        one_building = one_recording or (label.building is not None and label.building == other.building)
        return one_building and label.contradicts(other, one_recording=one_recording)

    def _aligned(self, here: int, there: int) -> SE2 | None:
        """T_there_here of two maps that agree where both know something; None if they do not."""
        if (here, there) not in self._alike:
            grid = self.grids[here]
            whole = query_of(grid, np.empty((0, 2)), self.made_with, self.config)
            rows = np.flatnonzero(self.places.table.session_index == there)
            fits = [h.fit for h in self.look_up(whole, rows=rows) if h.session_index == there]
            alike = [
                fit
                for fit in fits
                if fit.known_agreement_both_ways >= ALIKE_FLOORS.agreement
                and fit.overlap >= ALIKE_FLOORS.overlap
            ]
            self._alike[here, there] = alike[0].T_map_query if alike else None
        return self._alike[here, there]

    def decide(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...], odds: float = 1.0) -> Verdict:
        """The final verdict: all maps are searched as a whole, so that neither the right place nor a rival is
        left out.

        Where the proposals settled it, only for what the coarse search scores as high as the best one, which
        is faster: a wrong place among few proposals may lead by far, if the right one was not proposed.
        """
        verdict = self.judge(query, hypotheses, odds)
        least = 0.0
        if verdict.status == "located":
            best = verdict.hypotheses[0]
            least = coarse_score(query, self.maps[best.session_index], best.fit.T_map_query)
        found = self.search_whole_maps(query, hypotheses, least)
        return self.judge(query, found, odds)

    def _worth_keeping(self, found: tuple[Hypothesis, ...], query: QueryMap) -> tuple[Hypothesis, ...]:
        """Best first, what scores enough beside the best one; what a prior excludes is kept beside it."""
        distinct_ones = distinct(found, query.T_odom_base)
        inside = {id(h) for h in self.allowed(distinct_ones, query)}
        groups = (
            [h for h in distinct_ones if id(h) in inside],
            [h for h in distinct_ones if id(h) not in inside],
        )
        kept = []
        for group in groups:
            floor = _KEEP * group[0].fit.score if group else 0.0
            kept += [h for h in group if h.fit.score >= floor][: self.config.hypotheses]
        return tuple(sorted(kept, key=lambda h: -h.fit.score))

    def _places(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...]) -> list[list[Hypothesis]]:
        """The hypotheses by place, best first; a place has one hypothesis a session."""
        groups: list[list[Hypothesis]] = []
        for h in hypotheses:
            same = next((g for g in groups[:_COMPARED] if self._belongs(query, h, g)), None)
            if same is None:
                groups.append([h])
            else:
                same.append(h)
        return groups

    def _belongs(self, query: QueryMap, h: Hypothesis, place: list[Hypothesis]) -> bool:
        in_other_maps = all(h.session_index != other.session_index for other in place)
        return in_other_maps and any(self._one_place(query, h, other) for other in place)

    def _one_place(self, query: QueryMap, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether two hypotheses in two maps are one place, see `signature.localization.same_place`."""
        label, other = self.labels[a.session_index], self.labels[b.session_index]
        one_recording = same_recording(self.sessions[a.session_index], self.sessions[b.session_index])
        if label.contradicts(other, one_recording=one_recording):
            return False
        labelled = label.agrees(other, one_recording=one_recording)
        on, grid = self.maps[a.session_index], self.grids[b.session_index]
        return surroundings_agree(query, a, on, b, grid, labelled=labelled)


def _verdict(
    places: Sequence[Sequence[Hypothesis]], evidence: Sequence[Evidence], confidence: float, accept: float
) -> Verdict:
    """The verdict on places by mass. evidence : of each that is found. confidence : mass of the first."""
    status: Status = "ambiguous" if in_the_map(evidence) >= POSTERIOR.in_the_map else "not_found"
    return Verdict(
        status="located" if confidence >= accept else status,
        confidence=confidence,
        hypotheses=tuple(h for place in places for h in place),
        places=tuple(number for number, place in enumerate(places) for _ in place),
        evidence=evidence[0],
    )


def free_squares(grid: OccupancyGrid, side_m: float = HYPOTHESES.square_m) -> F64:
    """Centres (K, 2) of the squares of `side_m` of a grid that hold any free space, map frame."""
    n = max(1, round(side_m / grid.resolution_m))
    height, width = grid.cells.shape
    if not height or not width:
        return np.empty((0, 2))
    rows, columns = np.arange(0, height, n), np.arange(0, width, n)
    free = np.add.reduceat(np.add.reduceat(grid.free.astype(np.int32), rows, axis=0), columns, axis=1)
    corners = np.argwhere(free > 0)[:, ::-1] * (n * grid.resolution_m)
    return np.asarray(corners + 0.5 * n * grid.resolution_m + np.asarray(grid.origin_m))
