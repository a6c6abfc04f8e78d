"""All sessions of a database joined: pairs of sessions become buildings with one frame each.

Pairs are joined in the order of their probability (Kruskal's algorithm), so each building begins with what
is surest, and never two sessions into one building whose labels name different buildings or floors. Then one
pose graph over the sessions, each pair a robust edge, says where they lie, and how exactly; and another one,
over all that they have measured, how they are bent (`straightening`).
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, cast

import numpy as np

from pc2grid.arrays import F64
from pc2grid.errors import DatabaseError
from pc2grid.geometry import SE2
from pc2grid.mapping.local_maps import pose_at
from pc2grid.mapping.pose_graph import Edge, information_matrix, optimise
from pc2grid.model import OccupancyGrid, same_recording
from pc2grid.observer import Observer
from signature.database.protocol import BuildingFrame, Covariance, SessionInfo, SessionRole, retired
from signature.database.rows import no_session
from signature.localization.joining.building_map import building_map
from signature.localization.joining.candidates import CANDIDATES, LookedAt, candidates
from signature.localization.joining.comparing import Compare, ToCompare, compare_here
from signature.localization.joining.join import Join
from signature.localization.joining.journal import JoinJournal, key_of
from signature.localization.joining.straightening import HELD, bodies_of, straighten

if TYPE_CHECKING:
    import networkx as nx

    from signature.database import SubmapDatabase


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionPair:
    """Two sessions that were compared. accepted : whether their join counts: the pair is joined, and neither
    labels nor the other pairs contradict it."""

    target: str
    source: str
    join: Join
    accepted: bool = False

    @property
    def names(self) -> tuple[str, str]:
        """Of the two sessions."""
        return self.target, self.source


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """What joining the sessions of a database found.

    pairs : all that were compared. frames : of the sessions that were joined with another one, by name.
    """

    pairs: tuple[SessionPair, ...]
    frames: Mapping[str, BuildingFrame]


def join_sessions(
    database: SubmapDatabase,
    *,
    frame: str | None = None,
    only: Collection[str] | None = None,
    journal: JoinJournal | None = None,
    compare: Compare | None = None,
    observer: Observer = Observer(),
) -> Joined:
    """Which sessions of a database show one building, and how they lie in its frame.

    frame : the session whose map frame is that of its building. None: the frame of those that were joined
    before, else of the session that was stored first. only : sessions that are joined, with the others and
    with each other; the others stay where they are. None: all are joined anew, which `frame` needs.
    journal : keeps what is compared, and knows what need not be compared again. compare : compares pairs, see
    `signature.localization.joining.comparing`; None: this process does. observer : gets the progress.

    Of many sessions, each is compared with those that look most like it (`candidates`), each pair once.
    Living maps stay where they are, and are compared in place of the sessions that retired for them.

    Raises DatabaseError for a name that no session has, and for a `frame` where there are living maps.
    """
    known = database.frames()
    asleep = {name: known[name] for name in retired(known)}
    living = {name for name, at in known.items() if at.role is SessionRole.LIVING}
    infos = {info.name: info for info in database.sessions() if info.name not in asleep}
    if living and frame is not None:
        raise DatabaseError(
            f"{database.location}: has living maps, which stay in the frames that they have",
            hint=f"`pc2grid db update --undo {database.location}` first",
        )
    for name in (*((frame,) if frame else ()), *(only or ())):
        if name not in infos:
            raise no_session(name, infos, database.location)
    if only is None and living:
        only = infos.keys() - living
    wanted = _wanted(database, infos, infos.keys() if only is None else only)
    compare = compare or functools.partial(compare_here, database)
    pairs = list(_compared(database, infos, wanted, journal, compare, observer))
    stay = {} if only is None else {n: at for n, at in known.items() if n in infos and n not in only}
    frames: dict[str, BuildingFrame] = dict(stay)
    accepted: set[tuple[str, str]] = set()
    for tree in _buildings(infos, pairs, stay):
        members = [name for name in infos if name in tree]
        anchor = _anchor(members, frame, stay if any(name in stay for name in members) else known)
        within = [p for p in pairs if p.join.status == "joined" and p.target in tree and p.source in tree]
        placed, counted = _placed(tree, anchor, within, stay)
        links = {pair.names: pair.join.links for pair in within if pair.names in counted}
        placed = {name: stay.get(name, frame) for name, frame in placed.items()}
        frames |= straighten(bodies_of(database, placed, stay), placed, links, placed.keys() & stay)
        accepted |= counted
    frames |= asleep
    return Joined(
        pairs=tuple(replace(pair, accepted=pair.names in accepted) for pair in pairs),
        frames={info.name: frames[info.name] for info in database.sessions() if info.name in frames},
    )


def _wanted(
    database: SubmapDatabase, infos: Mapping[str, SessionInfo], only: Collection[str]
) -> list[list[tuple[str, str]]]:
    """The pairs that may have to be compared, one of them at least of `only`, in rounds: of few sessions all
    at once, of many the likeliest of each session, then the next ones."""

    def comparable(a: str, b: str) -> bool:
        return not _told_apart(infos[a], infos[b])

    if len(infos) <= 1 + CANDIDATES.sessions:
        return [[(a, b) for a, b in combinations(infos, 2) if (a in only or b in only) and comparable(a, b)]]
    places = {name: LookedAt.of(database.seen_places(name)) for name in infos}
    found = candidates(places, only, comparable, CANDIDATES)
    number = {name: k for k, name in enumerate(infos)}
    rounds, known = [], set[tuple[str, str]]()
    for rank in range(CANDIDATES.sessions):
        each = [(name, others[rank]) for name, others in found.items() if rank < len(others)]
        pairs = {(a, b) if number[a] < number[b] else (b, a) for a, b in each} - known
        rounds.append(_along(pairs))
        known |= pairs
    return rounds


def _along(pairs: Collection[tuple[str, str]]) -> list[tuple[str, str]]:
    """The pairs in an order in which neighbours share a session, whose map is prepared once."""
    import networkx as nx

    graph = nx.Graph(sorted(pairs))
    place = {name: k for k, name in enumerate(nx.dfs_preorder_nodes(graph))}

    def reached(pair: tuple[str, str]) -> tuple[int, int]:
        first, last = sorted(place[name] for name in pair)
        return last, -first

    return sorted(pairs, key=reached)


def _settled(joined: nx.Graph, a: str, b: str) -> bool:
    """Whether two sessions lie in one building already, each by so many joins that another tells little.

    joined : the sessions that were joined, with an edge for each pair.
    """
    import networkx as nx

    enough = all(name in joined and joined.degree(name) >= CANDIDATES.enough for name in (a, b))
    return enough and nx.has_path(joined, a, b)


def _told_apart(a: SessionInfo, b: SessionInfo) -> bool:
    """Whether labels say that two sessions are not of one floor of one building."""
    one_recording = same_recording(a.name, b.name)
    return a.provenance.label.contradicts(b.provenance.label, one_recording=one_recording)


def _compared(
    database: SubmapDatabase,
    infos: Mapping[str, SessionInfo],
    rounds: Sequence[Sequence[tuple[str, str]]],
    journal: JoinJournal | None,
    compare: Compare,
    observer: Observer,
) -> Iterator[SessionPair]:
    """Each pair joined, as far as it can be and tells something new, by the rounds before its own: so it does
    not matter which pair of a round is compared first."""
    import networkx as nx

    joined = nx.Graph()
    done, total = 0, sum(map(len, rounds))
    with observer.step(f"compare {total} pairs of sessions"):
        for pairs in rounds:
            wanted = [pair for pair in pairs if len(rounds) == 1 or not _settled(joined, *pair)]
            done += len(pairs) - len(wanted)
            for (a, b), join in _joins(database, infos, wanted, journal, compare):
                if join.status == "joined":
                    joined.add_edge(a, b)
                yield SessionPair(target=a, source=b, join=join)
                done += 1
                observer.on_progress(done / total)


def _joins(
    database: SubmapDatabase,
    infos: Mapping[str, SessionInfo],
    pairs: Sequence[tuple[str, str]],
    journal: JoinJournal | None,
    compare: Compare,
) -> Iterator[tuple[tuple[str, str], Join]]:
    """The joins of pairs, in their order: of the journal if it has them, else compared and added to it."""
    wanted = [ToCompare(a, b, infos[a].provenance.label.agrees(infos[b].provenance.label)) for a, b in pairs]
    keys = [
        key_of(database.grid(pair.target), database.grid(pair.source), labelled=pair.labelled)
        for pair in wanted
        if journal is not None
    ]
    known = [None] * len(wanted) if journal is None else [journal.find(key) for key in keys]
    found = compare([pair for pair, join in zip(wanted, known, strict=True) if join is None])
    for k, join in enumerate(known):
        if join is None:
            join = next(found)
            if journal is not None:
                journal.add(keys[k], join)
        yield pairs[k], join


def _buildings(
    infos: Mapping[str, SessionInfo], pairs: Sequence[SessionPair], stay: Mapping[str, BuildingFrame]
) -> list[nx.Graph]:
    """The sessions of each building, two at least, as a tree of the surest pairs, its edges with `pair`."""
    import networkx as nx

    trees = nx.Graph()
    trees.add_nodes_from(infos)
    for first, second in combinations(stay, 2):
        if stay[first].name == stay[second].name:
            trees.add_edge(first, second)
    joined = [pair for pair in pairs if pair.join.status == "joined"]
    for pair in sorted(joined, key=lambda p: (-p.join.probability, -p.join.common_m2)):
        a, b = (nx.node_connected_component(trees, name) for name in (pair.target, pair.source))
        if pair.source in a or len({stay[name].name for name in a | b if name in stay}) > 1:
            continue
        if not any(_told_apart(infos[one], infos[other]) for one in a for other in b):
            trees.add_edge(pair.target, pair.source, pair=pair)
    return [trees.subgraph(members) for members in nx.connected_components(trees) if len(members) > 1]


def _anchor(
    members: Sequence[str], frame: str | None, known: Mapping[str, BuildingFrame]
) -> tuple[str, BuildingFrame]:
    """The session that stays where it is, and where that is."""
    joined = next((name for name in members if name in known), None)
    if joined is not None and frame not in members:
        return joined, known[joined]
    name = frame if frame is not None and frame in members else members[0]
    return name, BuildingFrame(name=name, T_building_session=SE2(), covariance=_rows(np.zeros((3, 3))))


def _placed(
    tree: nx.Graph,
    anchor: tuple[str, BuildingFrame],
    pairs: Sequence[SessionPair],
    stay: Mapping[str, BuildingFrame],
) -> tuple[dict[str, BuildingFrame], set[tuple[str, str]]]:
    """Where the sessions of a building lie, by all its pairs, and the names of those pairs that count."""
    import networkx as nx

    first, at = anchor
    poses = {first: at.T_building_session} | {n: stay[n].T_building_session for n in tree if n in stay}
    for a, b in nx.bfs_edges(tree, first):
        if b not in poses:
            pair = tree.edges[a, b]["pair"]
            T_target_source = pair.join.T_target_source
            poses[b] = poses[a] @ (T_target_source if pair.target == a else T_target_source.inverse())
    names = list(poses)
    edges = [
        Edge(
            names.index(pair.target),
            names.index(pair.source),
            pair.join.T_target_source,
            np.asarray(np.linalg.inv(pair.join.covariance), np.float64),
            loop=True,
        )
        for pair in pairs
    ]
    held = [
        Edge(0, names.index(n), poses[first].inverse() @ poses[n], HELD * np.eye(3))
        for n in stay
        if n in tree and n != first
    ]
    begin = np.array([(pose.x, pose.y, pose.yaw) for pose in poses.values()])
    solution = optimise(begin, [*held, *edges])
    counts = [
        fits or tree.has_edge(*pair.names)
        for pair, fits in zip(pairs, solution.accepted[len(held) :], strict=True)
    ]
    counted = [edge for edge, count in zip(edges, counts, strict=True) if count]
    covariances = _covariances(solution.poses, [*held, *counted])
    found = {
        name: BuildingFrame(
            name=at.name,
            T_building_session=pose_at(solution.poses, k),
            covariance=at.covariance if k == 0 else _rows(covariances[k - 1]),
        )
        for k, name in enumerate(names)
    }
    return found, {pair.names for pair, count in zip(pairs, counts, strict=True) if count}


def _covariances(poses: F64, edges: Sequence[Edge]) -> F64:
    """(N - 1, 3, 3) of all poses but the first, which stays where it is."""
    information = information_matrix(poses, edges).toarray()[3:, 3:]
    blocks = np.linalg.inv(information).reshape(len(poses) - 1, 3, len(poses) - 1, 3)
    diagonal = np.arange(len(poses) - 1)
    return np.asarray(blocks[diagonal, :, diagonal])


def _rows(covariance: F64) -> Covariance:
    rows = (0.5 * (covariance + covariance.T)).tolist()
    return cast(Covariance, tuple(tuple(row) for row in rows))


def floors_of(database: SubmapDatabase, frames: Mapping[str, BuildingFrame]) -> tuple[tuple[str, ...], ...]:
    """The joined sessions of each floor, its living map first, then the oldest. frames : of sessions, by
    name."""
    floors: dict[str, list[str]] = {}
    names = [info.name for info in database.sessions() if info.name in frames]
    for name in sorted(names, key=lambda name: frames[name].role is not SessionRole.LIVING):
        floors.setdefault(frames[name].name, []).append(name)
    return tuple(tuple(names) for names in floors.values())


def map_of(database: SubmapDatabase, session: str, frames: Mapping[str, BuildingFrame]) -> OccupancyGrid:
    """The map in whose frame answers in a session are: of its floor, or of the session alone.

    frames : of the sessions whose answers are in the frames of their buildings. A floor is drawn from all its
    sessions, see `signature.localization.joining.building_map`.
    """
    if session not in frames:
        return database.grid(session)
    floor = frames[session].name
    names = next(names for names in floors_of(database, frames) if frames[names[0]].name == floor)
    return building_map([(database.grid(name), frames[name]) for name in names])
