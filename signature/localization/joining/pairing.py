"""Sessions compared in pairs: every two that may show one building."""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from pc2grid.observer import Observer
from signature.database.protocol import BuildingFrame, SessionInfo
from signature.localization.joining.join import Join, JoinableMap, join_maps
from signature.localization.map_index import MapIndex

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

Names = tuple[str, str]
"""Of two sessions."""
_KEPT = 30
"""Prepared maps that stay in memory: no more sessions are joined in a reasonable time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPair:
    """Two sessions that were compared. accepted : whether their join counts: the pair is joined, and neither
    labels nor the other pairs contradict it."""

    target: str
    source: str
    join: Join
    accepted: bool = False

    @property
    def names(self) -> Names:
        """Of the two sessions."""
        return self.target, self.source


def told_apart(a: SessionInfo, b: SessionInfo) -> bool:
    """Whether labels say that two sessions are not of one floor of one building."""
    return a.provenance.label.contradicts(b.provenance.label)


def compare_pairs(
    database: SubmapDatabase, infos: Mapping[str, SessionInfo], only: Collection[str], observer: Observer
) -> Iterator[SessionPair]:
    """Every two sessions that labels do not tell apart, joined as far as they can be.

    only : one of each pair, at least, is of these.
    """
    pairs = [
        (a, b) for a, b in combinations(infos, 2) if {a, b} & {*only} and not told_apart(infos[a], infos[b])
    ]

    @functools.lru_cache(_KEPT)
    def prepared(name: str) -> JoinableMap:
        return JoinableMap(MapIndex.of_session(database, name))

    with observer.step(f"compare {len(pairs)} pairs of sessions"):
        for done, (a, b) in enumerate(pairs, start=1):
            labelled = infos[a].provenance.label.agrees(infos[b].provenance.label)
            join = join_maps(prepared(a), prepared(b), labelled=labelled)
            yield SessionPair(target=a, source=b, join=join)
            observer.on_progress(done / len(pairs))


def by_building(frames: Mapping[str, BuildingFrame]) -> dict[str, list[str]]:
    """The names of the sessions of each building, by the name of its frame."""
    found: dict[str, list[str]] = defaultdict(list)
    for name, at in frames.items():
        found[at.name].append(name)
    return found
