"""Maps, and recordings during the work on them, in the rerun viewer or in `.rrd` files; needs the extra viz.

Entities: map/walls, map/grid (if rerun has GridMap), map/points (if the session has them), map/submaps,
map/ways, map/path, map/loops, map/base. While a recording is converted, map/live holds the scans at their
tracked poses, before loops are closed. While a recording is located, query/live holds the same at the pose of
the best hypothesis, and query/confidence its confidence. At the end query/path, query/hypotheses and
query/base follow, and for each hypothesis query/evidence/1, 2, ... with the query's walls, coloured by what
the map says about them, and the map's walls where the query saw free ground; of these the first is shown. The
timeline `time` has the time of the recording.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.geometry import SE2, quat_xyzw_from_pose, transform_points
from pc2grid.io.atomic import replace_file
from pc2grid.matching.agreement import Support
from pc2grid.model import Health
from pc2grid.observer import Observer
from pc2grid_cli import console
from pc2grid_cli.picture import (
    BLUE,
    GREEN,
    MISSED_COLOUR,
    ORANGE,
    PURPLE,
    SUPPORT_COLOURS,
    VERMILLION,
    YELLOW,
    agreements,
)
from pc2grid_cli.rerun_layout import CONFIDENCE, GRAPH, GRID, LOOPS, layout
from pc2grid_cli.rerun_target import VIEWER, require_rerun, url_of

if TYPE_CHECKING:
    import networkx as nx

    from pc2grid.arrays import F32, F64
    from pc2grid.model import Loop, OccupancyGrid, PointMap, RegisteredScan, SessionMap, Trajectory
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer, Moment

_COLOURS = {"fine": VERMILLION, "overruled": YELLOW, "degenerate": ORANGE, "lost": PURPLE}
"""Of a scan, by its health."""
_MOST_POINTS = 4000
"""Points of a scan that are sent at most, so that a remote viewer can keep up; chosen by hand."""
_KEPT_EVERY_M = 1.0
"""A scan stays visible after so much travel; chosen by hand."""
_BELOW_M = 0.05
"""The grid lies so far below the floor, so that walls and paths are seen on it; chosen by hand."""
_EVIDENCE_RADIUS_M, _ABOVE_M = 0.06, 0.1
"""Of the points of the evidence: half of their distance; from above they cover the walls of the map."""
_FLUSH_S = 10.0
"""How long to wait for the viewer at the end; chosen by hand."""


@contextlib.contextmanager
def stream_to(target: str, name: str) -> Iterator[Any]:
    """A recording that a viewer shows while it grows, or a file if the block ends without an error."""
    url = url_of(target)
    # With an id given by the name, the same data opens as the same recording each time.
    stream = require_rerun().RecordingStream("pc2grid", recording_id=name if url is None else None)
    with contextlib.ExitStack() as stack:
        if url is None:
            stream.save(stack.enter_context(replace_file(target)))
        elif target == VIEWER:
            stream.spawn()
        else:
            stream.connect_grpc(url)
        stream.send_recording_name(name)
        try:
            yield stream
        finally:
            try:
                stream.flush(timeout_sec=_FLUSH_S)
            except Exception as error:  # its class differs between versions of rerun
                console.warn(f"rerun: not all of {name} has arrived: {error}")
            stream.disconnect()


def write_session(target: str, database: SubmapDatabase, session: str) -> None:
    """A session's map, submaps, path and loops."""
    with stream_to(target, session) as recording:
        recording.send_blueprint(layout(database.grid(session)))
        _log_stored(recording, database, session)
        _log_moving(recording, "map/base", database.trajectory(session), BLUE)


class Conversions(Observer):
    """Shows recordings as they are converted, and then their maps: one rerun recording for each session."""

    def __init__(self, target: str) -> None:
        self._target = target
        self._stack = contextlib.ExitStack()
        self._session = ""
        self._name: str | None = None

    def on_session(self, name: str) -> None:
        """The following scans belong to the session of this name."""
        self._session = name

    def on_scan(self, registered: RegisteredScan) -> None:
        """The next scan."""
        self._begin(self._session)
        self._live.add(registered)

    def show(self, session: SessionMap, config: Config) -> None:
        """The finished map of a session."""
        self._begin(session.session)
        self._live.end()
        self._recording.send_blueprint(layout(session.grid))
        centers = np.array([submap.center_m for submap in session.submaps]).reshape(-1, 2)
        _log_map(self._recording, session.grid, centers, session.graph, session.trajectory, session.loops)
        _log_points(self._recording, session.points)
        _log_moving(self._recording, "map/base", session.trajectory, BLUE)

    def _begin(self, name: str) -> None:
        if name != self._name:
            self._stack.close()
            self._recording = self._stack.enter_context(stream_to(self._target, name))
            self._recording.send_blueprint(layout(None))
            self._live = _Live(self._recording, "map/live")
            self._name = name

    def __enter__(self) -> Conversions:
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.__exit__(*error)


class Search:
    """Shows a recording while it is located in a database, and the answer."""

    def __init__(self, recording: Any, database: SubmapDatabase) -> None:
        self._recording, self._database = recording, database
        self._live = _Live(recording, "query/live")
        self._shown: str | None = None
        self._placed = False
        sessions = database.sessions()
        if len(sessions) == 1:
            self._show(sessions[0].name)

    def watch(self, registered: RegisteredScan, moment: Moment | None) -> None:
        """The next scan, and the state of the answer if the database was searched after it."""
        rr = require_rerun()
        if moment is not None:
            _set_time(self._recording, moment.stamp_ns)
            self._recording.log(CONFIDENCE, rr.Scalars(moment.confidence))
            if moment.session is not None and moment.pose is not None:
                self._show(moment.session)
                self._live.move(moment.pose @ SE2.from_matrix(registered.T_session_base).inverse())
                self._placed = True
        if self._placed:
            self._live.add(registered)

    def show(self, answer: Answer, located: Trajectory | None) -> None:
        """The answer; `located` are the poses of the query in the map, None unless it was located."""
        if not answer.hypotheses:
            return
        rr = require_rerun()
        session = answer.sessions[answer.hypotheses[0].session_index]
        self._show(session)
        self._live.end()
        self._show_evidence(answer, session)
        poses = [hypothesis.fit.T_map_query @ answer.T_odom_base for hypothesis in answer.hypotheses]
        here = [answer.sessions[h.session_index] == session for h in answer.hypotheses]
        places = [(pose.x, pose.y, 0.0) for pose, shown in zip(poses, here, strict=True) if shown]
        spots = rr.Points3D(places, colors=_rgb(PURPLE), radii=0.2)
        self._recording.log("query/hypotheses", spots, static=True)
        if located is not None:
            way = rr.LineStrips3D([located.T_session_base[:, :3, 3]], colors=_rgb(PURPLE))
            self._recording.log("query/path", way, static=True)
            _log_moving(self._recording, "query/base", located, PURPLE)

    def _show_evidence(self, answer: Answer, session: str) -> None:
        """Per hypothesis in this session, best first, what supports and what contradicts it."""
        rr = require_rerun()
        colours = {int(kind): _rgb(SUPPORT_COLOURS[kind.name])[0] for kind in Support}
        entities = []
        for number, (hypothesis, compared) in enumerate(
            zip(answer.hypotheses, agreements(answer, self._database), strict=True), start=1
        ):
            if answer.sessions[hypothesis.session_index] != session:
                continue
            entities.append(f"query/evidence/{number}")
            points = _lift(hypothesis.fit.T_map_query.apply(compared.points_m), _ABOVE_M)
            said = [colours[kind] for kind in compared.support.tolist()]
            walls = rr.Points3D(points, colors=said, radii=_EVIDENCE_RADIUS_M)
            self._recording.log(f"{entities[-1]}/walls", walls, static=True)
            missed = rr.Points3D(
                _lift(compared.missed_m, _ABOVE_M), colors=_rgb(MISSED_COLOUR), radii=_EVIDENCE_RADIUS_M
            )
            self._recording.log(f"{entities[-1]}/missed", missed, static=True)
        grid = self._database.grid(session)
        self._recording.send_blueprint(layout(grid, has_query=True, hidden=entities[1:]))

    def _show(self, session: str) -> None:
        """Show the map of one session at a time, because each has a frame of its own."""
        if session != self._shown:
            self._recording.send_blueprint(layout(self._database.grid(session), has_query=True))
            _log_stored(self._recording, self._database, session)
            self._shown = session


class _Live:
    """Scans at their tracked poses: the latest one, and one for each metre of the path."""

    def __init__(self, recording: Any, entity: str) -> None:
        self._recording, self._entity = recording, entity
        self._way: list[F64] = []
        self._driven_m, self._kept = 0.0, 0

    def move(self, T_map_odom: SE2) -> None:
        """Move all scans to this pose of their frame in the map."""
        T = T_map_odom.lift()
        transform = require_rerun().Transform3D(translation=T[:3, 3], quaternion=quat_xyzw_from_pose(T))
        self._recording.log(self._entity, transform)

    def add(self, registered: RegisteredScan) -> None:
        """The next scan."""
        rr = require_rerun()
        scan, T = registered.scan, registered.T_session_base
        _set_time(self._recording, scan.stamp_ns)
        step = -(-len(scan.points_m) // _MOST_POINTS) or 1
        points = transform_points(T, scan.points_m[::step])
        colour = _COLOURS[registered.health.value]
        self._recording.log(f"{self._entity}/scan", rr.Points3D(points, colors=_rgb(colour), radii=0.03))
        ahead = rr.Arrows3D(origins=[T[:3, 3]], vectors=[0.5 * T[:3, 0]], colors=_rgb(colour), radii=0.06)
        self._recording.log(f"{self._entity}/base", ahead)
        if self._way:
            self._driven_m += float(np.linalg.norm(T[:2, 3] - self._way[-1][:2]))
        self._way.append(T[:3, 3])
        if registered.health is not Health.LOST and (self._driven_m >= _KEPT_EVERY_M or not self._kept):
            place = f"{self._entity}/seen/{self._kept}"
            self._recording.log(f"{place}/way", rr.LineStrips3D([self._way], colors=_rgb(BLUE)))
            self._recording.log(f"{place}/points", rr.Points3D(points, colors=_rgb("#999999"), radii=0.02))
            self._way, self._driven_m, self._kept = self._way[-1:], 0.0, self._kept + 1

    def end(self) -> None:
        """Clear the live entities; the final map replaces them."""
        self._recording.log(self._entity, require_rerun().Clear(recursive=True))


def _set_time(recording: Any, stamp_ns: int) -> None:
    recording.set_time("time", timestamp=np.datetime64(stamp_ns, "ns"))


def _log_stored(recording: Any, database: SubmapDatabase, session: str) -> None:
    """Show the stored map of a session."""
    table = database.signatures(session)
    _log_map(
        recording,
        database.grid(session),
        table.center_m,
        database.graph(session),
        database.trajectory(session),
        database.loops(session),
    )
    _log_points(recording, database.points(session))


def _log_points(recording: Any, points: PointMap | None) -> None:
    """Show the points in space, if a session has them, coloured by height."""
    rr = require_rerun()
    if points is None:
        recording.log("map/points", rr.Clear(recursive=True), static=True)
        return
    at = points.points_m()
    low, high = np.quantile(at[:, 2], (0.02, 0.98))
    share = np.clip((at[:, 2] - low) / max(high - low, 1e-3), 0.0, 1.0)
    colors = np.column_stack((80 + 150 * share, 120 + 60 * share, 200 - 120 * share)).astype(np.uint8)
    shown = rr.Points3D(at.astype(np.float32), colors=colors, radii=points.voxel_m / 2)
    recording.log("map/points", shown, static=True)


def _log_map(
    recording: Any,
    grid: OccupancyGrid,
    centers_m: F64,
    graph: nx.Graph,
    trajectory: Trajectory,
    loops: Sequence[Loop],
) -> None:
    rr = require_rerun()
    walls = _lift(grid.to_point(np.argwhere(grid.occupied)))
    ways = [_lift(np.array([graph.nodes[n]["center_m"] for n in edge])) for edge in graph.edges]
    path = trajectory.T_session_base[:, :3, 3]
    closed = [path[[loop.older, loop.newer]] for loop in loops if loop.accepted]
    thin = rr.Radius.ui_points(0.75)
    for entity, shown in (
        ("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP),
        ("map/walls", rr.Points3D(walls, colors=_rgb("#AAAAAA"), radii=grid.resolution_m / 2)),
        ("map/submaps", rr.Points3D(_lift(centers_m), colors=_rgb(GREEN), radii=0.12)),
        (GRAPH, rr.LineStrips3D(ways, colors=_rgb("#999999"), radii=thin)),
        ("map/path", rr.LineStrips3D([path], colors=_rgb(BLUE), radii=thin)),
        (LOOPS, rr.LineStrips3D(closed, colors=_rgb(YELLOW), radii=thin)),
    ):
        recording.log(entity, shown, static=True)
    if hasattr(rr, "GridMap"):
        recording.log(GRID, _grid_map(grid), static=True)


def _grid_map(grid: OccupancyGrid) -> Any:
    """The occupancy grid with the colours of RViz. The image begins with the row of the largest y."""
    rr = require_rerun()
    rows, columns = grid.cells.shape
    return rr.GridMap(
        data=grid.cells[::-1].tobytes(),
        format=rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U8"),
        cell_size=grid.resolution_m,
        translation=[*grid.origin_m, -_BELOW_M],
        colormap=rr.components.Colormap.RvizMap,
    )


def _log_moving(recording: Any, entity: str, poses: Trajectory, color: str) -> None:
    """The base over time, as an arrow of half a metre."""
    rr = require_rerun()
    if not len(poses):
        return
    recording.log(entity, rr.Arrows3D(vectors=[[0.5, 0.0, 0.0]], colors=_rgb(color), radii=0.06), static=True)
    recording.send_columns(
        entity,
        indexes=[rr.TimeColumn("time", timestamp=poses.stamps_ns.astype("datetime64[ns]"))],
        columns=rr.Transform3D.columns(
            translation=poses.T_session_base[:, :3, 3],
            quaternion=[quat_xyzw_from_pose(T) for T in poses.T_session_base],
        ),
    )


def _lift(points_m: F32 | F64, z_m: float = 0.0) -> F64:
    """Points (N, 2) as (N, 3) at one height."""
    return np.column_stack((points_m, np.full(len(points_m), z_m)))


def _rgb(color: str) -> list[tuple[int, ...]]:
    """A colour "#RRGGBB" as rerun takes it, for all parts of an entity."""
    return [tuple(bytes.fromhex(color[1:]))]
