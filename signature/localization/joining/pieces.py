"""A map in pieces, each aligned by itself: a bent map fits another one in pieces, and nowhere as a whole.

The pieces are aligned one after the other, from the one that proposed a transform outwards. Each begins
where its nearest neighbour came to lie, so the alignment follows the bend.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.matching.likelihood_field import LIKELIHOOD
from pc2grid.matching.refinement import refine
from pc2grid.matching.two_way_score import Fit, score_fit
from pc2grid.matching.walls import Walls
from pc2grid.matching.window_search import SearchMap
from pc2grid.model import UNKNOWN, OccupancyGrid
from signature.localization.hypotheses import HYPOTHESES
from signature.localization.map_index import MapIndex
from signature.localization.query import QueryMap, map_as_query


@dataclass(frozen=True, slots=True, kw_only=True)
class PieceParameters:
    """How a map is cut, and what of it counts. By hand.

    side_m : of a square piece: about what a robot sees from a place. least_walls : wall points of a piece, by
        weight. follows : a piece that agrees less than this does not say where its neighbours begin; wrong
        places agree by 0.6, see `signature.localization.posterior`.
    """

    side_m: float = 12.0
    least_walls: float = 20.0
    follows: float = 0.6


PIECES = PieceParameters()
_STEPS = 4
"""Of Gauss and Newton; only the heading is not linear."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A square of a map, described as a query. center_m : (x, y) the middle of its walls."""

    query: QueryMap
    center_m: tuple[float, float]

    @staticmethod
    def of(square: OccupancyGrid, index: MapIndex) -> Piece:
        """A square of a map, described as the places of an index are."""
        query = map_as_query(square, index.made_with, index.config)
        x, y = query.walls.points_m.mean(axis=0).tolist() if len(query.walls.points_m) else (0.0, 0.0)
        return Piece(query, (x, y))

    @property
    def walls(self) -> Walls:
        """Its walls."""
        return self.query.walls


def pieces_of(index: MapIndex) -> tuple[Piece, ...]:
    """The squares of the map of one session that hold enough walls."""
    grid = index.grids[0]
    side = round(PIECES.side_m / grid.resolution_m)
    height, width = grid.cells.shape
    squares = (
        _square(grid, row, column, side) for row in range(0, height, side) for column in range(0, width, side)
    )
    pieces = (Piece.of(square, index) for square in squares if (square.cells > UNKNOWN).any())
    return tuple(piece for piece in pieces if piece.walls.weight >= PIECES.least_walls)


def mirrored(piece: Piece, index: MapIndex) -> Piece:
    """A piece with x turned into -x."""
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
    """Where each piece lies in a target. from_m : (x, y) in the source where `T_target_source` is good."""
    centers_m = np.array([piece.center_m for piece in pieces]).reshape(-1, 2)
    fits: dict[int, Fit] = {}
    trusted: list[int] = []
    for number in np.argsort(np.hypot(*(centers_m - from_m).T), kind="stable").tolist():
        start = T_target_source
        if trusted:
            nearest = np.argmin(np.hypot(*(centers_m[trusted] - centers_m[number]).T))
            start = fits[trusted[int(nearest)]].T_map_query
        piece = pieces[number]
        points_m = piece.walls.facing(target.walls).points_m
        pose, covariance = refine(target.field, points_m, start, piece.center_m)
        fits[number] = fit = score_fit(target.walls, piece.walls, pose, covariance)
        if fit.known_agreement_both_ways >= PIECES.follows:
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
        """From the fits of all pieces under each transform."""

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
        """Agreement forward and backward of one transform where both know the ground, and the score (H,) of
        all transforms for this part of the source."""
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
    """The pieces that agree with the target. Those on ground that it hardly knows do not count."""
    seen = [fit.compared for fit in fits]
    shown = [k for k, walls in enumerate(seen) if walls >= PIECES.least_walls] or [int(np.argmax(seen))]
    kept = [k for k in shown if fits[k].known_agreement_both_ways >= PIECES.follows] or shown
    noise = np.diag(np.square((HYPOTHESES.map_m, HYPOTHESES.map_m, HYPOTHESES.map_rad)))
    return tuple(
        Link(
            center_m=pieces[k].center_m,
            T_target_source=fits[k].T_map_query,
            covariance=fits[k].covariance + noise,
        )
        for k in kept
    )


def rigid(links: Sequence[Link]) -> tuple[SE2, float]:
    """The one transform that is nearest to those of the pieces, and how far (m, rms of an axis) these deviate
    from it.

    Least squares over the poses of the pieces at their middles, each with the information that its walls
    give: one that shows a corridor only says nothing along it.
    """
    middles_m = np.array([link.center_m for link in links])
    there_m = np.array([link.T_target_source.apply(np.array([link.center_m]))[0] for link in links])
    yaws = np.array([link.T_target_source.yaw for link in links])
    information = np.linalg.inv(np.array([link.covariance for link in links]))
    T = links[0].T_target_source
    for _ in range(_STEPS):
        at_m = T.apply(middles_m)
        error = np.column_stack((there_m - at_m, wrap_angle(yaws - T.yaw)))
        J = np.tile(np.eye(3), (len(links), 1, 1))
        J[:, 0, 2], J[:, 1, 2] = T.y - at_m[:, 1], at_m[:, 0] - T.x
        normal = np.einsum("kia,kij,kjb->ab", J, information, J)
        x, y, yaw = np.linalg.solve(normal, np.einsum("kia,kij,kj->a", J, information, error)).tolist()
        T = SE2(T.x + x, T.y + y, wrap_angle(T.yaw + yaw))
    off_m, weight = T.apply(middles_m) - there_m, information[:, :2, :2]
    squares = np.einsum("ki,kij,kj->", off_m, weight, off_m) / np.einsum("kii->", weight)
    return T, math.sqrt(float(squares))
