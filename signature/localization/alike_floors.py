"""Floors of one building that look alike share the mass of a place, because unknown ground says nothing.

A score tells two such floors apart by what is unknown in one of their maps. So where the maps of two floors
agree in what both know, the same place there has mass, too: that of the place that was found, unless what is
known there fits worse, by the equation of `signature.localization.posterior`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.matching.two_way_score import Fit
from signature.localization.hypotheses import Hypothesis, fitted
from signature.localization.map_index import MapIndex
from signature.localization.posterior import evidence_of
from signature.localization.query import QueryMap, query_of


def alike_elsewhere(
    index: MapIndex, query: QueryMap, best: Hypothesis
) -> tuple[list[Hypothesis], list[float]]:
    """The place of a hypothesis on the other floors that look alike, and its mass there beside that of the
    hypothesis, 0..1. None with a prior, which names the floor."""
    found, shares = [], []
    for there, T_there_here in _alike(index, query, best.session_index):
        pose = T_there_here @ best.fit.T_map_query
        found.append(fitted(query, there, -1, index.maps_for(query)[there], pose))
        shares.append(_share(found[-1].fit, best.fit, query))
    return found, shares


def _share(there: Fit, here: Fit, query: QueryMap) -> float:
    """Mass of a place there over that of the same place here, at most 1, by what is known there."""
    if not there.compared:
        return 1.0

    def known(fit: Fit) -> Fit:
        score = math.sqrt(fit.known_agreement * fit.backward)
        return replace(fit, score=score, compared=there.compared, looked_at=there.looked_at)

    evidence_there, evidence_here = evidence_of((known(there), known(here)), query)
    return math.exp(min(evidence_there.log_odds() - evidence_here.log_odds(), 0.0))


def _alike(index: MapIndex, query: QueryMap, here: int) -> Iterator[tuple[int, SE2]]:
    """The sessions of other floors of the building that look alike, each with T_there_here."""
    if index.region is not None:
        return
    for there in index.places.sessions(query.views, index.made_with.signature, index.config):
        if _other_floor(index, here, there):
            if (here, there) not in index.alike_floors:
                index.alike_floors[here, there] = _aligned(index, here, there)
            T_there_here = index.alike_floors[here, there]
            if T_there_here is not None:
                yield there, T_there_here


def _other_floor(index: MapIndex, here: int, there: int) -> bool:
    """Whether two sessions are of one building, and of different floors of it."""
    label, other = index.labels[here], index.labels[there]
    one_building = label.building is not None and label.building == other.building
    return one_building and label.contradicts(other)


def _aligned(index: MapIndex, here: int, there: int) -> SE2 | None:
    """T_there_here of two maps of which one, asked as a query, is rather in the other than nowhere; None if
    it is not."""
    whole = query_of(index.grids[here], np.empty((0, 2)), index.made_with, index.config)
    rows = np.flatnonzero(index.places.table.session_index == there)
    fits = [h.fit for h in index.look_up(whole, rows=rows) if h.session_index == there]
    likely = (
        fit for fit, known in zip(fits, evidence_of(fits, whole), strict=True) if known.log_odds() >= 0.0
    )
    return next((fit.T_map_query for fit in likely), None)
