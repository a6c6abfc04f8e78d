"""A building ready to be asked: its maps, its places, and what they have to say to a query."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.alignment import NEUTRAL, Fit, LikelihoodField, assess, prepare, prepare_query, refine
from pc2grid.geometry import F64, wrap_angle
from pc2grid.model import UNKNOWN, BoolGrid, OccupancyGrid
from signature.answer import Status, Verdict
from signature.confidence import CALIBRATION, RIVALS, Evidence
from signature.config import Config
from signature.database.protocol import Label
from signature.maps import Lazily, Stored, free_m2
from signature.places import AT_ONCE_M2, Places
from signature.query import QueryMap
from signature.retrieve import retrieve
from signature.verify import SAME_M, SAME_RAD, Hypothesis, carry_on, distinct, search_everywhere, verify

if TYPE_CHECKING:
    from signature.database import SubmapDatabase
    from signature.similarity import SignatureTable

_AROUND_M = 10.0
"""Two maps show the same place if they agree this far around it: farther than the query needs to have
seen, so that two rooms alike are told apart by what lies around them."""
_WALL_M = 0.4
_SAME, _SAME_TOLD = 0.5, 0.1
"""Least probability, by what surrounds it, that two places that fit the query alike are one: likelier than
not; and if their labels say so, not clearly otherwise."""
_RIVAL_SCORE = 0.2
"""A hypothesis that much worse than the best is no rival to it, wherever it is."""


class Building:
    """Maps and their places made ready to be asked again and again: isovists and likelihood fields.

    Each map is made ready (in tens of milliseconds) when it first matters to a query, and kept.
    """

    def __init__(
        self,
        grids: Mapping[str, OccupancyGrid],
        table: SignatureTable,
        made_with: Config,
        config: Config,
        labels: Mapping[str, Label] | None = None,
        areas_m2: Mapping[str, float] | None = None,
    ) -> None:
        """grids : map of each session, in the order that `table.session_index` counts.

        made_with : how the places were cut and described; queries are treated alike.
        config : its relocalize section says how to search and when to be sure.
        labels : building and floor of sessions, where known.
        areas_m2 : free space of each map, for maps that are not to be read before they are needed.
        """
        self.made_with = made_with
        self.config = config.relocalize
        self.sessions = tuple(grids)
        self.labels = tuple((labels or {}).get(name, Label()) for name in grids)
        self.grids: Sequence[OccupancyGrid] = Lazily(lambda i: grids[self.sessions[i]], len(grids))
        self.fields: Sequence[LikelihoodField] = Lazily(lambda i: prepare(self.grids[i]), len(grids))
        self._free: Sequence[F64] = Lazily(lambda i: free_squares(self.grids[i]), len(grids))
        areas_m2 = areas_m2 or {name: free_m2(grid) for name, grid in grids.items()}
        self._areas_m2 = tuple(areas_m2[name] for name in self.sessions)
        self.places = Places(table, self.grids, made_with.partition.radius_m, self._areas_m2)

    @staticmethod
    def of(database: SubmapDatabase, config: Config) -> Building:
        """Everything that is in a database.

        If that is more than `signature.places.AT_ONCE_M2` of free floor, maps are read when they first
        matter, so the database must stay open as long as the building is asked.
        """
        infos = {info.name: info for info in database.sessions()}
        areas_m2 = {name: info.area_m2 for name, info in infos.items()}
        grids: Mapping[str, OccupancyGrid] = Stored(database, tuple(infos))
        if sum(areas_m2.values()) <= AT_ONCE_M2:
            grids = dict(grids)
        labels = {name: info.provenance.label for name, info in infos.items()}
        return Building(grids, database.signatures(), database.config(), config, labels, areas_m2)

    def look_up(
        self, query: QueryMap, carried: tuple[Hypothesis, ...] = (), *, driven_m: float = 0.0
    ) -> tuple[Hypothesis, ...]:
        """Hypotheses for the query, best first: the carried ones, refined, and what retrieval proposes."""
        old = [carry_on(query, h, self.fields[h.session_index], driven_m) for h in carried]
        proposals = retrieve(query, self.places, signature=self.made_with.signature, config=self.config)
        new = verify(query, proposals, self.places, self.fields, self.config)
        return self._worth_keeping((*old, *new), query)

    def look_everywhere(self, query: QueryMap, known: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
        """`known` and whatever fits anywhere on the maps that are small enough to be searched as a whole; in
        a large database, on those that look most like what the query sees."""
        found = list(known)
        for index in self.places.sessions(query, self.config.shortlist, self.made_with.signature):
            if self._areas_m2[index] <= self.config.exhaustive_m2:
                found.extend(
                    search_everywhere(query, index, self.fields[index], self._free[index], self.config)
                )
        return self._worth_keeping(tuple(found), query)

    def judge(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...]) -> Verdict:
        """What the hypotheses, best first, amount to."""
        places = self._places(query, hypotheses)
        rivals = [hypotheses[places.index(k)] for k in range(max(places, default=-1) + 1)]
        evidence = Evidence.of(rivals, query.aligned.walls)
        *probabilities, none = (float(p) for p in CALIBRATION.probabilities(evidence))
        best = probabilities[0] if probabilities else 0.0
        status: Status = "located" if best >= self.config.accept else "ambiguous"
        return Verdict(
            status=status if best > none else "not_found",
            confidence=best,
            hypotheses=hypotheses,
            places=places,
            evidence=evidence,
        )

    def decide(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...]) -> Verdict:
        """The last word: where the signatures did not settle it, no place is left out, neither the right
        one nor a rival."""
        verdict = self.judge(query, hypotheses)
        if verdict.status == "located":
            return verdict
        return self.judge(query, self.look_everywhere(query, hypotheses))

    def _worth_keeping(self, found: tuple[Hypothesis, ...], query: QueryMap) -> tuple[Hypothesis, ...]:
        kept = distinct(found, query.T_odom_base)
        floor = 0.6 * kept[0].fit.score if kept else 0.0
        return tuple(h for h in kept if h.fit.score >= floor)[: self.config.hypotheses]

    def _places(self, query: QueryMap, hypotheses: tuple[Hypothesis, ...]) -> tuple[int, ...]:
        """Which place each hypothesis is at, numbered from 0 as they come; a place lies in a session once.

        Sessions of one floor all show the right place: they must not make each other ambiguous. What is far
        behind the best, or behind the first few places, is not compared and counts as its own: it does not
        take part in the decision.
        """
        least = hypotheses[0].fit.score - _RIVAL_SCORE if hypotheses else 0.0
        members: list[list[Hypothesis]] = []
        numbers = []
        for h in hypotheses:
            number = next(
                (
                    k
                    for k, place in enumerate(members[:RIVALS])
                    if h.fit.score >= least
                    and all(h.session_index != other.session_index for other in place)
                    and any(self._one_place(query, h, other) for other in place)
                ),
                len(members),
            )
            if number == len(members):
                members.append([])
            members[number].append(h)
            numbers.append(number)
        return tuple(numbers)

    def _one_place(self, query: QueryMap, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether two hypotheses in two maps are one place: what surrounds it in the one map, laid on the
        other as the hypotheses say, fits there too. What the query has seen itself fits both, or there were
        no two hypotheses, so only what lies beyond counts. Labels that contradict each other rule it out;
        labels that agree leave less to prove."""
        label, other = self.labels[a.session_index], self.labels[b.session_index]
        if label.contradicts(other):
            return False
        at = query.T_odom_base
        there = b.fit.T_map_query @ at
        beyond = unseen_by(query, self.grids[b.session_index].crop((there.x, there.y), _AROUND_M), b.fit)
        around = prepare_query(beyond, center_m=(there.x, there.y))
        field = self.fields[a.session_index]
        T_a_b = a.fit.T_map_query @ b.fit.T_map_query.inverse()
        refined, covariance = refine(field, around, T_a_b)
        moved = (T_a_b @ there).inverse() @ (refined @ there)
        if math.hypot(moved.x, moved.y) > SAME_M or abs(wrap_angle(moved.yaw)) > SAME_RAD:
            return False
        fit = assess(field, around, refined, covariance)
        told = label.building is not None and label == other
        if not fit.overlap:  # nothing beyond is in both maps
            return told
        # Ground that only one of the maps knows says nothing here, and neither may contradict the other.
        agreement = min((fit.forward - NEUTRAL * (1.0 - fit.overlap)) / fit.overlap, fit.backward)
        evidence = Evidence(scores=(agreement,), walls=fit.overlap * around.walls)
        return bool(CALIBRATION.probabilities(evidence)[0] >= (_SAME_TOLD if told else _SAME))


def unseen_by(query: QueryMap, grid: OccupancyGrid, fit: Fit) -> OccupancyGrid:
    """A part of a map with all that the query has seen, lying there as `fit` says, made unknown.

    With `_WALL_M` around it: a wall has a far side that the query did not see, and it is the same wall.
    """
    import cv2

    known = query.grid.cells != UNKNOWN
    n = math.ceil(_WALL_M / grid.resolution_m)
    known = cv2.dilate(known.astype(np.uint8), np.ones((2 * n + 1, 2 * n + 1), np.uint8)).astype(bool)
    cells = np.argwhere(grid.cells != UNKNOWN)
    at = query.grid.to_cell(fit.T_map_query.inverse().apply(grid.to_point(cells)))
    inside: BoolGrid = np.all((at >= 0) & (at < query.grid.cells.shape), axis=1)
    inside[inside] = known[at[inside, 0], at[inside, 1]]
    left = grid.cells.copy()
    left[cells[inside, 0], cells[inside, 1]] = UNKNOWN
    return replace(grid, cells=left)


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
