"""All sessions of a database joined: pairs of sessions become buildings with one frame each.

1. Every two sessions are compared (`signature.join.join`).
2. Pairs are taken in the order of their probability (Kruskal's algorithm), so each building begins with what
   is surest, and never two sessions in one building whose labels name different buildings or floors. Then one
   pose graph over the sessions, each pair a robust edge, gives where they lie, and how exactly
   (`solve_frames`).
3. One pose graph over all that the sessions have measured gives how they are bent: what one of them knows
   straightens another one (`straighten`). A session is the graph that it was mapped by, the steps of its way
   and its own loops, in a frame of its own (the anchors of Kim et al., "Multiple relative pose graphs for
   robust cooperative mapping", ICRA 2010). At the poses that it was drawn with its graph is at rest, so it
   resists every bend as much as it has measured: a session with many loops is stiff, and one that drifts is
   soft. Maps without a way, and sessions that are to stay where they are, are rigid.
4. The maps of a building are drawn as one: what stands there now (`building_map`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, product
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2, hand_over, lever_arm, wrap_angle
from pc2grid.libraries import one_blas_thread
from pc2grid.model import (
    FREE,
    FREE_BELOW,
    OCCUPIED_FROM,
    THING,
    UNKNOWN,
    Health,
    Loop,
    OccupancyGrid,
    Precision,
    Trajectory,
)
from pc2grid.observer import Observer
from signature.database.database import SubmapDatabase, no_session
from signature.database.protocol import (
    BuildingFrame,
    Covariance,
    Deformation,
    SessionInfo,
    by_building,
    largest_m,
)
from signature.join.join import (
    Link,
    Names,
    SessionPair,
    compare_pairs,
)
from signature.session.graph import Edge, information_matrix, optimise
from signature.session.local_maps import pose_at
from signature.session.loops import LOOPS
from signature.session.quality import position_sigmas

if TYPE_CHECKING:
    import networkx as nx


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """What joining the sessions of a database found.

    pairs : all that were compared. frames : of the sessions that were joined with another one, by name.
    """

    pairs: tuple[SessionPair, ...]
    frames: Mapping[str, BuildingFrame]


@one_blas_thread
def join_sessions(
    database: SubmapDatabase,
    *,
    frame: str | None = None,
    only: Collection[str] | None = None,
    observer: Observer = Observer(),
) -> Joined:
    """Find which sessions of a database show one building, and how they lie in its frame.

    frame : the session whose map frame is that of its building. None: the frame of those that were joined
    before, else of the session that was stored first. only : sessions that are joined, with the others and
    with each other; the others stay where they are. None: all are joined anew, which `frame` needs.
    observer : gets the progress.

    Every two sessions are compared, so the time grows with the square of their number.

    Raises DatabaseError for a name that no session has.
    """
    known = database.frames()
    infos = {info.name: info for info in database.sessions()}
    for name in {*(only or ()), *(() if frame is None else (frame,))} - infos.keys():
        raise no_session(name, infos, database.location)
    moving = infos.keys() if only is None else only
    stay = {name: at for name, at in known.items() if name in infos and name not in moving}
    pairs = list(compare_pairs(database, infos, moving, observer))
    joined = [pair for pair in pairs if pair.join.status == "joined"]
    frames = dict(stay)
    accepted: set[Names] = set()
    for tree in buildings_of(infos, joined, stay):
        anchor = anchor_of([name for name in infos if name in tree], frame, known, stay)
        placed, counted = _lying(database, tree, anchor, joined, stay)
        frames |= placed
        accepted |= counted
    return Joined(
        pairs=tuple(replace(pair, accepted=pair.names in accepted) for pair in pairs),
        frames={name: frames[name] for name in infos if name in frames},
    )


def _lying(
    database: SubmapDatabase,
    tree: nx.Graph,
    anchor: tuple[str, BuildingFrame],
    joined: Sequence[SessionPair],
    stay: Mapping[str, BuildingFrame],
) -> tuple[dict[str, BuildingFrame], set[Names]]:
    """Return how the sessions of one building lie and are bent, and the names of the pairs that count."""
    within = [pair for pair in joined if pair.target in tree and pair.source in tree]
    placed, counted = solve_frames(tree, anchor, within, stay)
    links = {pair.names: pair.join.links for pair in within if pair.names in counted}
    return straighten(bodies_of(database, placed, stay), placed, links, placed.keys() & stay), counted


def buildings_of(
    infos: Mapping[str, SessionInfo], joined: Sequence[SessionPair], stay: Mapping[str, BuildingFrame]
) -> list[nx.Graph]:
    """Return the sessions of each building, two at least, as a tree of the surest pairs; edges have `pair`.

    stay : sessions that lie in buildings already, which stay apart; their edges have none.
    """
    import networkx as nx

    def two_buildings(a: str, b: str) -> bool:
        label, other = infos[a].provenance.label, infos[b].provenance.label
        return label.contradicts(other) or (a in stay and b in stay and stay[a].name != stay[b].name)

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
    """Return the session of a building that stays where it is, and where that is.

    frame : the session whose map frame is that of its building, if it is one of the `members`; else that of
    one that stays, or that was joined before, or the first one.
    """
    if frame is not None and frame in members:
        return frame, _frame_of(frame)
    first = min(members, key=lambda name: (name not in stay, name not in known))
    return first, known.get(first) or _frame_of(first)


def _frame_of(name: str) -> BuildingFrame:
    """Return the frame of a building that has the frame of a session."""
    return BuildingFrame(name=name, T_building_session=SE2(), covariance=_rows(np.zeros((3, 3))))


def solve_frames(
    tree: nx.Graph,
    anchor: tuple[str, BuildingFrame],
    joined: Sequence[SessionPair],
    stay: Mapping[str, BuildingFrame],
) -> tuple[dict[str, BuildingFrame], set[Names]]:
    """Return where the sessions of a building lie by all its joined pairs, and which of these count."""
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
    """Place the sessions of a building by its surest pairs alone, the anchor first."""
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
    """Return the covariances (N - 1, 3, 3) of all poses but the first, which stays where it is."""
    information = information_matrix(poses, edges).toarray()[3:, 3:]
    blocks = np.linalg.inv(information).reshape(len(poses) - 1, 3, len(poses) - 1, 3)
    diagonal = np.arange(len(poses) - 1)
    return np.asarray(blocks[diagonal, :, diagonal])


def _rows(covariance: F64) -> Covariance:
    rows = (0.5 * (covariance + covariance.T)).tolist()
    return cast(Covariance, tuple(tuple(row) for row in rows))


HELD = 1e10
"""Information (1/m^2, 1/rad^2) that holds sessions where they are that were joined before."""
_LEAST_M = 0.05
"""A bend that moves no place further is left out: a cell of a map, and more than most pieces are off."""
_LEAST_SIGMA_M = 0.005
"""No map is more exact than a tenth of a cell."""


@dataclass(frozen=True, slots=True)
class SessionBody:
    """A session as a part of the pose graph. nodes : (N, 3) poses of its way, in its map. edges : between
    them, at rest."""

    nodes: F64
    edges: tuple[Edge, ...] = ()


RIGID = SessionBody(np.zeros((1, 3)))
"""A session that nothing can bend: one node, at the origin of its map."""


def body_of(trajectory: Trajectory, loops: Sequence[Loop], precision: Precision | None) -> SessionBody:
    """Return the graph of a session over the local maps whose precision is known.

    Its steps and loops say how stiff its parts are to each other. As a whole it is as stiff as its precision
    says.
    """
    if precision is None or len(precision.stamps_ns) < 2 or len(trajectory) < 2:
        return RIGID
    closed = [loop for loop in loops if loop.accepted]
    ends = [end for loop in closed for end in (loop.older, loop.newer)]
    mapped = np.searchsorted(trajectory.stamps_ns, precision.stamps_ns).clip(max=len(trajectory) - 1)
    scans = np.unique([*mapped.tolist(), *ends])
    nodes = trajectory.planar()[scans]
    number = {scan: k for k, scan in enumerate(scans.tolist())}
    lengths_m = np.diff(trajectory.path_m()[scans]).tolist()
    measured = [
        (k, k + 1, LOOPS.tracked_information(length_m, restart=Health.LOST in trajectory.health[a : b + 1]))
        for k, (length_m, a, b) in enumerate(zip(lengths_m, scans, scans[1:], strict=False))
    ]
    measured += [(number[loop.older], number[loop.newer], loop.information) for loop in closed]
    edges = [
        Edge(a, b, pose_at(nodes, a).inverse() @ pose_at(nodes, b), information)
        for a, b, information in measured
    ]
    variance = float(np.square(position_sigmas(nodes, edges)).mean())
    known = float(np.square(np.maximum(precision.sigma_m, _LEAST_SIGMA_M)).mean())
    return SessionBody(
        nodes, tuple(replace(edge, information=variance / known * edge.information) for edge in edges)
    )


def bodies_of(
    database: SubmapDatabase, names: Collection[str], held: Collection[str]
) -> dict[str, SessionBody]:
    """Return the graphs of sessions. held : those that stay as they are."""
    found = dict.fromkeys(names, RIGID)
    for info in database.sessions([name for name in names if name not in held]):
        found[info.name] = body_of(database.trajectory(info.name), database.loops(info.name), info.precision)
    return found


def straighten(
    bodies: Mapping[str, SessionBody],
    frames: Mapping[str, BuildingFrame],
    links: Mapping[tuple[str, str], Sequence[Link]],
    held: Collection[str] = (),
) -> dict[str, BuildingFrame]:
    """Solve for where the sessions of a building lie, and how they are bent there, by all that they measured.

    bodies : of the sessions. frames : where they lie as they were drawn; the first stays there, on an average
    over its way. links : of a target and a source, by their names. held : rigid ones that stay, too.

    Sessions that would hardly be bent (`_LEAST_M`) are rigid, and the others are solved for again. If none is
    bent, the frames stay as they are.
    """
    while not all(body is RIGID for body in bodies.values()):
        found = _lying_straight(bodies, frames, _solved(bodies, frames, links, held), held)
        straight = {name for name, body in bodies.items() if body is not RIGID and not found[name].bend}
        if not straight:
            return found
        bodies = {name: RIGID if name in straight else body for name, body in bodies.items()}
    return dict(frames)


def _solved(
    bodies: Mapping[str, SessionBody],
    frames: Mapping[str, BuildingFrame],
    links: Mapping[tuple[str, str], Sequence[Link]],
    held: Collection[str],
) -> dict[str, F64]:
    """Solve for the poses (N, 3) of the nodes of each session in the building; the very first stays."""
    counts = [len(bodies[name].nodes) for name in frames]
    first = dict(zip(frames, np.cumsum([0, *counts]).tolist(), strict=False))
    T_first_building = frames[next(iter(frames))].T_building_session.inverse()
    within = [(name, name, edge) for name in frames for edge in bodies[name].edges]
    between = [
        (a, b, _edge(link, bodies[a], bodies[b], frames[a], frames[b]))
        for (a, b), found in links.items()
        for link in found
    ]
    edges = [
        Edge(0, first[name], T_first_building @ frames[name].T_building_session, HELD * np.eye(3))
        for name in held
        if first[name]
    ]
    edges += [
        replace(edge, first=edge.first + first[a], second=edge.second + first[b])
        for a, b, edge in (*within, *between)
    ]
    begin = []
    for name, frame in frames.items():
        T, nodes = frame.T_building_session, bodies[name].nodes
        begin.append(np.column_stack((T.apply(nodes[:, :2]), nodes[:, 2] + T.yaw)))
    poses = optimise(np.concatenate(begin), edges).poses
    return dict(zip(frames, np.split(poses, np.cumsum(counts)[:-1]), strict=True))


def _lying_straight(
    bodies: Mapping[str, SessionBody],
    frames: Mapping[str, BuildingFrame],
    solved: Mapping[str, F64],
    held: Collection[str],
) -> dict[str, BuildingFrame]:
    """Divide the solved poses of nodes into where each session lies and how it is bent.

    The first session lies where it lay, and `held` are as they were.
    """
    T = {name: _placement(bodies[name].nodes, poses) for name, poses in solved.items()}
    first = next(iter(frames))
    T_building_solved = frames[first].T_building_session @ T[first].inverse()
    found = dict(frames)
    for name in frames.keys() - set(held):
        at = frames[first].T_building_session if name == first else T_building_solved @ T[name]
        bend = _bend(bodies[name].nodes, solved[name], T[name])
        found[name] = replace(frames[name], T_building_session=at, bend=bend)
    return found


def _edge(
    link: Link, target: SessionBody, source: SessionBody, in_target: BuildingFrame, in_source: BuildingFrame
) -> Edge:
    """Return the edge that a piece of the source makes between the two nodes that are nearest to it.

    The frames tell how sessions that stay are bent already. The piece was found wherever the poses are, so
    that they disagree with it is no evidence against it.
    """
    x, y = link.center_m
    there = link.T_target_source @ SE2(x, y)
    a, b = _nearest(target, there.x, there.y), _nearest(source, x, y)
    T_straight_target = in_target.T_building_session.inverse() @ in_target.at(there.x, there.y)
    T_straight_source = in_source.T_building_session.inverse() @ in_source.at(x, y)
    T_target_source = T_straight_target @ link.T_target_source @ T_straight_source.inverse()
    T_target_a, T_target_b = pose_at(target.nodes, a), T_target_source @ pose_at(source.nodes, b)
    # The covariance is that of the piece at its middle: at the node, its turn moves it as well.
    turned = SE2(0.0, 0.0, -T_target_a.yaw).matrix() @ lever_arm(there, T_target_b)
    information = np.linalg.inv(turned @ link.covariance @ turned.T)
    T_a_b = T_target_a.inverse() @ T_target_b
    return Edge(a, b, T_a_b, np.asarray(information), loop=True)


def _nearest(body: SessionBody, x_m: float, y_m: float) -> int:
    """Return the node that is nearest to a place of the session's map."""
    return int(np.argmin(np.hypot(body.nodes[:, 0] - x_m, body.nodes[:, 1] - y_m)))


def _placement(nodes: F64, solved: F64) -> SE2:
    """Return where a session lies, on an average over its nodes."""
    turned = solved[:, 2] - nodes[:, 2]
    yaw = math.atan2(float(np.sin(turned).sum()), float(np.cos(turned).sum()))
    x, y = (solved[:, :2] - SE2(0.0, 0.0, yaw).apply(nodes[:, :2])).mean(axis=0).tolist()
    return SE2(x, y, yaw)


def _bend(nodes: F64, solved: F64, T: SE2) -> Deformation:
    """Return how a session is bent where it lies at T: a row for each square of its way, none if hardly.

    A square is as wide as a local map is long.
    """
    moved = np.column_stack((T.inverse().apply(solved[:, :2]) - nodes[:, :2], solved[:, 2] - nodes[:, 2]))
    moved[:, 2] = wrap_angle(moved[:, 2] - T.yaw)
    _, square = np.unique(np.floor(nodes[:, :2] / LOOPS.travel_m), axis=0, return_inverse=True)
    count = np.bincount(square.ravel())
    columns = [
        np.bincount(square.ravel(), weights=values) / count for values in (nodes[:, 0], nodes[:, 1], *moved.T)
    ]
    bend: Deformation = tuple(
        (x, y, dx, dy, yaw) for x, y, dx, dy, yaw in np.column_stack(columns).round(4).tolist()
    )
    return bend if largest_m(bend) >= _LEAST_M else ()


_SQUARE_M = 1.0
"""Side of the squares for which a bend is computed."""


def building_map(maps: Sequence[tuple[OccupancyGrid, BuildingFrame]]) -> OccupancyGrid:
    """Draw the maps of sessions, oldest first, each with where it lies, as one in the building's frame.

    Cells are as large as those of the first map. Each has the value of the newest map that is sure of its
    centre (free, occupied, or a thing); where none is sure, of the oldest that knows it.
    Raises ValueError without a map.

    >>> import pc2grid
    >>> from pc2grid import SE2
    >>> plan = pc2grid.load_map("map.yaml")
    >>> exact = ((0.0, 0.0, 0.0),) * 3
    >>> frame = BuildingFrame(name="x", T_building_session=SE2(10.0, 0.0, 0.0), covariance=exact)
    >>> moved = building_map([(plan, frame)])
    >>> round(moved.free_m2 / plan.free_m2, 2), round(moved.origin_m[0] - plan.origin_m[0], 2)
    (1.0, 10.0)
    """
    whole = _around(maps)
    cells = whole.cells.copy()
    for grid, frame in maps:
        at = whole.to_cell(_corners(grid, frame))
        low, high = at.min(axis=0).clip(min=0), at.max(axis=0).clip(max=np.array(cells.shape) - 1)
        rows, columns = np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)
        there_m = _as_drawn(frame, whole, rows, columns).reshape(-1, 2)
        told = grid.look_up(grid.cells, there_m, UNKNOWN).reshape(len(rows), len(columns))
        here = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        sure = (told >= OCCUPIED_FROM) | (told == THING) | ((told >= FREE) & (told < FREE_BELOW))
        chosen = sure | ((told != UNKNOWN) & (here == UNKNOWN))
        here[chosen] = told[chosen]
    return replace(whole, cells=hand_over(cells))


def _around(maps: Sequence[tuple[OccupancyGrid, BuildingFrame]]) -> OccupancyGrid:
    """Return a grid of unknown cells that holds all maps."""
    if not maps:
        raise ValueError("a building without a map")
    cell_m = maps[0][0].resolution_m
    corners_m = np.concatenate([_corners(grid, frame) for grid, frame in maps])
    low = np.floor(corners_m.min(axis=0) / cell_m + 1e-6)
    width, height = (np.ceil(corners_m.max(axis=0) / cell_m - 1e-6) - low).astype(int).tolist()
    x, y = (low * cell_m).tolist()
    heights_m = {grid.height_m for grid, _ in maps}
    return OccupancyGrid(
        cells=np.full((height, width), UNKNOWN, np.int8),
        resolution_m=cell_m,
        origin_m=(float(x), float(y)),
        height_m=None if None in heights_m else float(np.mean([grid.height_m for grid, _ in maps])),
    )


def _corners(grid: OccupancyGrid, frame: BuildingFrame) -> F64:
    """Return the corners (4, 2) of a map, wherever it is bent to, in the building."""
    height, width = grid.cells.shape
    around_m = largest_m(frame.bend)
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64) * grid.resolution_m
    outwards = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)]) * around_m
    return frame.T_building_session.apply(corners + grid.origin_m + outwards)


def _as_drawn(
    frame: BuildingFrame, whole: OccupancyGrid, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> F64:
    """Return where the centres of cells of a building (R, C, 2) lie in the map of a session.

    A bend changes little from cell to cell: it is inverted for the middles of large squares, and in between
    it is interpolated.
    """
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    T_session_building = frame.T_building_session.inverse()
    straight_m = T_session_building.apply(whole.to_point(at.reshape(-1, 2))).reshape(at.shape)
    if not frame.bend:
        return straight_m
    n = max(1, round(_SQUARE_M / whole.resolution_m))
    middle = (n - 1) / 2
    squares = np.stack(np.meshgrid(rows[::n] + middle, columns[::n] + middle, indexing="ij"), axis=-1)
    points_m = whole.to_point(squares.reshape(-1, 2))
    bent_m = (frame.to_session(points_m) - T_session_building.apply(points_m)).reshape(squares.shape)
    height, width = squares.shape[:2]
    return straight_m + cv2.resize(bent_m, (n * width, n * height))[: len(rows), : len(columns)]


def floors_of(database: SubmapDatabase, frames: Mapping[str, BuildingFrame]) -> tuple[tuple[str, ...], ...]:
    """Return the joined sessions of each floor, the oldest first. frames : of sessions, by name."""
    joined = {info.name: frames[info.name] for info in database.sessions() if info.name in frames}
    return tuple(map(tuple, by_building(joined).values()))


def map_of(database: SubmapDatabase, session: str, frames: Mapping[str, BuildingFrame]) -> OccupancyGrid:
    """Return the map in whose frame answers in a session are: of its floor, or of the session alone.

    frames : of the sessions whose answers are in the frames of their buildings. A floor is drawn from all its
    sessions, see `building_map`.
    """
    if session not in frames:
        return database.grid(session)
    floor = frames[session].name
    names = next(names for names in floors_of(database, frames) if frames[names[0]].name == floor)
    return building_map([(database.grid(name), frames[name]) for name in names])
