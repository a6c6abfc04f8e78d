"""Loop closure: a place that is seen again corrects the drift of tracking.

The session is cut into local maps of a few metres of travel. Each new local map is compared with older ones
that it may overlap: correlative scan matching over the uncertainty of tracking proposes poses, and those are
accepted at which the free space and the obstacles of both local maps agree. A robust pose graph over the
local maps gives the corrected poses (the scan-to-submap constraints of Hess et al., "Real-time loop closure
in 2D lidar SLAM", 2016, between two submaps). Between the anchors of local maps the correction is
interpolated, because the error of tracking grows gradually.

Loops that are farther off than the search window are found by a `PlaceRecognizer`, if one is given
(`pc2grid.mapping.stretches`).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator
from itertools import compress

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.config import ProjectionConfig
from pc2grid.estimation.point_to_line import evenly
from pc2grid.geometry import SE2
from pc2grid.mapping.building_axes import wall_direction
from pc2grid.mapping.keyframes import Keyframe, Keyframes
from pc2grid.mapping.local_maps import LOCAL_MAPS, LocalMapParameters, LocalMaps, pose_at
from pc2grid.mapping.loop_candidates import CANDIDATES, CandidateParameters, LoopCandidates
from pc2grid.mapping.loop_parameters import LOOPS, LoopParameters
from pc2grid.mapping.parts import connected
from pc2grid.mapping.place_recognition import PlaceRecognizer
from pc2grid.mapping.pose_graph import Edge, Solution
from pc2grid.mapping.session_graph import SessionGraph
from pc2grid.mapping.settled import SettledKeyframes, interpolate_corrections
from pc2grid.mapping.stretches import Stretches
from pc2grid.model import Loop


class LoopCloser:
    """Closes loops while a session is recorded.

    keyframes : gets those of the session; local maps are drawn from them when needed.
    recognizer : asked for every stretch of travel; None: loops are searched near the tracked pose only.
    projection : how the grids for the recognizer are drawn.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        *,
        recognizer: PlaceRecognizer | None = None,
        projection: ProjectionConfig = ProjectionConfig(),
        parameters: LoopParameters = LOOPS,
        local_map_parameters: LocalMapParameters = LOCAL_MAPS,
        candidate_parameters: CandidateParameters = CANDIDATES,
    ) -> None:
        self._parameters = parameters
        self._keyframes = keyframes
        self._local_maps = LocalMaps(keyframes, local_map_parameters)
        self._graph = SessionGraph(parameters)
        candidates = LoopCandidates(candidate_parameters)
        self._stretches = Stretches(
            self._local_maps, candidates, parameters.stretch_maps, recognizer, projection
        )
        self._travel_m = 0.0  # in the local map that is not complete yet
        self._travelled_m = array("d")  # at each local map; a lost part counts as `lost_m`
        self._drift_m = 0.0  # travel since the pose was last certain

    def add(self, keyframe: Keyframe) -> None:
        """Keep the next keyframe; every few metres this completes a local map."""
        if len(self._keyframes):
            step = self._keyframes.pose(len(self._keyframes) - 1).inverse() @ keyframe.T_session_base
            self._travel_m += math.hypot(step.x, step.y) + self._parameters.turn_m_per_rad * abs(step.yaw)
            if self._travel_m > self._parameters.travel_m or keyframe.restart:
                self._complete_local_map()
        self._keyframes.append(keyframe)

    def finish(self) -> SettledKeyframes:
        """The settled poses; without a loop and without walls they are the tracked ones."""
        if not len(self._keyframes):
            return SettledKeyframes.empty()
        self._complete_local_map()
        if self._stretches.finish():
            self._close_candidates()
        return self._settled_keyframes()

    # --- during the session -------------------------------------------------------------------------------

    def _complete_local_map(self) -> None:
        """The last keyframes become a local map: placed by tracking, then compared with older ones."""
        newest = len(self._graph)
        self._local_maps.complete()
        restart = self._local_maps.runs[newest].start in self._keyframes.restarts
        self._travel_m = 0.0
        self._place(newest, restart)
        overlaps = list(self._overlaps(newest))
        self._close(overlaps)
        # Overlaps with the local maps just before show nothing but that tracking is smooth.
        recent = newest - 2 * self._parameters.stretch_maps
        known = any(edge.first < recent for edge in overlaps)
        if self._stretches.extend(restart=restart, known=known):
            self._close_candidates()

    def _place(self, newest: int, restart: bool) -> None:
        """Add the newest local map to the pose graph, by tracking."""
        walls = wall_direction(self._local_maps[newest].normal_rad)
        pose = self._tracked(newest)
        if not newest:
            self._graph.add(pose, walls)
            self._travelled_m.append(0.0)
            return
        step = self._tracked(newest - 1).inverse() @ pose
        drift_m = self._parameters.lost_m if restart else math.hypot(step.x, step.y)
        self._drift_m += drift_m
        self._travelled_m.append(self._travelled_m[-1] + drift_m)
        shown = None if restart else self._local_maps[newest - 1].information(self._local_maps[newest], step)
        self._graph.extend(step, walls, shown)

    def _tracked(self, number: int) -> SE2:
        """The pose of a local map as tracked."""
        return self._keyframes.pose(self._local_maps.anchors[number])

    def _close(self, loops: list[Edge]) -> None:
        """Add loops to the pose graph, and solve it again."""
        if loops:
            self._drift_m *= 1.0 - max(loop.counts for loop in loops)
            self._graph.edges += loops
            self._graph.solve()

    def _overlaps(self, newest: int) -> Iterator[Edge]:
        """Verified overlaps of the newest local map with older ones, near its tracked pose."""
        window = self._parameters.window(self._drift_m)
        nodes = self._graph.nodes
        # The local map before the newest is left out: tracking matched both against the same walls.
        before = nodes[: max(newest - 1, 0), :2]
        distance_m = np.hypot(*(before - nodes[newest, :2]).T)
        near_m = self._parameters.near_m + window[0]
        for older in spread_over_visits(distance_m, near_m, self._parameters.compared):
            yield from self._compare(older, newest, self._graph.relative(older, newest), window)

    def _compare(self, older: int, newer: int, guess: SE2, window: tuple[float, float]) -> list[Edge]:
        """The measured relative pose of two local maps near a guess; none if they do not match.

        window : half widths of the search around the guess, metres and radians.
        """
        overlap = self._local_maps[older].overlap(self._local_maps[newer], guess, *window)
        if overlap is None:
            return []
        information = self._parameters.information_share * overlap.information
        return [Edge(older, newer, overlap.pose, information, loop=True, counts=overlap.counts)]

    # --- place recognition --------------------------------------------------------------------------------

    def _close_candidates(self) -> None:
        """Close the loops among the recognised places that drift allows and that agree with each other: those
        whose local maps match near where they were recognised."""
        p = self._parameters
        loops: list[Edge] = []
        for found in self._stretches.accepted(self._graph.nodes, np.array(self._travelled_m)):
            for older, newer, guess in self._stretches.guesses(found)[: p.compared_pairs]:
                loops += self._compare(older, newer, guess, (p.recognized_m, p.certain_rad))
        self._close(loops)
        if loops:
            # The newest stretch lies where it belongs now: what the search near the tracked pose missed is
            # near.
            self._close([edge for number in self._stretches.latest() for edge in self._overlaps(number)])

    # --- at the end of the session ------------------------------------------------------------------------

    def _settled_keyframes(self) -> SettledKeyframes:
        """Solve the pose graph; the poses, loops and parts that this gives."""
        solution = self._settle()
        scans, anchors = self._keyframes.scans, self._local_maps.anchors
        loops = tuple(
            Loop(
                older=scans[anchors[edge.first]],
                newer=scans[anchors[edge.second]],
                T_older_newer=edge.T_first_second,
                information=edge.information,
                accepted=bool(accepted),
            )
            for edge, accepted in zip(self._graph.edges, solution.accepted, strict=True)
            if edge.loop
        )
        part = self._parts(solution)
        lengths = [len(run) for run in self._local_maps.runs]
        return SettledKeyframes(
            scans=np.array(scans, dtype=np.int64),
            poses=self._settled(),
            loops=loops,
            segments=np.repeat(self._segments(), lengths),
            parts=np.repeat(part, lengths),
            anchors=np.array(anchors, dtype=np.int64),
            sigma_m=self._graph.sigmas(solution, part),
        )

    def _settle(self) -> Solution:
        """Solve the pose graph.

        The overlaps were measured on local maps that are as bent as tracking drifts. So these are drawn again
        with the poses that are found, and compared again.
        """
        self._graph.solve()
        self._local_maps.redraw(self._settled())
        self._graph.edges = [self._again(edge) if edge.loop else edge for edge in self._graph.edges]
        return self._graph.solve()

    def _again(self, edge: Edge) -> Edge:
        """An overlap as the local maps show it now; as it was if they no longer do."""
        guess = self._graph.relative(edge.first, edge.second)
        window = self._parameters.certain_m, self._parameters.certain_rad
        return next(iter(self._compare(edge.first, edge.second, guess, window)), edge)

    def _settled(self) -> F64:
        """Keyframe poses (K, 3) that follow the anchors of their local maps.

        The correction passes gradually from one anchor to the next. Where tracking was lost the error is a
        jump, so there each local map moves rigidly up to its end.
        """
        tracked = self._keyframes.poses()
        known: dict[int, SE2] = {}
        for number, run in enumerate(self._local_maps.runs):
            anchor = self._local_maps.anchors[number]
            correction = pose_at(self._graph.nodes, number) @ pose_at(tracked, anchor).inverse()
            restarts = self._keyframes.restarts
            ends = [k for k, at in ((run[0], run.start), (run[-1], run.stop)) if at in restarts]
            for k in sorted({anchor, *ends}):
                known[k] = correction @ pose_at(tracked, k)
        return interpolate_corrections(
            tracked, list(known), np.array([(p.x, p.y, p.yaw) for p in known.values()])
        )

    # --- segments and parts -------------------------------------------------------------------------------

    def _segments(self) -> I64:
        """(N,) number of the segment of each local map; a new one begins at each restart."""
        restarts = self._keyframes.restarts
        begins = [number > 0 and run.start in restarts for number, run in enumerate(self._local_maps.runs)]
        return np.cumsum(begins, dtype=np.int64)

    def _parts(self, solution: Solution) -> I64:
        """(N,) number of the part of each local map."""
        loops = [edge for edge in compress(self._graph.edges, solution.accepted) if edge.loop]
        return connected(self._segments(), loops)


def spread_over_visits(distance_m: F64, near_m: float, count: int) -> list[int]:
    """Which older local maps, `distance_m` (N,) away from the newest, to compare it with; `count` at most.

    A robot that drives up and down sees a place dozens of times. The nearest local map of the first visit,
    of the last and of some in between are chosen, so that the newest is connected to all visits.
    """
    near = np.flatnonzero(distance_m < near_m)
    if not len(near):
        return []
    visits = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    chosen = [visits[k] for k in evenly(len(visits), count)]
    nearest = [int(visit[np.argmin(distance_m[visit])]) for visit in chosen]
    others = [int(k) for k in near[np.argsort(distance_m[near], kind="stable")] if k not in nearest]
    return nearest + others[: count - len(nearest)]
