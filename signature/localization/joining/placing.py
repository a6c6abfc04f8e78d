"""Where sessions lie in their buildings, by the pairs that were joined.

Pairs are joined in the order of their probability (Kruskal's algorithm), so each building begins with what
is surest, and never two sessions into one building whose labels name different buildings or floors. Then one
pose graph over the sessions, each pair a robust edge, says where they lie, and how exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import compress, product
from typing import TYPE_CHECKING, cast

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.mapping.local_maps import pose_at
from pc2grid.mapping.pose_graph import Edge, information_matrix, optimise
from signature.database.protocol import BuildingFrame, Covariance, SessionInfo
from signature.localization.joining.pairing import Names, SessionPair, by_building, told_apart
from signature.localization.joining.straightening import HELD

if TYPE_CHECKING:
    import networkx as nx


def buildings_of(
    infos: Mapping[str, SessionInfo], joined: Sequence[SessionPair], stay: Mapping[str, BuildingFrame]
) -> list[nx.Graph]:
    """The sessions of each building, two at least, as a tree of the surest pairs, its edges with `pair`.

    stay : sessions that lie in buildings already, which stay apart; their edges have none.
    """
    import networkx as nx

    def two_buildings(a: str, b: str) -> bool:
        return told_apart(infos[a], infos[b]) or (a in stay and b in stay and stay[a].name != stay[b].name)

    trees = nx.Graph()
    trees.add_nodes_from(infos)
    for members in by_building(stay).values():
        nx.add_path(trees, members)
    for pair in sorted(joined, key=lambda p: (-p.join.probability, -p.join.common_m2)):
        a, b = (nx.node_connected_component(trees, name) for name in pair.names)
        if pair.source not in a and not any(two_buildings(*names) for names in product(a, b)):
            trees.add_edge(*pair.names, pair=pair)
    return [trees.subgraph(members) for members in nx.connected_components(trees) if len(members) > 1]


def anchor_of(
    members: Sequence[str],
    frame: str | None,
    known: Mapping[str, BuildingFrame],
    stay: Mapping[str, BuildingFrame],
) -> tuple[str, BuildingFrame]:
    """The session of a building that stays where it is, and where that is.

    frame : the session whose map frame is that of its building, if it is one of the `members`; else that of
    one that stays, or that was joined before, or the first one.
    """
    if frame is not None and frame in members:
        return frame, _frame_of(frame)
    first = min(members, key=lambda name: (name not in stay, name not in known))
    return first, known.get(first) or _frame_of(first)


def _frame_of(name: str) -> BuildingFrame:
    """The frame of a building that is that of a session."""
    return BuildingFrame(name=name, T_building_session=SE2(), covariance=_rows(np.zeros((3, 3))))


def place(
    tree: nx.Graph,
    anchor: tuple[str, BuildingFrame],
    joined: Sequence[SessionPair],
    stay: Mapping[str, BuildingFrame],
) -> tuple[dict[str, BuildingFrame], set[Names]]:
    """Where the sessions of a building lie, by all its joined pairs, and the names of those that count."""
    first, at = anchor
    poses = _along_tree(tree, anchor, stay)
    number = {name: k for k, name in enumerate(poses)}
    edges = [
        Edge(
            number[pair.target],
            number[pair.source],
            pair.join.T_target_source,
            np.asarray(np.linalg.inv(pair.join.covariance), np.float64),
            loop=True,
        )
        for pair in joined
    ]
    held = [
        Edge(0, number[name], poses[first].inverse() @ poses[name], HELD * np.eye(3))
        for name in list(poses)[1:]
        if name in stay
    ]
    solution = optimise(np.array([(T.x, T.y, T.yaw) for T in poses.values()]), [*held, *edges])
    fits = solution.accepted[len(held) :]
    counts = [bool(fit) or tree.has_edge(*pair.names) for pair, fit in zip(joined, fits, strict=True)]
    counted = list(compress(edges, counts))
    covariances = [at.covariance, *map(_rows, _covariances(solution.poses, [*held, *counted]))]
    found = {
        name: BuildingFrame(
            name=at.name, T_building_session=pose_at(solution.poses, k), covariance=covariances[k]
        )
        for name, k in number.items()
    }
    found |= {name: stay[name] for name in tree if name in stay}
    return found, {pair.names for pair in compress(joined, counts)}


def _along_tree(
    tree: nx.Graph, anchor: tuple[str, BuildingFrame], stay: Mapping[str, BuildingFrame]
) -> dict[str, SE2]:
    """Where the sessions of a building lie by its surest pairs alone, the anchor first."""
    import networkx as nx

    first, at = anchor
    poses = {first: at.T_building_session} | {n: stay[n].T_building_session for n in tree if n in stay}
    for a, b in nx.bfs_edges(tree, first):
        if b not in poses:
            pair = tree.edges[a, b]["pair"]
            T_target_source = pair.join.T_target_source
            poses[b] = poses[a] @ (T_target_source if pair.target == a else T_target_source.inverse())
    return poses


def _covariances(poses: F64, edges: Sequence[Edge]) -> F64:
    """(N - 1, 3, 3) of all poses but the first, which stays where it is."""
    information = information_matrix(poses, edges).toarray()[3:, 3:]
    blocks = np.linalg.inv(information).reshape(len(poses) - 1, 3, len(poses) - 1, 3)
    diagonal = np.arange(len(poses) - 1)
    return np.asarray(blocks[diagonal, :, diagonal])


def _rows(covariance: F64) -> Covariance:
    rows = (0.5 * (covariance + covariance.T)).tolist()
    return cast(Covariance, tuple(tuple(row) for row in rows))
