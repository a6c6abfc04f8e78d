"""Do two sessions show one building, and how does one lie in the map of the other? (`join_maps`)

1. The map of the source is cut into square pieces. Each piece is a query that is looked up in the target like
   any other (`signature.places.map_index`); a place of one piece is a transform of the whole source
   (`proposals`).
2. Under each transform the pieces are aligned with the walls of the target, one after the other, from the one
   that proposed it outwards. Each begins where its nearest neighbour came to lie, because a bent map fits
   another one in pieces, and nowhere as a whole (`align_pieces`, `rigid`).
3. What is judged is the part of the source that lies on known ground of the target, by the posterior of every
   other answer. The other transforms are its rivals, with the same part. So are decoys: the pieces of the
   mirror image of the source, which lies nowhere for certain. They score what wrong transforms of these two
   maps score, and where a building is symmetric, or another one has its plan turned over, as much as any.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations, islice
from typing import Literal, TypeVar

import cv2
import numpy as np

from pc2grid.geometry import F32, F64, SE2, frozen_arrays, lever_arm, wrap_angle
from pc2grid.matching.evidence import EVIDENCE, Evidence, evidence_of, masses, with_leads
from pc2grid.matching.score import Fit, refine, score_fit, self_similarity
from pc2grid.matching.search import SearchMap
from pc2grid.matching.walls import LIKELIHOOD, Walls
from pc2grid.model import UNKNOWN, OccupancyGrid
from pc2grid.observer import Observer
from signature.database import SubmapDatabase
from signature.database.protocol import SessionInfo
from signature.places.hypotheses import MAP_COVARIANCE, moved_to_origin, one_place
from signature.places.map_index import MapIndex
from signature.places.query import QueryMap, map_as_query


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinParameters:
    """How a map is cut into pieces, and how a transform of the whole map is judged. By hand.

    side_m : of a square piece: about what a robot sees from a place.
    least_walls : wall points of a piece, by weight.
    least_agreement : a piece that agrees less than this does not show where its neighbours begin, and a whole
        map that does is not joined; wrong places agree by 0.6, see `pc2grid.matching.evidence`.
    proposed : transforms that are compared at most: a building of equal rooms has as many.
    least_m2 : free ground that both sessions know at least. Smaller rooms are alike in many buildings: 3.4 m2
        of fr079 fit a kitchen by .992.
    accept : least probability. A wrong answer is one, a wrong join makes all later answers wrong.
    wall_m : the ground that a session knows is widened by this, so that the walls at its edge count.
    """

    side_m: float = 12.0
    least_walls: float = 20.0
    least_agreement: float = 0.6
    proposed: int = 20
    least_m2: float = 20.0
    accept: float = 0.99
    wall_m: float = 0.4


JOIN = JoinParameters()


Names = tuple[str, str]
"""Of two sessions."""


JoinStatus = Literal["joined", "ambiguous", "different"]
"""different: nothing says that the two show one building."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPair:
    """Two sessions that were compared. accepted : whether their join counts: the pair is joined, and neither
    labels contradict it nor other pairs, unless it alone ties the two together."""

    target: str
    source: str
    join: Join
    accepted: bool = False

    @property
    def names(self) -> Names:
        """Return the names of the two sessions."""
        return self.target, self.source


def compare_pairs(
    database: SubmapDatabase, infos: Mapping[str, SessionInfo], only: Collection[str], observer: Observer
) -> Iterator[SessionPair]:
    """Join every two sessions that labels do not tell apart, as far as they can be.

    only : one of each pair, at least, is of these.
    """
    labels = {name: info.provenance.label for name, info in infos.items()}
    pairs = [
        (a, b) for a, b in combinations(infos, 2) if {a, b} & {*only} and not labels[a].contradicts(labels[b])
    ]

    @cache
    def prepared(name: str) -> JoinableMap:
        return JoinableMap(MapIndex.of_session(database, name))

    with observer.step(f"compare {len(pairs)} pairs of sessions"):
        for done, (a, b) in enumerate(pairs, start=1):
            join = join_maps(prepared(a), prepared(b))
            yield SessionPair(target=a, source=b, join=join)
            observer.on_progress(done / len(pairs))


@dataclass(frozen=True)  # no slots, for what is computed once
class JoinableMap:
    """The map of a session, prepared to be joined when it first matters.

    index : of this session alone.
    """

    index: MapIndex

    @cached_property
    def walls(self) -> Walls:
        """Return its walls."""
        return Walls.of(self.index.grid_of(0))

    @cached_property
    def likeness(self) -> float:
        """Return the `self_similarity` of its walls."""
        return self_similarity(self.walls)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Return the pieces of the map."""
        return pieces_of(self.index)

    @cached_property
    def mirrored_pieces(self) -> tuple[Piece, ...]:
        """Return the same pieces of the mirror image, with x turned into -x."""
        return tuple(mirrored(piece, self.index) for piece in self.pieces)


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(covariance=(np.float64, 3, 3))
class Join:
    """How a source session lies in the map of a target session, as far as that is known.

    status : whether they are joined. T_target_source : the best transform; of no meaning if "different".
    covariance : (3, 3) of its x, y, yaw. probability : 0..1, of the transform being right.
    agreement : 0..1, of the walls where both know the ground, the lower one of both directions.
    common_m2 : free ground that both know.
    links : where the pieces of the source lie that agree with the target.
    """

    status: JoinStatus
    T_target_source: SE2
    covariance: F64
    probability: float
    agreement: float
    common_m2: float
    links: tuple[Link, ...] = ()


UNJOINED = Join(
    status="different",
    T_target_source=SE2(),
    covariance=np.zeros((3, 3)),
    probability=0.0,
    agreement=0.0,
    common_m2=0.0,
)
"""Two sessions of which no piece proposes a transform."""


def join_maps(target: JoinableMap, source: JoinableMap) -> Join:
    """Decide whether two sessions show one building, and how the source lies in the target."""
    points_m = source.walls.facing(target.walls).points_m
    candidates = _candidates(target, points_m, source.pieces)
    join = _best(target, source, candidates, ())
    if join.status == "different":
        return join  # decoys are further rivals, which tell against it at most
    decoys = _candidates(target, points_m * _MIRROR, source.mirrored_pieces)
    return _best(target, source, candidates, decoys)


def _candidates(target: JoinableMap, points_m: F32, pieces: Sequence[Piece]) -> list[_ExactTransform]:
    """Return the transforms of a source that its pieces propose, no two alike."""
    refined = (_refined(target, points_m, pieces, one) for one in proposals(target.index, pieces))
    return list(_distinct(refined))


@dataclass(frozen=True, slots=True, kw_only=True)
class _ExactTransform:
    """A transform that was made exact by walls. at_m : the piece of the source that proposed it. fits : of
    each piece of the source. links : of those that agree. covariance : (3, 3) of the transform at `at_m`."""

    T_target_source: SE2
    at_m: tuple[float, float]
    fits: tuple[Fit, ...]
    links: tuple[Link, ...]
    covariance: F64


def _refined(
    target: JoinableMap, points_m: F32, pieces: Sequence[Piece], proposal: Proposal
) -> _ExactTransform:
    """Make the transform that one piece proposes exact by the walls of all."""
    prepared = target.index.map_of(0)
    fits = align_pieces(prepared, pieces, proposal.T_target_source, proposal.at_m)
    links = links_of(pieces, fits)
    T_target_source, bend_m = rigid(links)
    whole, covariance = refine(prepared.field, points_m, T_target_source, proposal.at_m)
    if bend_m < LIKELIHOOD.sigma_m:  # all walls are within reach of theirs at once, which is more exact
        T_target_source = whole
    covariance = covariance + MAP_COVARIANCE + np.diag([bend_m**2, bend_m**2, 0.0])
    return _ExactTransform(
        T_target_source=T_target_source,
        at_m=proposal.at_m,
        fits=fits,
        links=links,
        covariance=covariance,
    )


def _best(
    target: JoinableMap,
    source: JoinableMap,
    candidates: Sequence[_ExactTransform],
    decoys: Sequence[_ExactTransform],
) -> Join:
    """Return the most probable of some transforms, all others being its rivals.

    By branch and bound: what is not judged is neither joined nor more probable than the best.
    """
    fits = PieceFits.of([candidate.fits for candidate in (*candidates, *decoys)])
    found = [_evidence(source, k, fits) for k in range(len(candidates))]
    bounds = [_bound(evidence) for evidence in found]
    best = UNJOINED
    for k in sorted(range(len(candidates)), key=lambda k: -bounds[k]):
        if bounds[k] < min(best.probability, JOIN.accept):
            break
        join = _judged(target, source, candidates[k], k, fits, found[k])
        best = max(best, join, key=lambda join: (join.status == "joined", join.probability))
    return best


def _evidence(source: JoinableMap, number: int, fits: PieceFits) -> Evidence:
    """Return the evidence for a transform: the walls of the source that lie on known ground of the target.

    number : its row in `fits`; the other rows are of its rivals.
    """
    forward, backward, scores = fits.of_part(number)
    part = Evidence(
        known_agreement=forward,
        compared=float(fits.seen[number].sum()),
        backward=backward,
        looked_at=float(fits.looked_at[number].sum()),
        lead=0.0,
        likeness=source.likeness,
    )
    return with_leads([part] * len(scores), scores.tolist())[number]


def _bound(evidence: Evidence) -> float:
    """Return the probability of a transform if its part of the source is unlike itself, and is all of it.

    It is never lower than the true one.
    """
    highest = replace(evidence, lead=max(evidence.lead, 0.0), likeness=0.0)
    return float(masses([highest])[0])


def _judged(
    target: JoinableMap,
    source: JoinableMap,
    candidate: _ExactTransform,
    number: int,
    fits: PieceFits,
    evidence: Evidence,
) -> Join:
    """Judge a transform by the part of the source that lies in the target.

    number : its row in `fits`; the other rows are of its rivals. evidence : see `_evidence`.
    """
    whole, other = source.index.grid_of(0), target.index.grid_of(0)
    part = known_part(whole, other, candidate.T_target_source)
    free_m = candidate.T_target_source.apply(part.to_point(np.argwhere(part.free)))
    common_m2 = float(other.look_up(other.free, free_m, outside=False).sum()) * part.resolution_m**2
    forward, backward, scores = fits.of_part(number)
    evidence = replace(evidence, likeness=self_similarity(Walls.of(part)))
    # The part was chosen: of so many parts of the smaller session, this one fits best.
    share = min(common_m2 / max(min(whole.free_m2, other.free_m2), 1e-9), 1.0)
    odds = max(share, 1e-9)
    # Transforms that fit equally well share the mass.
    equal = int(np.count_nonzero(np.abs(scores - scores[number]) <= EVIDENCE.alike))
    probability = float(masses([evidence] * equal, odds)[0])
    # Of thousands of wall points a small lead is much, even where walls fit as wrong places do.
    enough = common_m2 >= JOIN.least_m2 and min(forward, backward) >= JOIN.least_agreement
    # That the source lies here, or at a place that fits equally well, is more probable than not.
    doubt: JoinStatus = "ambiguous" if evidence.log_odds() + math.log(odds) > 0.0 else "different"
    return Join(
        status="joined" if enough and probability >= JOIN.accept else doubt,
        T_target_source=candidate.T_target_source,
        covariance=moved_to_origin(candidate.covariance, candidate.T_target_source, SE2(*candidate.at_m)),
        probability=probability,
        agreement=min(forward, backward),
        common_m2=common_m2,
        links=candidate.links,
    )


def known_part(source: OccupancyGrid, target: OccupancyGrid, T_target_source: SE2) -> OccupancyGrid:
    """Return the source without what the target does not know, widened by `JoinParameters.wall_m`."""
    n = math.ceil(JOIN.wall_m / target.resolution_m)
    known = cv2.dilate((target.cells != UNKNOWN).astype(np.uint8), np.ones((2 * n + 1, 2 * n + 1), np.uint8))
    cells = np.argwhere(source.cells != UNKNOWN)
    there_m = T_target_source.apply(source.to_point(cells))
    inside = target.look_up(known.astype(bool), there_m, outside=False)
    left = source.cells.copy()
    left[tuple(cells[~inside].T)] = UNKNOWN
    return replace(source, cells=left)


_MIRROR = np.array((-1.0, 1.0), np.float32)
"""Turns x into -x."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """T_target_source : where the source may lie. at_m : (x, y) the piece of the source that says so.
    log_odds : of the place of that piece, relative to its lying nowhere in the target."""

    T_target_source: SE2
    at_m: tuple[float, float]
    log_odds: float


_TransformT = TypeVar("_TransformT", Proposal, _ExactTransform)


def proposals(target: MapIndex, pieces: Sequence[Piece]) -> list[Proposal]:
    """Look the pieces of a source up in a target. Return how the source may lie there, the likeliest
    transform first, no two alike."""
    every = []
    for piece in pieces:
        found, _ = next(target.search(piece.query))
        every += [
            Proposal(T_target_source=fit.T_map_query, at_m=piece.center_m, log_odds=evidence.log_odds())
            for fit, evidence in zip(found, evidence_of(found, piece.query.likeness), strict=True)
        ]
    return list(islice(_distinct(sorted(every, key=lambda one: -one.log_odds)), JOIN.proposed))


def _distinct(transforms: Iterable[_TransformT]) -> Iterator[_TransformT]:
    """Yield the transforms that put their piece of the source at another place than all before them."""
    found: list[_TransformT] = []
    for one in transforms:
        at = SE2(*one.at_m)
        if not any(one_place(one.T_target_source @ at, other.T_target_source @ at) for other in found):
            found.append(one)
            yield one


@dataclass(frozen=True, slots=True)
class Piece:
    """A square of a map, described as a query. center_m : (x, y) the middle of its walls."""

    query: QueryMap
    center_m: tuple[float, float]

    @staticmethod
    def of(square: OccupancyGrid, index: MapIndex) -> Piece:
        """Describe a square of a map as the places of an index are described."""
        query = map_as_query(square, index.made_with, index.config)
        x, y = query.walls.points_m.mean(axis=0).tolist() if len(query.walls.points_m) else (0.0, 0.0)
        return Piece(query, (x, y))


def pieces_of(index: MapIndex) -> tuple[Piece, ...]:
    """Cut the map of one session into squares, and keep those with enough walls."""
    grid = index.grid_of(0)
    side = round(JOIN.side_m / grid.resolution_m)
    height, width = grid.cells.shape
    squares = (
        _square(grid, row, column, side) for row in range(0, height, side) for column in range(0, width, side)
    )
    pieces = (Piece.of(square, index) for square in squares if (square.cells > UNKNOWN).any())
    return tuple(piece for piece in pieces if piece.query.walls.weight >= JOIN.least_walls)


def mirrored(piece: Piece, index: MapIndex) -> Piece:
    """Return the mirror image of a piece: x turned into -x."""
    grid = piece.query.grid
    right_m = grid.origin_m[0] + grid.cells.shape[1] * grid.resolution_m
    heights = None if grid.heights is None else grid.heights[:, ::-1]
    turned = replace(grid, cells=grid.cells[:, ::-1], heights=heights, origin_m=(-right_m, grid.origin_m[1]))
    return Piece.of(turned, index)


def _square(grid: OccupancyGrid, row: int, column: int, side: int) -> OccupancyGrid:
    here = np.s_[row : row + side, column : column + side]
    x, y = grid.origin_m
    return replace(
        grid,
        cells=grid.cells[here],
        heights=None if grid.heights is None else grid.heights[here],
        origin_m=(x + column * grid.resolution_m, y + row * grid.resolution_m),
    )


def align_pieces(
    target: SearchMap, pieces: Sequence[Piece], T_target_source: SE2, from_m: tuple[float, float]
) -> tuple[Fit, ...]:
    """Align each piece with the walls of a target.

    from_m : (x, y) in the source where `T_target_source` is good.
    """
    centers_m = np.array([piece.center_m for piece in pieces]).reshape(-1, 2)
    fits: dict[int, Fit] = {}
    trusted: list[int] = []
    for number in np.argsort(np.hypot(*(centers_m - from_m).T), kind="stable").tolist():
        start = T_target_source
        if trusted:
            nearest = np.argmin(np.hypot(*(centers_m[trusted] - centers_m[number]).T))
            start = fits[trusted[int(nearest)]].T_map_query
        piece = pieces[number]
        points_m = piece.query.walls.facing(target.walls).points_m
        pose, covariance = refine(target.field, points_m, start, piece.center_m)
        fits[number] = fit = score_fit(target.walls, piece.query.walls, pose, covariance)
        if fit.known_agreement_both_ways >= JOIN.least_agreement:
            trusted.append(number)
    return tuple(fits[number] for number in range(len(pieces)))


@dataclass(frozen=True, slots=True)
class PieceFits:
    """The fits of K pieces under each of H transforms.

    seen, looked_at (H, K) : wall points on known ground, by weight, forward and backward. forward, backward
    (H, K) : mean likelihood, neutral on unknown ground. agreement (H, K) : forward, on known ground only.
    """

    seen: F64
    looked_at: F64
    forward: F64
    backward: F64
    agreement: F64

    @staticmethod
    def of(fits: Sequence[Sequence[Fit]]) -> PieceFits:
        """Collect the fits of all pieces under each transform."""

        def column(name: str) -> F64:
            return np.array([[getattr(fit, name) for fit in row] for row in fits], ndmin=2)

        looked_at = column("looked_at")
        return PieceFits(
            seen=column("compared"),
            looked_at=looked_at,
            forward=column("forward"),
            backward=np.where(looked_at > 0.0, column("backward"), LIKELIHOOD.neutral),
            agreement=column("known_agreement"),
        )

    def of_part(self, chosen: int) -> tuple[float, float, F64]:
        """Return how one transform agrees forward and backward where both know the ground, and the score (H,)
        of all transforms for this part of the source."""
        seen, looked_at = self.seen[chosen], self.looked_at[chosen]
        if not seen.sum() or not looked_at.sum():
            return 0.0, 0.0, np.zeros(len(self.seen))
        forward = self.forward @ seen / seen.sum()
        forward[chosen] = self.agreement[chosen] @ seen / seen.sum()
        backward = self.backward @ looked_at / looked_at.sum()
        return float(forward[chosen]), float(backward[chosen]), np.sqrt(forward * backward)


@dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """Where a piece of a source lies in a target.

    center_m : (x, y) the middle of its walls, in the source. covariance : (3, 3) of the piece's pose there,
    in the axes of the target, with what a map leaves open of where it shows anything.
    """

    center_m: tuple[float, float]
    T_target_source: SE2
    covariance: F64


def links_of(pieces: Sequence[Piece], fits: Sequence[Fit]) -> tuple[Link, ...]:
    """Return the pieces that agree with the target. Those on ground that it hardly knows do not count."""
    seen = [fit.compared for fit in fits]
    shown = [k for k, walls in enumerate(seen) if walls >= JOIN.least_walls] or [int(np.argmax(seen))]
    kept = [k for k in shown if fits[k].known_agreement_both_ways >= JOIN.least_agreement] or shown
    return tuple(
        Link(
            center_m=pieces[k].center_m,
            T_target_source=fits[k].T_map_query,
            covariance=fits[k].covariance + MAP_COVARIANCE,
        )
        for k in kept
    )


def rigid(links: Sequence[Link]) -> tuple[SE2, float]:
    """Return the one transform that is nearest to those of the pieces, and how far (m, rms of an axis) these
    deviate from it.

    Least squares over the poses of the pieces at their middles, each with the information that its walls
    give: one that shows a corridor only says nothing along it.
    """
    middles_m = np.array([link.center_m for link in links])
    there_m = np.array([link.T_target_source.apply(np.array([link.center_m]))[0] for link in links])
    yaws = np.array([link.T_target_source.yaw for link in links])
    information = np.linalg.inv(np.array([link.covariance for link in links]))
    T = links[0].T_target_source
    for _ in range(4):  # of Gauss and Newton; only the heading is not linear
        at_m = T.apply(middles_m)
        error = np.column_stack((there_m - at_m, wrap_angle(yaws - T.yaw)))
        J = np.array([lever_arm(T, SE2(*at)) for at in at_m.tolist()])
        normal = np.einsum("kia,kij,kjb->ab", J, information, J)
        x, y, yaw = np.linalg.solve(normal, np.einsum("kia,kij,kj->a", J, information, error)).tolist()
        T = SE2(T.x + x, T.y + y, wrap_angle(T.yaw + yaw))
    off_m, weight = T.apply(middles_m) - there_m, information[:, :2, :2]
    squares = np.einsum("ki,kij,kj->", off_m, weight, off_m) / np.einsum("kii->", weight)
    return T, math.sqrt(float(squares))
