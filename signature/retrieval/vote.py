"""How may the query lie at the places that its signatures selected?

Signatures say where, and little about the heading. So at the selected places the ranges of the isovists are
compared at every rotation; rays that either side has not observed are left out. The best matches of each view
are placements of the whole query. Each placement predicts where the other views lie, and all views vote.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, I64
from pc2grid.submaps.isovist import HIDDEN
from signature.config import RelocalizeConfig
from signature.retrieval.likeness import peaks, rotate_and_compare
from signature.retrieval.view import View
from signature.retrieval.viewpoints import Places, Viewpoints


@dataclass(frozen=True, slots=True, kw_only=True)
class VoteParameters:
    """How votes are counted. All chosen on fr079 and intel unless said otherwise.

    spread_floor : lower bound of the standard deviation of a view's likeness.
    candidates : placements that each view proposes.
    apart_m, apart_rad : placements nearer than this are one: the lattice of viewpoints, twice, and two rays.
    least_vote : lower bound of a view's vote (standard deviations), so that moved furniture in front of one
        view cannot veto a placement.
    """

    spread_floor: float = 1e-3
    candidates: int = 100
    apart_m: float = 0.75
    apart_rad: float = math.radians(15.0)
    least_vote: float = -1.0


VOTE = VoteParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """The query may lie so that one of its views is at a place of the database.

    view : index into the query's views. row : row of the table. at_m : (x, y) where the view would be.
    yaw_rad : rotation from the query's frame into the map's.
    likeness : sum of the votes of all views, in standard deviations above their mean over all viewpoints.
    """

    view: int
    row: int
    at_m: tuple[float, float]
    yaw_rad: float
    likeness: float


def retrieve(
    views: Sequence[View],
    base_m: tuple[float, float],
    places: Places,
    *,
    config: RelocalizeConfig,
    top_k: int | None = None,
    rows: I64 | None = None,
) -> tuple[Proposal, ...]:
    """The `top_k` (default `config.top_k`) most promising placements of the query, no two alike.

    views : of the query. base_m : (x, y) in the query's frame; placements are alike if they put this point
    and the heading at the same place. rows : places to compare, instead of those that the signatures
    select.

    Ties are broken by order, so equal inputs give equal answers.
    """
    if not views or not len(places.table) or (rows is not None and not len(rows)):
        return ()
    if rows is None:
        rows = places.select(views, config).rows
    stand = places.around(rows)
    ranges = np.stack([v.profile.ranges_m for v in views])
    seen = np.stack([v.profile.ends != HIDDEN for v in views])
    likeness = rotate_and_compare(ranges, seen, stand.ranges_m, stand.seen)
    best = likeness.max(axis=1)
    mean = best.mean(axis=1, dtype=np.float64)
    spread = best.std(axis=1, dtype=np.float64) + VOTE.spread_floor
    placed = _Placements.of(views, base_m, stand, [_candidates(*m) for m in zip(likeness, best, strict=True)])
    scores = view_scores(likeness, placed.shift, placed.beside)
    # Standard deviations: a view that looks the same everywhere distinguishes nothing.
    evidence = np.where(scores >= 0.0, (scores - mean) / spread, 0.0)
    votes = np.maximum(evidence, VOTE.least_vote).sum(axis=1)
    order = np.argsort(-votes, kind="stable")
    session = stand.session[placed.at]
    chosen = distinct_placements(order, placed.base_m, placed.yaw_rad, session, top_k or config.top_k)
    return tuple(
        Proposal(
            view=int(placed.view[i]),
            row=int(rows[stand.place[placed.at[i]]]),
            at_m=(float(stand.at_m[placed.at[i], 0]), float(stand.at_m[placed.at[i], 1])),
            yaw_rad=float(placed.yaw_rad[i]),
            likeness=float(votes[i]),
        )
        for i in chosen
    )


def _candidates(likeness: F32, best: F32) -> tuple[I64, I64]:
    """Viewpoints (C,) and rotations (C,) of the highest local maxima over the rotations of `likeness` (B,
    K)."""
    at, shift = peaks(likeness, np.argsort(-best, kind="stable")[: VOTE.candidates])
    order = np.argsort(-likeness[shift, at], kind="stable")[: VOTE.candidates]
    return at[order], shift[order]


@dataclass(frozen=True, slots=True)
class _Placements:
    """Ways to lay the query on a map, C of them, each by one of its views.

    view, at, shift, yaw_rad (C,) : which view is put on which viewpoint, turned by how many rays.
    base_m : (C, 2) where that puts the base. beside : (C, V) the viewpoint next to each view, K: none.
    """

    view: I64
    at: I64
    shift: I64
    yaw_rad: F64
    base_m: F64
    beside: I64

    @staticmethod
    def of(
        views: Sequence[View],
        base_m: tuple[float, float],
        stand: Viewpoints,
        candidates: list[tuple[I64, I64]],
    ) -> _Placements:
        view = np.repeat(np.arange(len(candidates)), [len(at) for at, _ in candidates])
        at = np.concatenate([at for at, _ in candidates])
        shift = np.concatenate([shift for _, shift in candidates])
        yaw = shift * (2.0 * math.pi / len(views[0].profile.ranges_m))
        points = np.array([*(v.center_m for v in views), base_m])
        steps = points[None] - points[view][:, None]
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        turned = np.stack((c * steps[..., 0] - s * steps[..., 1], s * steps[..., 0] + c * steps[..., 1]), -1)
        there = stand.at_m[at][:, None] + turned
        predicted = there[:, :-1]
        beside = stand.beside(predicted, np.broadcast_to(stand.session[at][:, None], predicted.shape[:2]))
        beside[np.arange(len(at)), view] = at
        return _Placements(view, at, shift, yaw, there[:, -1], beside)


def view_scores(likeness: F32, shift: I64, beside: I64) -> F64:
    """(C, V) likeness of each view with what it would see in each placement; -1 without a viewpoint there.

    likeness : (V, B, K) of each view with each viewpoint at each rotation. The best of three rotations
    counts, because the rotation of a placement is only known to one ray.
    """
    views, bearings, viewpoints = likeness.shape
    known = beside < viewpoints
    turns = (shift[:, None] + np.arange(-1, 2)) % bearings
    found = likeness[np.arange(views)[:, None], turns[:, None], np.where(known, beside, 0)[..., None]]
    return np.where(known, found.max(axis=2), -1.0)


def distinct_placements(order: I64, base_m: F64, yaw_rad: F64, session: I64, most: int) -> I64:
    """The first `most` of the placements in `order` that are not near one before them."""
    left = order
    chosen: list[int] = []
    while len(left) and len(chosen) < most:
        first = left[0]
        chosen.append(first)
        turn = np.abs((yaw_rad[left] - yaw_rad[first] + math.pi) % (2.0 * math.pi) - math.pi)
        apart = np.abs(base_m[left] - base_m[first]).max(axis=1)
        near = (session[left] == session[first]) & (apart < VOTE.apart_m) & (turn < VOTE.apart_rad)
        left = left[~near]
    return np.array(chosen, np.int64)
