"""Which sessions of many may show one building: those whose places look alike.

Comparing every two sessions takes a time that grows with the square of their number. So the places of all
sessions are put into one index by the three signatures of what is seen from them, each place looks up the
places that are most like it, and a session is compared with those that its places find most often.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.arrays import F32
from signature.seen_likelihood import seen_spread, seen_weights
from signature.seen_places import SeenPlaces


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateParameters:
    """How many sessions are compared. By hand, checked on simulated fleets (`examples/buildings.md`).

    sessions : that each session is compared with. enough : comparisons that settle a question: joins of a
        session within its building, and pairs of sessions of two buildings that are not joined. A pair of
        one building is missed in 9 of 40 real cases, three in a row in one of a hundred.
    neighbours : that each place looks up, those of its own session included.
    inexact : a neighbour is at most so much farther than the true one, as a share of its distance; the index
        finds the same sessions as without it, in a quarter of the time.
    """

    sessions: int = 8
    enough: int = 3
    neighbours: int = 32
    inexact: float = 2.0


CANDIDATES = CandidateParameters()


@dataclass(frozen=True, slots=True)
class LookedAt:
    """The N places of a session as they are looked up: vectors (N, D) by the weights of their signatures, and
    the share of the rays (N,) whose ends are known there."""

    vectors: F32
    seen: F32

    @staticmethod
    def of(places: SeenPlaces) -> LookedAt:
        """One viewpoint of each place, the first: others are less than two steps away."""
        first = np.unique(places.place, return_index=True)[1]
        shares = places.shares[first]
        return LookedAt(seen_weights().of_places(shares), shares[:, -1])


def candidates(
    sessions: Mapping[str, LookedAt],
    only: Collection[str],
    comparable: Callable[[str, str], bool] = lambda a, b: True,
    parameters: CandidateParameters = CANDIDATES,
) -> dict[str, tuple[str, ...]]:
    """For each session of `only` the others that it should be compared with, the likeliest first.

    comparable : whether two sessions may show one building at all.

    A place of a session is one of the n places of another one as likely as not, and as likely each. So with
    the likelihood ratios r of the signatures, the evidence of a pair is the sum of ln(1 + sum(r) / n) over
    the places of the first: a large session is not found more often because it has more places.
    """
    names = list(sessions)
    counts = np.array([len(sessions[name].vectors) for name in names])
    of = np.repeat(np.arange(len(names)), counts)
    vectors = np.concatenate([sessions[name].vectors for name in names])
    hidden = 1.0 - np.concatenate([sessions[name].seen for name in names])
    index, spread = cKDTree(vectors), seen_spread()
    wanted = np.arange(1, min(parameters.neighbours, len(vectors)) + 1)
    found = {}
    for name in (name for name in names if name in only and len(sessions[name].vectors)):
        here = sessions[name]
        distance, row = index.query(here.vectors, k=wanted, eps=parameters.inexact)
        ratio = np.exp(spread.log_ratio(distance**2, 1.0 - here.seen[:, None] + hidden[row]))
        others, column = np.unique(of[row], return_inverse=True)
        total = np.zeros((len(row), len(others)))
        np.add.at(total, (np.arange(len(row))[:, None], column.reshape(row.shape)), ratio)
        evidence = np.log1p(total / counts[others]).sum(axis=0)
        order = [names[k] for k in others[np.argsort(-evidence, kind="stable")].tolist()]
        likely = [other for other in order if other != name and comparable(name, other)]
        found[name] = tuple(likely[: parameters.sessions])
    return found
