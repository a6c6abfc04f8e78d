"""Which places of the database look like the query's views?

Three steps, cheap first. The three signatures (Eq. 6) make a shortlist; they know no direction and no
order, so one matrix product serves a million places. At the places on it the isovists' ranges are laid
over each other at every rotation, from many standpoints, rays that either side has not observed left out.
The best of these say where the whole query would lie, and there the other views have their say: the
right place is where all of them find what they see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, I64
from pc2grid.visibility import HIDDEN
from signature.config import RelocalizeConfig, SignatureConfig
from signature.places import Places, Standpoints
from signature.query import QueryMap

RANGE_SCALE_M = 0.25
"""Half of the likeness is gone at this difference of two ranges, all of it at twice that: about the offset
between a view and the nearest standpoint."""
PRIOR_SHARE = 0.15
"""Rays' worth of doubt, as a share of the circle: a likeness of few common rays counts for less."""
_SPREAD_FLOOR = 1e-3
_LEADS = 100
"""Placements that each view puts up for the vote."""
_APART_M, _APART_RAD = 0.75, math.radians(15.0)
"""Placements nearer than this are one."""
_UNSEEN = 65535
"""A range that is not known, in units: farther from any that is than two that are alike."""
_BLOCK = 64  # standpoints at a time, so that what is added up stays in the first cache
_AGAINST = -1.0
"""A view can speak against a placement by no more than this many standard deviations: what stood in its
way may be somewhere else today."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """The query may lie so that one of its views is at a place of the database.

    view : index into the query's views. row : row of the table. at_m : (x, y) where the view would be.
    yaw_rad : rotation from the query's frame into the map's.
    likeness : what all views have to say to it, in standard deviations above what they find anywhere.
    """

    view: int
    row: int
    at_m: tuple[float, float]
    yaw_rad: float
    likeness: float


def retrieve(
    query: QueryMap,
    places: Places,
    *,
    signature: SignatureConfig,
    config: RelocalizeConfig,
    top_k: int | None = None,
) -> tuple[Proposal, ...]:
    """The `top_k` (default `config.top_k`) most promising placements of the query, no two alike.

    Ties are broken by order, so equal inputs give equal answers.
    """
    if not query.views or not len(places.table):
        return ()
    shortlists = places.shortlists(query, config.shortlist, signature)
    rows = np.unique(np.concatenate([s.rows for s in shortlists]))
    stand = places.around(rows)
    weight = np.empty((len(query.views), len(rows)), np.float32)
    for view, shortlist in enumerate(shortlists):
        apart = np.exp(
            -config.signature_weight * (shortlist.scores - shortlist.mean) / max(shortlist.spread, 1e-12)
        )
        # What is not on its shortlist is no better than the last of it, or than the average.
        weight[view] = apart.min() if len(apart) else 1.0
        weight[view, np.searchsorted(rows, shortlist.rows)] = apart
    weight = weight[:, stand.place]
    ranges = np.stack([v.profile.ranges_m for v in query.views])
    seen = np.stack([v.profile.ends != HIDDEN for v in query.views])
    likeness = rotate_and_compare(ranges, seen, stand.ranges_m, stand.seen)
    leads, level, spread = [], [], []
    for view, found in enumerate(likeness):
        found *= weight[view]
        best = found.max(axis=0)
        level.append(float(best.mean()))
        spread.append(float(best.std()) + _SPREAD_FLOOR)
        leads.append(_leads(found, best))
    placed = _Placements.of(query, stand, leads, ranges.shape[1])
    voices = _voices(likeness, placed.shift, placed.beside)
    # A view that looks like everywhere says little, so each speaks by how far a place stands out to it.
    heard = np.where(voices >= 0.0, (voices - np.array(level)) / np.array(spread), 0.0)
    votes = np.maximum(heard, _AGAINST).sum(axis=1)
    order = np.argsort(-votes, kind="stable")
    chosen = _distinct(order, placed.base_m, placed.yaw_rad, stand.session[placed.at], top_k or config.top_k)
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


def _leads(likeness: F32, best: F32) -> tuple[I64, I64]:
    """The standpoints and rotations of the highest local maxima over the rotations of `likeness` (B, K)."""
    at, shift = _peaks(likeness, np.argsort(-best, kind="stable")[:_LEADS])
    order = np.argsort(-likeness[shift, at], kind="stable")[:_LEADS]
    return at[order], shift[order]


@numba.njit(cache=True, nogil=True)
def _peaks(likeness: F32, columns: I64) -> tuple[I64, I64]:
    """Where in each of the `columns` of `likeness` (B, K) it is higher than at the next rotation and no lower
    than at the one before."""
    bearings = len(likeness)
    at, shift = np.empty((2, len(columns) * bearings), np.int64)
    count = 0
    for column in columns:
        before, here = likeness[bearings - 1, column], likeness[0, column]
        for k in range(bearings):
            after = likeness[(k + 1) % bearings, column]
            if here >= before and here > after:
                at[count], shift[count] = column, k
                count += 1
            before, here = here, after
    return at[:count], shift[:count]


@dataclass(frozen=True, slots=True)
class _Placements:
    """Ways to lay the query on a map, C of them, each by one of its views.

    view, at, shift, yaw_rad (C,) : which view is put on which standpoint, turned by how many rays.
    base_m : (C, 2) where that puts the base. beside : (C, V) the standpoint next to each view, K: none.
    """

    view: I64
    at: I64
    shift: I64
    yaw_rad: F64
    base_m: F64
    beside: I64

    @staticmethod
    def of(query: QueryMap, stand: Standpoints, leads: list[tuple[I64, I64]], bearings: int) -> _Placements:
        view = np.repeat(np.arange(len(leads)), [len(at) for at, _ in leads])
        at = np.concatenate([at for at, _ in leads])
        shift = np.concatenate([shift for _, shift in leads])
        yaw = shift * (2.0 * math.pi / bearings)
        base = (query.T_odom_base.x, query.T_odom_base.y)
        points = np.array([*(v.center_m for v in query.views), base])
        steps = points[None] - points[view][:, None]
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        turned = np.stack((c * steps[..., 0] - s * steps[..., 1], s * steps[..., 0] + c * steps[..., 1]), -1)
        there = stand.at_m[at][:, None] + turned
        views = there[:, :-1]
        beside = stand.beside(views, np.broadcast_to(stand.session[at][:, None], views.shape[:2]))
        beside[np.arange(len(at)), view] = at
        return _Placements(view, at, shift, yaw, there[:, -1], beside)


@numba.njit(cache=True, nogil=True)
def _voices(likeness: F32, shift: I64, beside: I64) -> F64:
    """How well each view likes what it would see in each placement (C, V); -1 where nobody knows.

    likeness : (V, B, K) of each view with each standpoint at each rotation. A ray more or less of rotation is
    allowed, for the rotation is known to a ray only.
    """
    views, bearings, standpoints = likeness.shape
    out = np.full((len(shift), views), -1.0)
    for c in range(len(shift)):
        for u in range(views):
            if beside[c, u] < standpoints:
                for turn in range(-1, 2):
                    found = likeness[u, (shift[c] + turn) % bearings, beside[c, u]]
                    out[c, u] = max(out[c, u], found)
    return out


@numba.njit(cache=True, nogil=True)
def _distinct(order: I64, base_m: F64, yaw_rad: F64, session: I64, most: int) -> I64:
    """The first `most` of placements in `order`, leaving out what lies beside one before it."""
    chosen = np.empty(most, np.int64)
    count = 0
    for i in order:
        alone = True
        for k in chosen[:count]:
            turn = abs((yaw_rad[i] - yaw_rad[k] + math.pi) % (2 * math.pi) - math.pi)
            apart = max(abs(base_m[i, 0] - base_m[k, 0]), abs(base_m[i, 1] - base_m[k, 1]))
            if session[i] == session[k] and apart < _APART_M and turn < _APART_RAD:
                alone = False
                break
        if alone:
            chosen[count] = i
            count += 1
            if count == most:
                break
    return chosen[:count]


def rotate_and_compare(
    ranges_m: F32, seen: NDArray[np.bool_], others_m: F32, others_seen: NDArray[np.bool_]
) -> F32:
    """Likeness (V, B, N), 0..1, of isovists (V, B) with others (N, B), for each rotation by 2 pi s / B.

    Only rays whose ends both sides know are compared, by a triangular kernel of their difference.
    """
    views, bearings = ranges_m.shape
    # In whole units of 16 bits: the most that all rays come to must fit in, and the longest range too.
    longest_m = max(float(ranges_m.max(initial=0.0)), float(others_m.max(initial=0.0)))
    width_m = 2 * RANGE_SCALE_M
    per_m = np.float32(min(65535 // bearings / width_m, (_UNSEEN - 1) / (longest_m + width_m)))
    own, others = ((m * per_m + np.float32(0.5)).astype(np.uint16) for m in (ranges_m, others_m))
    others[~others_seen] = _UNSEEN
    likeness = np.empty((views, bearings, len(others)), np.float32)
    for view in range(views):
        rays = np.flatnonzero(seen[view])
        _overlap(
            rays,
            own[view, rays],
            others,
            np.ascontiguousarray(others_seen),
            int(width_m * per_m),
            PRIOR_SHARE * bearings,
            likeness[view],
        )
    return likeness


@numba.njit(cache=True, nogil=True)
def _overlap(
    rays: I64,
    own: NDArray[np.uint16],
    others: NDArray[np.uint16],
    known: NDArray[np.bool_],
    width: int,
    doubt: float,
    out: F32,
) -> None:
    """Compare the ranges `own` of some `rays` with all others', (N, B); those `width` apart are not alike."""
    n, bearings = others.shape
    full, scale, more = np.uint16(width), np.float32(1.0 / width), np.float32(doubt)
    most = bearings * min(n, _BLOCK)
    # Ray by ray, and the circle twice over, so that what a ray meets at all rotations is one straight run.
    there, there_known = np.empty(2 * most, np.uint16), np.empty(2 * most, np.uint16)
    total, count = np.empty(most, np.uint16), np.empty(most, np.uint16)
    for first in range(0, n, _BLOCK):
        size = min(_BLOCK, n - first)
        around = bearings * size
        for i in range(size):
            for k in range(bearings):
                at = k * size + i
                there[at] = there[at + around] = others[first + i, k]
                there_known[at] = there_known[at + around] = known[first + i, k]
        total[:], count[:] = 0, 0
        for ray in range(len(rays)):
            here, at = own[ray], rays[ray] * size
            run, run_known = there[at : at + around], there_known[at : at + around]
            for j in range(around):
                apart = np.uint16(max(here, run[j]) - min(here, run[j]))
                total[j] += np.uint16(full - min(apart, full))
                count[j] += run_known[j]
        for shift in range(bearings):
            for i in range(size):
                j = shift * size + i
                out[shift, first + i] = np.float32(total[j]) * scale / (np.float32(count[j]) + more)
