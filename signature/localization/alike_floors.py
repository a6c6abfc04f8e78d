"""Floors of one building that look alike share the mass of a place, because unknown ground says nothing.

A score tells two such floors apart by what is unknown in one of their maps. So where the maps of two floors
agree in all that both know, and the map of the other floor does not contradict the query, the same place
there has the mass of the place that was found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import same_recording
from signature.localization.hypotheses import Hypothesis, fitted
from signature.localization.map_index import MapIndex
from signature.localization.posterior import POSTERIOR
from signature.localization.query import QueryMap, query_of
from signature.localization.same_place import share_known


@dataclass(frozen=True, slots=True, kw_only=True)
class AlikeFloors:
    """When the maps of two floors look alike, and when the query may have been made on either. By hand.

    agreement, overlap : the maps of two floors look alike if so much of what both know agrees, and so much of
        the walls of one is known to the other. Simulated floors with one plan and other furniture reach 0.82
        and 0.45; a mirrored plan reaches 0.88, but 0.24.
    seen_there : where two floors look alike, and the map of the other one shows less than this share of what
        the query has seen, the query may have been made there as well; and so it may if what is known there
        agrees with it as well as here.
    """

    agreement: float = 0.8
    overlap: float = 0.35
    seen_there: float = 0.6


ALIKE_FLOORS = AlikeFloors()


def unseen_alike(index: MapIndex, query: QueryMap, best: Hypothesis) -> list[Hypothesis]:
    """The place of a hypothesis on the other floors that look alike and do not contradict the query: their
    maps show too little of it, or agree with it as well. None with a prior, which names the floor."""
    least = best.fit.known_agreement_both_ways - POSTERIOR.alike
    found = []
    for there, T_there_here in _alike(index, query, best.session_index):
        pose = T_there_here @ best.fit.T_map_query
        unseen = share_known(index.grids[there], query.grid, pose) < ALIKE_FLOORS.seen_there
        h = fitted(query, there, -1, index.maps_for(query)[there], pose)
        if unseen or h.fit.known_agreement_both_ways >= least:
            found.append(h)
    return found


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
    one_recording = same_recording(index.sessions[here], index.sessions[there])
    one_building = one_recording or (label.building is not None and label.building == other.building)
    return one_building and label.contradicts(other, one_recording=one_recording)


def _aligned(index: MapIndex, here: int, there: int) -> SE2 | None:
    """T_there_here of two maps that agree where both know something; None if they do not."""
    whole = query_of(index.grids[here], np.empty((0, 2)), index.made_with, index.config)
    rows = np.flatnonzero(index.places.table.session_index == there)
    for h in index.look_up(whole, rows=rows):
        agree = h.fit.known_agreement_both_ways >= ALIKE_FLOORS.agreement
        if h.session_index == there and agree and h.fit.overlap >= ALIKE_FLOORS.overlap:
            return h.fit.T_map_query
    return None
