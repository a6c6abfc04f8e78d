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
    """How many sessions are compared. By hand, checked on simulated fleets (`examples/fleet.md`).

    sessions : that each session is compared with. enough : joins of a session; two that have so many, and are
        of one building by these, are not compared. neighbours : that each place looks up, for each session.
    """

    sessions: int = 8
    enough: int = 3
    neighbours: int = 4


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

    The evidence of a pair of sessions is the sum over the places of the first of the log-likelihood ratio of
    the place that is most alike in the second, if that is found.
    """
    names = list(sessions)
    of = np.repeat(np.arange(len(names)), [len(sessions[name].vectors) for name in names])
    vectors = np.concatenate([sessions[name].vectors for name in names])
    seen = np.concatenate([sessions[name].seen for name in names])
    index, spread = cKDTree(vectors), seen_spread()
    wanted = min(parameters.sessions * parameters.neighbours, len(vectors) - 1)
    found = {}
    for number, name in enumerate(names):
        if name not in only or not len(sessions[name].vectors):
            continue
        here = sessions[name]
        # Its own places are found, too, and are left out.
        most = min(wanted + len(here.vectors), len(vectors))
        distance, row = index.query(here.vectors, k=np.arange(1, most + 1))
        ratio = spread.log_ratio(distance**2, (1.0 - here.seen)[:, None] + (1.0 - seen[row]))
        best = np.zeros((len(here.vectors), len(names)))
        place = np.repeat(np.arange(len(here.vectors)), most)
        np.maximum.at(best, (place, of[row].ravel()), ratio.ravel())
        best[:, number] = 0.0
        evidence = best.sum(axis=0)
        order = [names[k] for k in np.argsort(-evidence, kind="stable").tolist() if evidence[k] > 0.0]
        found[name] = tuple([other for other in order if comparable(name, other)][: parameters.sessions])
    return found
