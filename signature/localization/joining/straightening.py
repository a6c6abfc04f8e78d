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
from typing import TYPE_CHECKING, cast

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.mapping.local_maps import pose_at
from pc2grid.mapping.loop_parameters import CAMERA_LOOPS, LOOPS, LoopParameters
from pc2grid.mapping.pose_graph import Edge, optimise
from pc2grid.model import Health, Loop, SensorKind, Trajectory
from pc2grid.sensor_model import SENSOR_MODELS
from signature.bend import SPACING_M, Bend, largest_m
from signature.database.protocol import BuildingFrame
from signature.localization.hypotheses import HYPOTHESES
from signature.localization.joining.pieces import Link

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

HELD = 1e10
"""Information (1/m^2, 1/rad^2) that holds sessions where they are that were joined before."""
_LEAST_SHARE = 0.05
"""Of the travel of a local map, that a step between two nodes counts as at least."""


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


def body_of(trajectory: Trajectory, loops: Sequence[Loop], parameters: LoopParameters = LOOPS) -> SessionBody:
    """The graph of a session: a node for each local map of its way and each end of a loop."""
    if len(trajectory) < 2:
        return RIGID
    path_m = trajectory.path_m()
    begun = np.unique(np.floor(path_m / parameters.travel_m), return_index=True)[1]
    closed = [loop for loop in loops if loop.accepted]
    ends = [end for loop in closed for end in (loop.older, loop.newer)]
    scans = np.unique([*begun.tolist(), *ends, len(trajectory) - 1])
    nodes = trajectory.planar()[scans]
    number = {scan: k for k, scan in enumerate(scans.tolist())}

    def at_rest(first: int, second: int, information: F64) -> Edge:
        T_first_second = pose_at(nodes, first).inverse() @ pose_at(nodes, second)
        return Edge(first, second, T_first_second, information)

    steps = [
        at_rest(k, k + 1, information)
        for k, information in enumerate(_of_steps(trajectory, scans, np.diff(path_m[scans]), parameters))
    ]
    measured = [at_rest(number[loop.older], number[loop.newer], loop.information) for loop in closed]
    return SessionBody(nodes, (*steps, *measured))


def _of_steps(trajectory: Trajectory, scans: I64, length_m: F64, parameters: LoopParameters) -> list[F64]:
    """The information (3, 3) of each step between two of the scans: that of tracking over a local map, for
    its share of the travel of one."""
    lost = np.cumsum([0, *(health is Health.LOST for health in trajectory.health)])
    lost = lost if trajectory.health else np.zeros(len(trajectory) + 1)
    share = np.maximum(length_m / parameters.travel_m, _LEAST_SHARE)
    return [
        parameters.tracked_information(parameters.travel_m, restart=bool(lost[b + 1] > lost[a])) / part
        for a, b, part in zip(scans[:-1], scans[1:], share, strict=True)
    ]


def bodies_of(
    database: SubmapDatabase, names: Collection[str], held: Collection[str]
) -> dict[str, SessionBody]:
    """The graphs of sessions. held : those that stay as they are."""
    found = dict.fromkeys(names, RIGID)
    for info in database.sessions([name for name in names if name not in held]):
        if info.sensor != "map":
            parameters = CAMERA_LOOPS if SENSOR_MODELS[cast(SensorKind, info.sensor)].narrow else LOOPS
            found[info.name] = body_of(database.trajectory(info.name), database.loops(info.name), parameters)
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
    """
    anchor, *others = frames
    counts = [len(bodies[name].nodes) for name in frames]
    first = dict(zip(frames, np.cumsum([0, *counts]).tolist(), strict=False))
    within = [
        replace(edge, first=edge.first + first[name], second=edge.second + first[name])
        for name in frames
        for edge in bodies[name].edges
    ]
    T_anchor_building = frames[anchor].T_building_session.inverse()
    staying = [
        Edge(0, first[name], T_anchor_building @ frames[name].T_building_session, HELD * np.eye(3))
        for name in others
        if name in held
    ]
    between = [
        replace(edge, first=edge.first + first[a], second=edge.second + first[b])
        for (a, b), found in links.items()
        for edge in (_edge(link, bodies[a], bodies[b], frames[a], frames[b]) for link in found)
    ]
    begin = np.concatenate([_moved(frames[name].T_building_session, bodies[name].nodes) for name in frames])
    poses = optimise(begin, [*within, *staying, *between]).poses
    solved = dict(zip(frames, np.split(poses, np.cumsum(counts)[:-1]), strict=True))
    T = {name: _placement(bodies[name].nodes, solved[name]) for name in frames}
    T_building_solved = frames[anchor].T_building_session @ T[anchor].inverse()
    return {
        name: frame
        if name in held
        else replace(
            frame,
            T_building_session=frame.T_building_session if name == anchor else T_building_solved @ T[name],
            bend=_bend(bodies[name].nodes, solved[name], T[name]),
        )
        for name, frame in frames.items()
    }


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
    return Edge(a, b, T_a_b, np.asarray(information), loop=True, recognized=True)


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
    """How a session is bent where it lies at T: a row for each square of its way; none if a map cannot show
    as little."""
    moved = np.column_stack((T.inverse().apply(solved[:, :2]) - nodes[:, :2], solved[:, 2] - nodes[:, 2]))
    moved[:, 2] = wrap_angle(moved[:, 2] - T.yaw)
    _, square = np.unique(np.floor(nodes[:, :2] / SPACING_M), axis=0, return_inverse=True)
    count = np.bincount(square.ravel())
    columns = [
        np.bincount(square.ravel(), weights=values) / count for values in (nodes[:, 0], nodes[:, 1], *moved.T)
    ]
    bend: Bend = tuple(
        (x, y, dx, dy, yaw) for x, y, dx, dy, yaw in np.column_stack(columns).round(4).tolist()
    )
    return bend if largest_m(bend) >= HYPOTHESES.map_m else ()
