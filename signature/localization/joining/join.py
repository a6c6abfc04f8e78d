"""Do two sessions show one building, and how does one lie to the other?

The pieces of the source propose transforms (`proposals`); each is refined and scored by the walls of both.
What is judged is the part of the source that lies on known ground of the target: it is a query that the
target is asked for, and the posterior of every other answer decides (`posterior`). The other transforms are
its rivals, with the same part. So are decoys: the source is also matched in its mirror image, which lies
nowhere for certain. What that scores is what wrong transforms of these two maps score, and where a building
is symmetric, or another one has its plan turned over, it scores as much as any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid, freeze
from pc2grid.geometry import SE2
from pc2grid.matching.likelihood_field import LIKELIHOOD
from pc2grid.matching.refinement import refine
from pc2grid.matching.self_likeness import self_likeness
from pc2grid.matching.two_way_score import Fit
from pc2grid.matching.walls import Walls
from pc2grid.matching.window_search import SearchMap
from pc2grid.model import UNKNOWN, OccupancyGrid
from signature.localization.hypotheses import HYPOTHESES, moved_to_origin, same_pose
from signature.localization.joining.pieces import (
    PIECES,
    Link,
    Piece,
    PieceFits,
    align_pieces,
    links_of,
    mirrored,
    pieces_of,
    rigid,
)
from signature.localization.joining.proposals import Proposal, proposals
from signature.localization.map_index import MapIndex
from signature.localization.posterior import NO_EVIDENCE, POSTERIOR, Evidence, evidence_of, masses
from signature.localization.query import QueryMap

JoinStatus = Literal["joined", "ambiguous", "different"]
"""different: nothing says that the two show one building."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinParameters:
    """How a transform is verified and judged. By hand.

    least_m2 : free ground that both sessions know at least. Smaller rooms are alike in many buildings.
    accept : least probability. A wrong answer is one, a wrong join makes all later answers wrong.
    labelled : prior odds that two sessions show one floor if their labels say so, relative to those of other
        sessions, which the posterior begins with.
    wall_m : the ground that a session knows is widened by this, so that the walls at its edge count.
    """

    least_m2: float = 20.0
    accept: float = 0.99
    labelled: float = 10.0
    wall_m: float = 0.4


JOIN = JoinParameters()
_MIRROR = np.array((-1.0, 1.0), np.float32)
"""Turns x into -x."""


@dataclass(frozen=True)  # no slots, for what is computed once
class JoinableMap:
    """The map of a session, prepared to be joined when it first matters.

    index : of this session alone.
    """

    index: MapIndex

    @property
    def grid(self) -> OccupancyGrid:
        """The map."""
        return self.index.grids[0]

    @cached_property
    def walls(self) -> Walls:
        """Its walls."""
        return Walls.of(self.grid)

    @cached_property
    def query(self) -> QueryMap:
        """The map as a query."""
        return QueryMap(
            stamp_ns=0,
            path_m=0.0,
            T_odom_base=SE2(),
            grid=self.grid,
            views=(),
            walls=self.walls,
            center_m=(0.0, 0.0),
        )

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """The map cut in pieces."""
        return pieces_of(self.index)

    @cached_property
    def mirrored_pieces(self) -> tuple[Piece, ...]:
        """The same pieces of the mirror image, with x turned into -x."""
        return tuple(mirrored(piece, self.index) for piece in self.pieces)

    @property
    def search(self) -> SearchMap:
        """The map, prepared to be searched."""
        return self.index.maps[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class Join:
    """How a source session lies in the map of a target session, as far as that is known.

    status : whether they are joined. T_target_source : the best transform; of no meaning if "different".
    covariance : (3, 3) of its x, y, yaw. probability : 0..1, of the transform being right.
    agreement : 0..1, of the walls where both know the ground, the lower one of both directions.
    common_m2 : free ground that both know.
    rivals : other transforms that were compared, with decoys. evidence : what the probability rests on.
    links : where the pieces of the source lie that agree with the target.
    """

    status: JoinStatus
    T_target_source: SE2
    covariance: F64
    probability: float
    agreement: float
    common_m2: float
    rivals: int
    evidence: Evidence
    links: tuple[Link, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "covariance", np.float64, (3, 3))


UNJOINED = Join(
    status="different",
    T_target_source=SE2(),
    covariance=np.zeros((3, 3)),
    probability=0.0,
    agreement=0.0,
    common_m2=0.0,
    rivals=0,
    evidence=NO_EVIDENCE,
)
"""Two sessions whose graphs propose nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Candidate:
    """A transform that was made exact by walls. at : the piece of the source that proposed it. fits : of each
    piece of the source. links : of those that agree. covariance : (3, 3) of the transform at `at`."""

    T_target_source: SE2
    at: SE2
    fits: tuple[Fit, ...]
    links: tuple[Link, ...]
    covariance: F64


def join_maps(
    target: JoinableMap, source: JoinableMap, *, labelled: bool = False, parameters: JoinParameters = JOIN
) -> Join:
    """Whether two sessions show one building, and how the source lies in the target.

    labelled : labels say that both are of one floor of one building.
    """
    points_m = source.walls.facing(target.walls).points_m
    prior = parameters.labelled if labelled else 1.0
    candidates = _candidates(target, points_m, source.pieces)
    join = _best(target, source, candidates, (), prior, parameters)
    if join.status == "different":
        return join  # decoys are further rivals, which tell against it at most
    decoys = _candidates(target, points_m * _MIRROR, source.mirrored_pieces)
    return _best(target, source, candidates, decoys, prior, parameters)


def _best(
    target: JoinableMap,
    source: JoinableMap,
    candidates: Sequence[_Candidate],
    decoys: Sequence[_Candidate],
    prior: float,
    parameters: JoinParameters,
) -> Join:
    """The most probable of some transforms, all others being its rivals. prior : odds of one building.

    By branch and bound: what is not judged is neither joined nor more probable than the best.
    """
    fits = PieceFits.of([candidate.fits for candidate in (*candidates, *decoys)])
    found = [_evidence(source, one, k, fits) for k, one in enumerate(candidates)]
    bounds = [_bound(evidence, prior) for evidence in found]
    best = UNJOINED
    for k in sorted(range(len(candidates)), key=lambda k: -bounds[k]):
        if bounds[k] < min(best.probability, parameters.accept):
            break
        join = _judged(target, source, candidates[k], k, fits, found[k], prior, parameters)
        best = max(best, join, key=lambda join: (join.status == "joined", join.probability))
    return best


def _same(a: _Candidate, b: _Candidate) -> bool:
    return same_pose(a.T_target_source @ a.at, b.T_target_source @ a.at)


def _candidates(target: JoinableMap, points_m: F32, pieces: Sequence[Piece]) -> list[_Candidate]:
    """The transforms of a source that its pieces propose, no two alike."""
    found: list[_Candidate] = []
    for proposal in proposals(target.index, pieces):
        refined = _refined(target, points_m, pieces, proposal)
        if not any(_same(refined, other) for other in found):
            found.append(refined)
    return found


def _refined(target: JoinableMap, points_m: F32, pieces: Sequence[Piece], proposal: Proposal) -> _Candidate:
    """The transform of one piece made exact by the walls of all."""
    pose = proposal.T_target_source
    fits = align_pieces(target.search, pieces, pose, proposal.at_m)
    links = links_of(pieces, fits)
    T_target_source, bend_m = rigid(links)
    whole, covariance = refine(target.search.field, points_m, T_target_source, proposal.at_m)
    if bend_m < LIKELIHOOD.sigma_m:  # all walls are within reach of theirs at once, which is more exact
        T_target_source = whole
    deviations = (HYPOTHESES.map_m, HYPOTHESES.map_m, HYPOTHESES.map_rad)
    covariance = covariance + np.diag(np.square(deviations)) + np.diag([bend_m**2, bend_m**2, 0.0])
    return _Candidate(
        T_target_source=T_target_source,
        at=SE2(*proposal.at_m),
        fits=fits,
        links=links,
        covariance=covariance,
    )


def _evidence(source: JoinableMap, candidate: _Candidate, number: int, fits: PieceFits) -> Evidence:
    """What tells for a transform, by the walls of the source that lie on known ground of the target.

    number : its row in `fits`; the other rows are of its rivals.
    """
    forward, backward, scores = fits.of_part(number)
    whole = [
        Fit(
            T_map_query=candidate.T_target_source,
            forward=forward,
            backward=backward,
            overlap=1.0,
            compared=float(fits.seen[number].sum()),
            looked_at=float(fits.looked_at[number].sum()),
            score=score,
            covariance=candidate.covariance,
        )
        for score in scores.tolist()
    ]
    return evidence_of(whole, source.query)[number]


def _bound(evidence: Evidence, prior: float) -> float:
    """The probability of a transform if its part of the source is unlike itself, and is all of it: never
    lower than the true one."""
    highest = replace(evidence, lead=max(evidence.lead, 0.0), likeness=0.0)
    return float(masses([highest], prior)[0])


def _judged(
    target: JoinableMap,
    source: JoinableMap,
    candidate: _Candidate,
    number: int,
    fits: PieceFits,
    evidence: Evidence,
    prior: float,
    parameters: JoinParameters,
) -> Join:
    """The posterior of a transform, by the part of the source that lies in the target.

    number : its row in `fits`; the other rows are of its rivals. evidence : see `_evidence`. prior : odds of
    one building.
    """
    part = known_part(source.grid, target.grid, candidate.T_target_source)
    common_m2 = free_in_both(part, target.grid, candidate.T_target_source)
    forward, backward, scores = fits.of_part(number)
    evidence = replace(evidence, likeness=self_likeness(Walls.of(part)))
    # The part was chosen: of so many parts of the smaller session, this one fits best.
    share = min(common_m2 / max(min(source.grid.free_m2, target.grid.free_m2), 1e-9), 1.0)
    odds = prior * max(share, 1e-9)
    # Transforms that fit equally well share the mass.
    equal = int(np.count_nonzero(np.abs(scores - scores[number]) <= POSTERIOR.alike))
    probability = float(masses([evidence] * equal, odds)[0])
    # Of thousands of wall points a small lead is much, even where walls fit as wrong places do.
    enough = common_m2 >= parameters.least_m2 and min(forward, backward) >= PIECES.follows
    return Join(
        status=_status(evidence, odds, probability, enough, parameters),
        T_target_source=candidate.T_target_source,
        covariance=moved_to_origin(candidate.covariance, candidate.T_target_source, candidate.at),
        probability=probability,
        agreement=min(forward, backward),
        common_m2=common_m2,
        rivals=len(scores) - 1,
        evidence=evidence,
        links=candidate.links,
    )


def _status(
    evidence: Evidence, odds: float, probability: float, enough: bool, parameters: JoinParameters
) -> JoinStatus:
    """What is said of a transform. enough : whether enough is in common, and alike, to be joined."""
    if enough and probability >= parameters.accept:
        return "joined"
    # That the source lies here, or at a place that fits equally well, is more probable than not.
    return "ambiguous" if evidence.log_odds() + math.log(odds) > 0.0 else "different"


def known_part(source: OccupancyGrid, target: OccupancyGrid, T_target_source: SE2) -> OccupancyGrid:
    """The source without what the target does not know, widened by `JoinParameters.wall_m`."""
    n = math.ceil(JOIN.wall_m / target.resolution_m)
    known = cv2.dilate((target.cells != UNKNOWN).astype(np.uint8), np.ones((2 * n + 1, 2 * n + 1), np.uint8))
    cells = np.argwhere(source.cells != UNKNOWN)
    inside = _looked_up(known.astype(bool), target, T_target_source.apply(source.to_point(cells)))
    left = source.cells.copy()
    left[tuple(cells[~inside].T)] = UNKNOWN
    return replace(source, cells=left)


def free_in_both(source: OccupancyGrid, target: OccupancyGrid, T_target_source: SE2) -> float:
    """Square metres that are free in both."""
    points_m = T_target_source.apply(source.to_point(np.argwhere(source.free)))
    return float(_looked_up(target.free, target, points_m).sum()) * source.resolution_m**2


def _looked_up(mask: BoolGrid, grid: OccupancyGrid, points_m: F64) -> BoolGrid:
    """(N,) the values of a mask over a grid at points (N, 2); False outside."""
    at = grid.to_cell(points_m)
    inside: BoolGrid = np.asarray(((at >= 0) & (at < mask.shape)).all(axis=1))
    inside[inside] = mask[tuple(at[inside].T)]
    return inside
