"""Which pairs of sessions are compared, in which order, and when enough is known of two buildings.

Of few sessions every two are compared. Of many, each is compared with those that look most like it
(`candidates`), in rounds: the likeliest of each, then the next ones. After each round the sessions that were
joined make buildings, and of the next round only those pairs are compared that tell something new: whether
two buildings are one, until pairs enough say that they are not, and where a session lies in its building,
until it has joins enough. So the comparisons grow with the number of sessions.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from pc2grid.model import same_recording
from signature.database.protocol import BuildingFrame, SessionInfo
from signature.localization.joining.candidates import CANDIDATES, LookedAt, candidates
from signature.localization.joining.join import Join

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

Names = tuple[str, str]
"""Of two sessions."""


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
    one_recording = same_recording(a.name, b.name)
    return a.provenance.label.contradicts(b.provenance.label, one_recording=one_recording)


def rounds_of(
    database: SubmapDatabase, infos: Mapping[str, SessionInfo], only: Collection[str]
) -> list[list[Names]]:
    """The pairs that may have to be compared, one of them at least of `only`, in rounds: of few sessions all
    at once, of many the likeliest of each session, then the next ones."""

    def comparable(a: str, b: str) -> bool:
        return not told_apart(infos[a], infos[b])

    if len(infos) <= 1 + CANDIDATES.sessions:
        return [[(a, b) for a, b in combinations(infos, 2) if {a, b} & {*only} and comparable(a, b)]]
    places = {name: LookedAt.of(database.seen_places(name)) for name in infos}
    number = {name: k for k, name in enumerate(infos)}
    # Of each pair the round in which one of both asks for it first.
    first: dict[Names, int] = {}
    for name, others in candidates(places, only, comparable, CANDIDATES).items():
        for rank, other in enumerate(others):
            a, b = sorted((name, other), key=number.__getitem__)
            first[a, b] = min(rank, first.get((a, b), rank))
    rounds: list[list[Names]] = [[] for _ in range(CANDIDATES.sessions)]
    for pair, rank in first.items():
        rounds[rank].append(pair)
    return rounds


class Buildings:
    """What comparisons have told so far: the sessions of each building hang together by joins.

    The graph of the joins has a node for each session that was joined.
    """

    def __init__(self, stay: Mapping[str, BuildingFrame]) -> None:
        """stay : sessions that lie in buildings already, each as sure as by joins enough."""
        import networkx as nx

        self._joins = nx.Graph()
        self._apart: list[Names] = []
        for members in by_building(stay).values():
            nx.add_path(self._joins, members, count=CANDIDATES.enough)

    def add(self, a: str, b: str, join: Join) -> None:
        """The join of two sessions. That it is ambiguous tells nothing."""
        if join.status == "joined":
            self._joins.add_edge(a, b, count=1)
        elif join.status == "different":
            self._apart.append((a, b))

    def telling(self, pairs: Iterable[Names]) -> list[Names]:
        """Those of the pairs, the first ones first, that tell something new, even if the others of them say
        that two buildings are different."""
        import networkx as nx

        degree = self._joins.degree(weight="count")
        parts = enumerate(nx.connected_components(self._joins))
        building = {name: number for number, members in parts for name in members}

        def sides(a: str, b: str) -> frozenset[str | int]:
            return frozenset((building.get(a, a), building.get(b, b)))

        apart = Counter(sides(a, b) for a, b in self._apart)
        told = []
        for a, b in pairs:
            two = sides(a, b)
            known = apart[two] if len(two) > 1 else min(degree[a], degree[b])
            if known < CANDIDATES.enough:
                told.append((a, b))
                apart[two] += 1
        return told


def by_building(frames: Mapping[str, BuildingFrame]) -> dict[str, list[str]]:
    """The names of the sessions of each building, by the name of its frame."""
    found: dict[str, list[str]] = defaultdict(list)
    for name, at in frames.items():
        found[at.name].append(name)
    return found


def along(pairs: Collection[Names]) -> list[Names]:
    """The pairs in an order in which neighbours share a session, whose map is prepared once."""
    import networkx as nx

    graph = nx.Graph(sorted(pairs))
    place = {name: k for k, name in enumerate(nx.dfs_preorder_nodes(graph))}

    def reached(pair: Names) -> tuple[int, int]:
        first, last = sorted(place[name] for name in pair)
        return last, -first

    return sorted(pairs, key=reached)
