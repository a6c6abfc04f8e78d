"""How a session may lie in another one: each of its pieces is a query, which is looked up like any other.

Signatures say where in the target a piece may be, and its walls are aligned there
(`signature.localization.map_index`). A place of one piece is a transform of the whole session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pc2grid.geometry import SE2
from signature.localization.hypotheses import same_pose
from signature.localization.joining.pieces import Piece
from signature.localization.map_index import MapIndex
from signature.localization.posterior import evidence_of

MOST = 20
"""Transforms that are proposed, by hand: a building of equal rooms has as many."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """T_target_source : where the source may lie. at_m : (x, y) the piece of the source that says so.
    log_odds : of the place of that piece, relative to its lying nowhere in the target."""

    T_target_source: SE2
    at_m: tuple[float, float]
    log_odds: float


def proposals(target: MapIndex, pieces: Sequence[Piece]) -> list[Proposal]:
    """The ways in which a source may lie in a target, the likeliest first, no two alike."""
    every = [one for piece in pieces for one in _places_of(target, piece)]
    found: list[Proposal] = []
    for proposal in sorted(every, key=lambda one: -one.log_odds):
        if len(found) == MOST:
            break
        if not any(_alike(proposal, other) for other in found):
            found.append(proposal)
    return found


def _places_of(target: MapIndex, piece: Piece) -> list[Proposal]:
    """Where a piece may lie in the target."""
    found, _ = next(target.search(piece.query))
    fits = [hypothesis.fit for hypothesis in found]
    return [
        Proposal(T_target_source=fit.T_map_query, at_m=piece.center_m, log_odds=evidence.log_odds())
        for fit, evidence in zip(fits, evidence_of(fits, piece.query), strict=True)
    ]


def _alike(a: Proposal, b: Proposal) -> bool:
    """Whether both put the piece of the first at one place."""
    at = SE2(*a.at_m)
    return same_pose(a.T_target_source @ at, b.T_target_source @ at)
