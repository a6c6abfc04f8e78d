"""One pose graph over the sessions of a building: what one of them knows straightens another one.

A session is the graph that it was mapped by, the steps of its way and its own loops, in a frame of its own
(the anchors of Kim et al., "Multiple relative pose graphs for robust cooperative mapping", ICRA 2010). At the
poses that it was drawn with its graph is at rest, so it resists every bend as much as it has measured: a
session with many loops is stiff, and one that drifts is soft. Sessions are linked by the pieces of one that
were found in the map of another one (`pieces`). Maps without a way, and sessions that are to stay where they
are, are rigid.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.mapping.local_maps import pose_at
from pc2grid.mapping.loop_parameters import LOOPS
from pc2grid.mapping.pose_graph import Edge, optimise
from pc2grid.mapping.precision import position_sigmas
from pc2grid.model import Health, Loop, Precision, Trajectory
from signature.bend import Bend, largest_m
from signature.database.protocol import BuildingFrame
from signature.localization.joining.pieces import Link

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

HELD = 1e10
"""Information (1/m^2, 1/rad^2) that holds sessions where they are that were joined before."""
_LEAST_M = 0.05
"""A bend that moves no place further is left out: a cell of a map, and more than most pieces are off."""
_LEAST_SIGMA_M = 0.005
"""No map is more exact than a tenth of a cell."""


@dataclass(frozen=True, slots=True)
class SessionBody:
    """A session as a part of the pose graph. nodes : (N, 3) poses of its way, in its map; one, at the origin,
    if it is rigid. edges : between them, at rest."""

    nodes: F64
    edges: tuple[Edge, ...] = ()

    @property
    def rigid(self) -> bool:
        """Whether nothing can bend it."""
        return len(self.nodes) == 1


RIGID = SessionBody(np.zeros((1, 3)))


def body_of(trajectory: Trajectory, loops: Sequence[Loop], precision: Precision | None) -> SessionBody:
    """The graph of a session over the local maps that its precision is known of.

    Its steps and loops say how stiff its parts are to each other. As a whole it is as stiff as its precision
    says, which knows also what the local maps show of each step.
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
        (k, k + 1, LOOPS.tracked_information(length_m, restart=_lost(trajectory, *scans[k : k + 2])))
        for k, length_m in enumerate(lengths_m)
    ]
    measured += [(number[loop.older], number[loop.newer], loop.information) for loop in closed]
    edges = [
        Edge(a, b, pose_at(nodes, a).inverse() @ pose_at(nodes, b), information)
        for a, b, information in measured
    ]
    variance = float(np.square(position_sigmas(nodes, edges)[0]).mean())
    known = float(np.square(np.maximum(precision.sigma_m, _LEAST_SIGMA_M)).mean())
    return SessionBody(
        nodes, tuple(replace(edge, information=variance / known * edge.information) for edge in edges)
    )


def _lost(trajectory: Trajectory, begin: int, end: int) -> bool:
    """Whether tracking was lost from one scan to another."""
    return Health.LOST in trajectory.health[begin : end + 1]


def bodies_of(
    database: SubmapDatabase, names: Collection[str], held: Collection[str]
) -> dict[str, SessionBody]:
    """The graphs of sessions. held : those that stay as they are."""
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
    """Where the sessions of a building lie, and how they are bent there, by all that they know.

    bodies : of the sessions. frames : where they lie as they were drawn; the first stays there, on an average
    over its way. links : of a target and a source, by their names. held : rigid ones that stay, too.

    Sessions that would hardly be bent (`_LEAST_M`) are rigid, and the others are solved for again. If none is
    bent, the frames stay as they are.
    """
    while not all(body.rigid for body in bodies.values()):
        found = _lying(bodies, frames, _solved(bodies, frames, links, held), held)
        straight = {name for name, body in bodies.items() if not body.rigid and not found[name].bend}
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
    """The poses (N, 3) of the nodes of each session in the building; the first node of all stays."""
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
    begin = np.concatenate([_moved(frames[name].T_building_session, bodies[name].nodes) for name in frames])
    poses = optimise(begin, edges).poses
    return dict(zip(frames, np.split(poses, np.cumsum(counts)[:-1]), strict=True))


def _lying(
    bodies: Mapping[str, SessionBody],
    frames: Mapping[str, BuildingFrame],
    solved: Mapping[str, F64],
    held: Collection[str],
) -> dict[str, BuildingFrame]:
    """Where sessions lie, and how they are bent, by the poses of their nodes; the first one lies where it
    lay, and `held` are as they were."""
    T = {name: _placement(bodies[name].nodes, poses) for name, poses in solved.items()}
    first = next(iter(frames))
    T_building_solved = frames[first].T_building_session @ T[first].inverse()
    found = dict(frames)
    for name in frames.keys() - set(held):
        at = frames[first].T_building_session if name == first else T_building_solved @ T[name]
        bend = _bend(bodies[name].nodes, solved[name], T[name])
        found[name] = replace(frames[name], T_building_session=at, bend=bend)
    return found


def _moved(T: SE2, poses: F64) -> F64:
    """Poses (N, 3), each x, y, yaw, in another frame."""
    return np.column_stack((T.apply(poses[:, :2]), poses[:, 2] + T.yaw))


def _edge(
    link: Link, target: SessionBody, source: SessionBody, in_target: BuildingFrame, in_source: BuildingFrame
) -> Edge:
    """What a piece of the source says of the two nodes that are nearest to it.

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
    J = np.eye(3)
    J[:2, 2] = there.y - T_target_b.y, T_target_b.x - there.x
    turned = SE2(0.0, 0.0, -T_target_a.yaw).matrix() @ J
    information = np.linalg.inv(turned @ link.covariance @ turned.T)
    T_a_b = T_target_a.inverse() @ T_target_b
    return Edge(a, b, T_a_b, np.asarray(information), loop=True)


def _nearest(body: SessionBody, x_m: float, y_m: float) -> int:
    """The node that is nearest to a place of the session's map."""
    return int(np.argmin(np.hypot(body.nodes[:, 0] - x_m, body.nodes[:, 1] - y_m)))


def _placement(nodes: F64, solved: F64) -> SE2:
    """Where a session lies, on an average over its nodes."""
    turned = solved[:, 2] - nodes[:, 2]
    yaw = math.atan2(float(np.sin(turned).sum()), float(np.cos(turned).sum()))
    x, y = (solved[:, :2] - SE2(0.0, 0.0, yaw).apply(nodes[:, :2])).mean(axis=0).tolist()
    return SE2(x, y, yaw)


def _bend(nodes: F64, solved: F64, T: SE2) -> Bend:
    """How a session is bent where it lies at T: a row for each square of its way, as wide as a local map is
    long; none if hardly."""
    moved = np.column_stack((T.inverse().apply(solved[:, :2]) - nodes[:, :2], solved[:, 2] - nodes[:, 2]))
    moved[:, 2] = wrap_angle(moved[:, 2] - T.yaw)
    _, square = np.unique(np.floor(nodes[:, :2] / LOOPS.travel_m), axis=0, return_inverse=True)
    count = np.bincount(square.ravel())
    columns = [
        np.bincount(square.ravel(), weights=values) / count for values in (nodes[:, 0], nodes[:, 1], *moved.T)
    ]
    bend: Bend = tuple(
        (x, y, dx, dy, yaw) for x, y, dx, dy, yaw in np.column_stack(columns).round(4).tolist()
    )
    return bend if largest_m(bend) >= _LEAST_M else ()
