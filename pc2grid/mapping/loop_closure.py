"""Loop closure: a place that is seen again corrects the drift of tracking.

The session is cut into local maps of a few metres of travel. Each new local map is compared with older ones
that it may overlap: correlative scan matching over the uncertainty of tracking proposes poses, and those are
accepted at which the free space and the obstacles of both local maps agree. A robust pose graph over the
local maps gives the corrected poses (the scan-to-submap constraints of Hess et al., "Real-time loop closure
in 2D lidar SLAM", 2016, between two submaps). Between the anchors of local maps the correction is
interpolated, because the error of tracking grows gradually.

Loops that are farther off than the search window are found by a `PlaceRecognizer`, if one is given.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.config import ProjectionConfig
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.mapping.building_axes import WallDirection, wall_direction
from pc2grid.mapping.keyframes import Keyframe, Keyframes
from pc2grid.mapping.local_maps import LOCAL_MAPS, LocalMap, LocalMapParameters, LocalMaps, pose_at
from pc2grid.mapping.loop_candidates import CANDIDATES, Candidate, CandidateParameters, LoopCandidates
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.mapping.parts import PARTS, PartParameters, conflicts_of, connected, cuts_for
from pc2grid.mapping.place_recognition import PlaceRecognizer, Stretch
from pc2grid.mapping.pose_graph import Edge, Solution, optimise
from pc2grid.mapping.precision import position_sigmas
from pc2grid.model import Loop
from pc2grid.odometry.point_to_line import Match, evenly


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopParameters:
    """Numbers of loop closure. Chosen by hand and checked on the relations of fr079 and intel, unless noted.

    Cutting into local maps:

    travel_m : travel after which a local map is complete.
    turn_m_per_rad : travel that a turn on the spot counts as.

    Which pairs are compared:

    near_m : older local maps within this distance may overlap the newest one.
    compared : older local maps that the newest is compared with. With 6 instead of 10, walls by laser and
        camera became a little less sharp.

    How far is searched: as far as tracking may have drifted since the pose was last certain.

    certain_m, certain_rad : the window directly after a loop.
    drift_per_m, drift_rad_per_m : growth of the window per metre of travel.
    max_window_m, max_window_rad : its largest size.
    lost_m : travel that a lost stretch counts as; enough for the largest window.

    Which poses are accepted:

    search_points : points of each local map that are compared.
    min_observed, min_observed_back : at least this share of the points of one local map must lie in cells
        that the other one observed; the larger and the smaller of the two directions.
    min_agreement : share of those that must meet an obstacle instead of free space, in both directions.
    rival_m, rival_agreement : another pose, farther away than this, that agrees less by no more than this
        makes the overlap ambiguous; it is then left out.

    What they count in the pose graph:

    information_share : of the information that a match reports: the errors of points on one wall are
        correlated.
    tracking_sigma_m, tracking_sigma_per_m : standard deviation of a tracked step, constant and per metre.
    tracking_sigma_rad, tracking_sigma_rad_per_m : the same of its yaw: 0.45 degrees over 4 m. Tracking is off
        by 0.05 to 0.2 degrees RMS in simulation and by 0.3 at most in real logs (killian, whose truth adds
        its own error). With 0.9 degrees loops bent what lies between: killian 0.72 m RMS instead of 0.49.
    lost_sigma_m, lost_sigma_rad : the same where tracking was lost in between.
    shown_share : of the information in the match of two consecutive local maps, for the precision of a
        tracked step. Fitted to the drift of tracking over 4, 12 and 30 local maps on csail, fr079, intel,
        killian, acapulco, belgioioso, orebro and simulated drives (`examples/consistency.md`).

    When work is saved or repeated:

    unmoved_m, unmoved_rad : a loop that confirms the present poses this well does not start an optimisation.
    bent_m, bent_rad : a local map whose ends moved this much against each other is drawn and compared again.
    redraws : at most this often.

    Place recognition:

    stretch_maps : consecutive local maps that make a stretch: 12 m of travel, with which loops were found on
        aces, csail and killian.
    min_probability : recognitions that are less probable are left out.
    recognized_m, recognized_rad : window of the comparison that confirms a recognition.
    compared_pairs : pairs of local maps of the two stretches that are compared at most.
    """

    travel_m: float = 4.0
    turn_m_per_rad: float = 0.3
    near_m: float = 8.0
    compared: int = 10
    certain_m: float = 0.3
    certain_rad: float = math.radians(4.0)
    drift_per_m: float = 0.02
    drift_rad_per_m: float = 0.006
    max_window_m: float = 3.0
    max_window_rad: float = math.radians(20.0)
    lost_m: float = 150.0
    search_points: int = 400
    min_observed: float = 0.35
    min_observed_back: float = 0.15
    min_agreement: float = 0.8
    rival_m: float = 0.5
    rival_agreement: float = 0.05
    information_share: float = 0.1
    tracking_sigma_m: float = 0.02
    tracking_sigma_per_m: float = 0.01
    tracking_sigma_rad: float = math.radians(0.25)
    tracking_sigma_rad_per_m: float = math.radians(0.05)
    lost_sigma_m: float = 1.5
    lost_sigma_rad: float = math.radians(60.0)
    shown_share: float = 1.0
    unmoved_m: float = 0.1
    unmoved_rad: float = math.radians(1.0)
    bent_m: float = 0.01
    bent_rad: float = math.radians(0.2)
    redraws: int = 2
    stretch_maps: int = 3
    min_probability: float = 0.5
    recognized_m: float = 0.4
    recognized_rad: float = math.radians(4.0)
    compared_pairs: int = 4

    def window(self, drift_m: float) -> tuple[float, float]:
        """Half widths of the search window, metres and radians, after `drift_m` of travel."""
        return (
            min(self.certain_m + self.drift_per_m * drift_m, self.max_window_m),
            min(self.certain_rad + self.drift_rad_per_m * drift_m, self.max_window_rad),
        )

    def tracked_information(self, length_m: float, restart: bool) -> F64:
        """Information (3, 3) of a tracked step between anchors; restart: tracking was lost in between."""
        sigma_m = self.tracking_sigma_m + self.tracking_sigma_per_m * length_m
        sigma_rad = self.tracking_sigma_rad + self.tracking_sigma_rad_per_m * length_m
        if restart:
            sigma_m, sigma_rad = self.lost_sigma_m, self.lost_sigma_rad
        return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])


LOOPS = LoopParameters()
CAMERA_LOOPS = LoopParameters(
    tracking_sigma_m=0.01,
    tracking_sigma_per_m=0.003,
    tracking_sigma_rad=math.radians(0.15),
    tracking_sigma_rad_per_m=math.radians(0.04),
)
"""For a depth camera. Two of its local maps often show a place from two sides, so that its loops are less
exact than its tracking. Measured in csail, simulated: over 4 m tracking is off by 1.0 cm and 0.16 degrees
(RMS). Loops are off by 1.1 cm and 0.13 degrees (median), but one in ten by 20 cm or 8 degrees. The numbers
are about twice those of tracking. The maps of lasers and lidars get worse with them (intel 0.068 m RMS
instead of 0.062)."""


@dataclass(frozen=True, slots=True)
class SettledKeyframes:
    """The poses of a session's keyframes after loop closure.

    scans : (K,) number of each keyframe's scan. poses : (K, 3) x, y, yaw of each in the session's frame.
    loops : between the scans at the anchors of local maps that overlap.
    segments : (K,) number of the segment of each; a new one begins where the pose relative to the keyframe
        before is unknown. parts : (K,) number of the part of each: segments that loops join. Poses of
        different parts have nothing to do with each other; see `pc2grid.mapping.parts`.
    anchors : (N,) numbers, in `scans`, of the keyframes at the anchors of the local maps.
    sigma_m : (N,) standard deviation of the position of each of these within its part, in the least certain
        direction; see `pc2grid.mapping.precision`.
    """

    scans: I64
    poses: F64
    loops: tuple[Loop, ...]
    segments: I64
    parts: I64
    anchors: I64
    sigma_m: F64

    def undivided(self) -> SettledKeyframes:
        """The same, as if nothing in it were unknown."""
        together = np.zeros(len(self.scans), np.int64)
        return replace(self, segments=together, parts=together)


class LoopCloser:
    """Closes loops while a session is recorded; of a keyframe it keeps only the pose.

    keyframes : of the session; local maps are drawn from them when needed.
    recognizer : asked for every stretch of travel; None: loops are searched near the tracked pose only.
    projection : how the grids for the recognizer are drawn; None: the defaults.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        *,
        recognizer: PlaceRecognizer | None = None,
        projection: ProjectionConfig | None = None,
        parameters: LoopParameters = LOOPS,
        local_map_parameters: LocalMapParameters = LOCAL_MAPS,
        candidate_parameters: CandidateParameters = CANDIDATES,
        part_parameters: PartParameters = PARTS,
    ) -> None:
        self._parameters = parameters
        self._part_parameters = part_parameters
        self._local_maps = LocalMaps(keyframes, local_map_parameters)
        self._recognizer = recognizer
        self._projection = projection or ProjectionConfig()
        self._stretches: list[range] = []  # the local maps of each
        self._candidates = LoopCandidates(candidate_parameters)
        self._known_places: list[bool] = []  # whether each local map overlaps one of an earlier visit
        self._stretch_begin = 0  # first local map of the stretch that is not complete yet
        self._scans = array("q")
        self._storeys = array("q")  # of each keyframe
        self._poses = array("d")  # as tracked: x, y, yaw of one keyframe after the other
        self._begin = 0  # first keyframe of the local map that is not complete yet
        self._travel_m = 0.0
        self._restarts: set[int] = set()  # first keyframes after tracking was lost, or after a cut
        self._nodes = np.empty((0, 3))  # settled poses of the anchors of the local maps
        self._edges: list[Edge] = []
        self._walls: list[WallDirection] = []  # of each local map
        # Of each tracked step, by its local maps: how exactly these determine it.
        self._shown: dict[tuple[int, int], F64] = {}
        self._drift_m = 0.0  # travel since the pose was last certain
        self._travelled_m = array("d")  # at each local map; a lost part counts as `lost_m`

    def extend(self, keyframe: Keyframe, storey: int = 0) -> None:
        """Take the keyframe that was appended last; every few metres this completes a local map.

        storey : number of the floor; loops are closed only within a floor, however alike two floors look. It
        changes only with a keyframe that restarts.
        """
        number = len(self._scans)
        pose = keyframe.T_session_base
        if number:
            step = SE2(*self._poses[-3:]).inverse() @ pose
            self._travel_m += math.hypot(step.x, step.y) + self._parameters.turn_m_per_rad * abs(step.yaw)
            if self._travel_m > self._parameters.travel_m or keyframe.restart:
                self._complete_local_map()
        if keyframe.restart:
            self._restarts.add(number)
        self._scans.append(keyframe.index)
        self._storeys.append(storey)
        self._poses.extend((pose.x, pose.y, pose.yaw))

    def finish(self) -> SettledKeyframes:
        """The settled poses; without a loop and without walls they are the tracked ones."""
        if not self._scans:
            none = np.empty(0, np.int64)
            return SettledKeyframes(
                none, np.empty((0, 3)), (), segments=none, parts=none, anchors=none, sigma_m=np.empty(0)
            )
        self._complete_local_map()
        if self._recognizer is not None and self._stretch_begin < len(self._nodes):
            # The last local maps make a stretch that may overlap the one before.
            last = len(self._nodes) - 1
            begin = max(last + 1 - self._parameters.stretch_maps, 0)
            while self._storey(begin) != self._storey(last):
                begin += 1
            if not all(self._known_places[begin:]):
                self._recognize(range(begin, len(self._nodes)))
        return self._settled_keyframes()

    def divide(self, doubtful: Sequence[range]) -> SettledKeyframes | None:
        """After `finish`: cut the session where its local maps contradict each other, and settle it again.

        doubtful : scans of the stretches that contradict the map of their part.
        A cut leaves open how its two sides lie to each other, as a restart of tracking does, so that loops
        which the tracked poses ruled out may join them again. Loops between segments that contradict each
        other are removed. Returns None if there is nothing to change.
        """
        scans, runs = np.array(self._scans), self._local_maps.runs
        suspect = np.array(
            [
                any(scans[run[0]] < stretch.stop and scans[run[-1]] >= stretch.start for stretch in doubtful)
                for run in runs
            ]
        )
        segment = self._segments()
        part = self._parts(optimise(self._nodes, self._edges, self._walls))
        conflicts = list(conflicts_of(self._local_maps, self._nodes, part, suspect, self._part_parameters))
        cuts = set(cuts_for(conflicts, segment))
        between = [(segment[c.older], segment[c.newer]) for c in conflicts if c.mutual]
        apart = {(first, second) for first, second in between if first != second}
        kept = [e for e in self._edges if not e.loop or (segment[e.first], segment[e.second]) not in apart]
        if not cuts and len(kept) == len(self._edges):
            return None
        self._edges = kept
        parameters = self._parameters
        for k, edge in enumerate(self._edges):
            if not edge.loop and edge.second in cuts:
                self._edges[k] = replace(edge, information=parameters.tracked_information(0.0, restart=True))
                self._shown.pop((edge.first, edge.second), None)
        lost_m = parameters.lost_m * np.cumsum([number in cuts for number in range(len(runs))])
        self._travelled_m = array("d", np.array(self._travelled_m) + lost_m)
        self._restarts |= {runs[cut].start for cut in cuts}
        self._close_candidates()
        known = {(edge.first, edge.second) for edge in self._edges}
        for cut in sorted(cuts):
            self._drift_m = parameters.lost_m
            self._close(
                [
                    edge
                    for number in range(cut, min(cut + parameters.stretch_maps, len(runs)))
                    for edge in self._overlaps(number)
                    if (edge.first, edge.second) not in known
                ]
            )
        return self._settled_keyframes()

    def _segments(self) -> I64:
        """(N,) number of the segment of each local map; a new one begins at each restart or cut."""
        begins = [
            number > 0 and run.start in self._restarts for number, run in enumerate(self._local_maps.runs)
        ]
        return np.cumsum(begins, dtype=np.int64)

    def _parts(self, solution: Solution) -> I64:
        """(N,) number of the part of each local map."""
        accepted = [
            edge for edge, kept in zip(self._edges, solution.accepted, strict=True) if edge.loop and kept
        ]
        return connected(self._segments(), accepted, self._part_parameters)

    def _settled_keyframes(self) -> SettledKeyframes:
        """Solve the pose graph; the poses, loops and parts that this gives."""
        solution = self._settle()
        loops = tuple(
            Loop(
                older=self._scans[self._local_maps.anchor(edge.first)],
                newer=self._scans[self._local_maps.anchor(edge.second)],
                T_older_newer=edge.T_first_second,
                information=edge.information,
                accepted=bool(accepted),
            )
            for edge, accepted in zip(self._edges, solution.accepted, strict=True)
            if edge.loop
        )
        part = self._parts(solution)
        lengths = [len(run) for run in self._local_maps.runs]
        return SettledKeyframes(
            scans=np.array(self._scans, dtype=np.int64),
            poses=self._settled(),
            loops=loops,
            segments=np.repeat(self._segments(), lengths),
            parts=np.repeat(part, lengths),
            anchors=np.array([self._local_maps.anchor(k) for k in range(len(lengths))], dtype=np.int64),
            sigma_m=self._sigmas(solution, part),
        )

    def _sigmas(self, solution: Solution, part: I64) -> F64:
        """Standard deviation (N,) in metres of the position of each local map within its part (N,).

        In the pose graph a tracked step counts as exact as it is wherever tracking works at all. How exact a
        step is by what its local maps show of each other is added here.
        """
        sigma_m = np.zeros(len(part))
        accepted = [edge for edge, kept in zip(self._edges, solution.accepted, strict=True) if kept]
        for number in range(int(part.max(initial=-1)) + 1):
            own = np.flatnonzero(part == number)
            position = {int(local_map): k for k, local_map in enumerate(own)}
            within = [
                replace(
                    edge,
                    first=position[edge.first],
                    second=position[edge.second],
                    information=edge.information + self._shown.get((edge.first, edge.second), 0.0),
                )
                for edge in accepted
                if edge.first in position and edge.second in position
            ]
            walls = [self._walls[local_map] for local_map in own]
            sigma_m[own] = position_sigmas(solution.poses[own], within, walls)[0]
        return sigma_m

    # --- during the session -------------------------------------------------------------------------------

    def _complete_local_map(self) -> None:
        """The last keyframes become a local map: placed by tracking, then compared with older ones."""
        self._local_maps.append(range(self._begin, len(self._scans)))
        restart = self._begin in self._restarts
        self._begin, self._travel_m = len(self._scans), 0.0
        newest = len(self._nodes)
        self._walls.append(wall_direction(self._local_maps[newest].normal_rad))
        tracked = self._tracked()
        pose = pose_at(tracked, self._local_maps.anchor(newest))
        travelled_m = 0.0
        if newest > 0:
            step = pose_at(tracked, self._local_maps.anchor(newest - 1)).inverse() @ pose
            length_m = math.hypot(step.x, step.y)
            drift_m = self._parameters.lost_m if restart else length_m
            self._drift_m += drift_m
            travelled_m = self._travelled_m[-1] + drift_m
            information = self._parameters.tracked_information(length_m, restart)
            self._edges.append(Edge(newest - 1, newest, step, information))
            if not restart:
                self._shown[newest - 1, newest] = self._information_shown(newest - 1, newest, step)
            pose = pose_at(self._nodes, newest - 1) @ step
        self._travelled_m.append(travelled_m)
        self._nodes = np.vstack((self._nodes, (pose.x, pose.y, pose.yaw)))
        overlaps = list(self._overlaps(newest))
        self._close(overlaps)
        # Overlaps with the local maps just before show nothing but that tracking is smooth.
        recent = newest - 2 * self._parameters.stretch_maps
        self._known_places.append(any(edge.first < recent for edge in overlaps))
        if self._recognizer is not None:
            self._complete_stretch(newest, restart)

    def _information_shown(self, older: int, newer: int, step: SE2) -> F64:
        """Information (3, 3) on a tracked step by what both local maps show: none along a bare corridor."""
        chosen = evenly(len(self._local_maps[newer].points_m), self._parameters.search_points)
        points, normals = self._local_maps[newer].points_m[chosen], self._local_maps[newer].normal_rad[chosen]
        return self._parameters.shown_share * self._local_maps[older].match(points, normals, step).information

    def _close(self, loops: list[Edge]) -> None:
        """Add loops to the pose graph; it is solved again if they do not confirm it."""
        if not loops:
            return
        self._edges += loops
        if not all(self._confirms(edge) for edge in loops):
            self._nodes = optimise(self._nodes, self._edges, self._walls).poses
        self._drift_m = 0.0

    def _overlaps(self, newest: int) -> Iterator[Edge]:
        """Verified overlaps of the newest local map with older ones, near its tracked pose."""
        window_m, window_rad = self._parameters.window(self._drift_m)
        # The local map before the newest is left out: tracking matched both against the same walls.
        before = self._nodes[: max(newest - 1, 0), :2]
        distance_m = np.hypot(*(before - self._nodes[newest, :2]).T)
        distance_m[[self._storey(k) != self._storey(newest) for k in range(len(before))]] = np.inf
        near_m = self._parameters.near_m + window_m
        for older in _spread_over_visits(distance_m, near_m, self._parameters.compared):
            edge = self._compare(older, newest, window_m, window_rad)
            if edge is not None:
                yield edge

    def _storey(self, number: int) -> int:
        """The floor of a local map."""
        return self._storeys[self._local_maps.runs[number].start]

    def _compare(self, older: int, newer: int, window_m: float, window_rad: float) -> Edge | None:
        """The measured relative pose of two local maps, near the present one; None if they do not match."""
        guess = pose_at(self._nodes, older).inverse() @ pose_at(self._nodes, newer)
        return self._fitted(older, newer, guess, window_m, window_rad)

    def _fitted(self, older: int, newer: int, guess: SE2, window_m: float, window_rad: float) -> Edge | None:
        """The measured relative pose of two local maps near a guess; None if they do not match."""
        match = _fit(
            self._local_maps[older], self._local_maps[newer], guess, window_m, window_rad, self._parameters
        )
        if match is None:
            return None
        information = self._parameters.information_share * match.information
        return Edge(older, newer, match.pose, information, loop=True)

    def _confirms(self, edge: Edge) -> bool:
        """Whether a loop agrees with the present poses: then the optimisation can wait."""
        present = pose_at(self._nodes, edge.first).inverse() @ pose_at(self._nodes, edge.second)
        apart = edge.T_first_second.inverse() @ present
        near = math.hypot(apart.x, apart.y) < self._parameters.unmoved_m
        return near and abs(apart.yaw) < self._parameters.unmoved_rad

    # --- place recognition --------------------------------------------------------------------------------

    def _complete_stretch(self, newest: int, restart: bool) -> None:
        """Ask the recognizer once the newest local map completes a stretch.

        A stretch does not reach across a lost part of the session: its map would be bent. Where all its local
        maps overlap those of an earlier visit already, there is nothing to ask and nothing new to remember.
        """
        if restart:
            self._stretch_begin = newest
        if newest + 1 - self._stretch_begin == self._parameters.stretch_maps:
            numbers = range(self._stretch_begin, newest + 1)
            self._stretch_begin = numbers.stop
            if not all(self._known_places[number] for number in numbers):
                self._recognize(numbers)

    def _recognize(self, numbers: range) -> None:
        """Ask where the stretch of some local maps was seen before, and close the loops that this shows."""
        assert self._recognizer is not None
        index = len(self._stretches)
        self._stretches.append(numbers)
        self._candidates.add(
            [
                Candidate(
                    recognition=index,
                    older=_middle(self._stretches[found.older]),
                    newer=_middle(numbers),
                    T_older_newer=found.T_older_newest,
                    probability=found.probability,
                )
                for found in self._recognizer.recognize(self._draw_stretch(index, numbers))
                if found.probability >= self._parameters.min_probability
                and self._storey(self._stretches[found.older].start) == self._storey(numbers.start)
            ]
        )
        self._close_candidates()

    def _close_candidates(self) -> None:
        """Close the loops among the recognised places that drift allows and that agree with each other."""
        known = [edge for edge in self._edges if not edge.loop or self._confirms(edge)]
        accepted = self._candidates.acceptable(self._nodes, np.array(self._travelled_m), known)
        loops: list[Edge] = []
        for candidate in accepted:
            self._candidates.remove(candidate)
            loops += self._confirmed(candidate)
        before = self._nodes
        self._close(loops)
        if self._nodes is not before:
            # The newest stretch lies where it belongs now: what the search near the tracked pose missed is
            # near.
            self._close([edge for number in self._stretches[-1] for edge in self._overlaps(number)])

    def _confirmed(self, candidate: Candidate) -> list[Edge]:
        """Loops between the local maps of two stretches: those that match near where one was recognised."""
        parameters, tracked = self._parameters, self._tracked()

        def around(middle: int) -> list[tuple[int, SE2]]:
            """The local maps of the stretch around one, and their poses in its frame."""
            at = pose_at(tracked, self._local_maps.anchor(middle)).inverse()
            stretch = next(numbers for numbers in self._stretches if _middle(numbers) == middle)
            return [(k, at @ pose_at(tracked, self._local_maps.anchor(k))) for k in stretch]

        pairs = []
        for older, T_stretch_older in around(candidate.older):
            for newer, T_stretch_newer in around(candidate.newer):
                # The last stretch overlaps the one before. Neighbours are matched by tracking already.
                if newer - older < 2:
                    continue
                guess = T_stretch_older.inverse() @ candidate.T_older_newer @ T_stretch_newer
                pairs.append((math.hypot(guess.x, guess.y), older, newer, guess))
        loops = []
        for _, older, newer, guess in sorted(pairs, key=lambda pair: pair[:3])[: parameters.compared_pairs]:
            edge = self._fitted(older, newer, guess, parameters.recognized_m, parameters.recognized_rad)
            if edge is not None:
                loops.append(replace(edge, recognized=True))
        return loops

    def _draw_stretch(self, index: int, numbers: range) -> Stretch:
        """The stretch of some consecutive local maps, in the frame of the anchor of the middle one."""
        runs = self._local_maps.runs
        anchor = self._local_maps.anchor(_middle(numbers))
        keyframes, poses = self._local_maps.keyframes(
            range(runs[numbers[0]].start, runs[numbers[-1]].stop), anchor
        )
        builder = GridBuilder(self._projection)
        for keyframe, pose in zip(keyframes, poses, strict=True):
            builder.add(keyframe.planar_scan, pose)
            builder.add_unseen_hits(pose.apply(keyframe.unseen_hits_m))
        return Stretch(
            index=index,
            grid=builder.grid(),
            poses=np.array([(pose.x, pose.y, pose.yaw) for pose in poses]),
            scans=np.array([keyframe.index for keyframe in keyframes]),
        )

    # --- at the end of the session ------------------------------------------------------------------------

    def _settle(self) -> Solution:
        """Solve the pose graph.

        Where the solution bends local maps, their overlaps were measured on a wrong shape: these local maps
        are drawn with the new poses and compared again.
        """
        parameters = self._parameters
        drawn = self._tracked()
        for _ in range(parameters.redraws):
            self._nodes = optimise(self._nodes, self._edges, self._walls).poses
            settled = self._settled()
            bent = [_is_bent(drawn[run], settled[run], parameters) for run in self._local_maps.runs]
            if not any(bent):
                break
            drawn = settled
            self._local_maps.redraw(settled)
            for k, edge in enumerate(self._edges):
                if edge.loop and (bent[edge.first] or bent[edge.second]):
                    again = self._compare(
                        edge.first, edge.second, parameters.certain_m, parameters.certain_rad
                    )
                    self._edges[k] = again or edge
        solution = optimise(self._nodes, self._edges, self._walls)
        self._nodes = solution.poses
        return solution

    def _settled(self) -> F64:
        """Keyframe poses (K, 3) that follow the anchors of their local maps.

        The correction passes gradually from one anchor to the next. Where tracking was lost the error is a
        jump, so there each local map moves rigidly up to its end.
        """
        tracked = self._tracked()
        known: dict[int, SE2] = {}
        for number, run in enumerate(self._local_maps.runs):
            anchor = self._local_maps.anchor(number)
            correction = pose_at(self._nodes, number) @ pose_at(tracked, anchor).inverse()
            ends = [k for k, at in ((run[0], run.start), (run[-1], run.stop)) if at in self._restarts]
            for k in sorted({anchor, *ends}):
                known[k] = correction @ pose_at(tracked, k)
        return spread(tracked, list(known), np.array([(p.x, p.y, p.yaw) for p in known.values()]))

    def _tracked(self) -> F64:
        """Keyframe poses (K, 3) before loops were closed."""
        return np.array(self._poses).reshape(-1, 3)


def _middle(numbers: range) -> int:
    """The local map whose frame a stretch is drawn in."""
    return numbers[len(numbers) // 2]


def _is_bent(drawn: F64, settled: F64, parameters: LoopParameters) -> bool:
    """Whether the shape of a local map, given by its keyframe poses (N, 3), has changed."""
    before = pose_at(drawn, 0).inverse() @ pose_at(drawn, -1)
    apart = before.inverse() @ pose_at(settled, 0).inverse() @ pose_at(settled, -1)
    return math.hypot(apart.x, apart.y) > parameters.bent_m or abs(apart.yaw) > parameters.bent_rad


def _spread_over_visits(distance_m: F64, near_m: float, count: int) -> list[int]:
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


def _fit(
    older: LocalMap,
    newer: LocalMap,
    guess: SE2,
    window_m: float,
    window_rad: float,
    parameters: LoopParameters,
) -> Match | None:
    """The pose of the newer local map in the older one; None if they do not overlap or fit ambiguously."""
    chosen = evenly(len(newer.points_m), parameters.search_points)
    points, normals = newer.points_m[chosen], newer.normal_rad[chosen]
    points_back = older.points_m[evenly(len(older.points_m), parameters.search_points)]
    fits = []
    for _, start in older.search(points, guess, window_m, window_rad):
        match = older.match(points, normals, start)
        observed, agreement = older.agreement(points, match.pose)
        observed_back, agreement_back = newer.agreement(points_back, match.pose.inverse())
        if (
            max(observed, observed_back) > parameters.min_observed
            and min(observed, observed_back) > parameters.min_observed_back
        ):
            fits.append((min(agreement, agreement_back), match))
    if not fits:
        return None
    fits.sort(key=lambda fit: -fit[0])
    agreement, best = fits[0]
    if agreement < parameters.min_agreement:
        return None
    for other_agreement, other in fits[1:]:
        apart = best.pose.inverse() @ other.pose
        rival = other_agreement > agreement - parameters.rival_agreement
        if rival and math.hypot(apart.x, apart.y) > parameters.rival_m:
            return None
    return best


# --- back to every scan ----------------------------------------------------------------------------------


def spread(tracked: F64, known: Sequence[int] | I64, corrected: F64) -> F64:
    """Poses (N, 3) of all scans, from the corrected poses (K, 3) of those of them that are `known`.

    Between two of these the correction passes linearly from one to the other, so the motion that was
    tracked between them stays smooth.
    """
    index = np.asarray(known)
    scans = np.arange(len(tracked))
    left = np.clip(np.searchsorted(index, scans, side="right") - 1, 0, len(index) - 1)
    right = np.minimum(left + 1, len(index) - 1)
    a, b = _moved(tracked, index, corrected, left), _moved(tracked, index, corrected, right)
    span = np.maximum(index[right] - index[left], 1)
    share = np.clip((scans - index[left]) / span, 0.0, 1.0)[:, None]
    mixed: F64 = a + share * np.column_stack((b[:, :2] - a[:, :2], wrap_angle(b[:, 2] - a[:, 2])))
    mixed[:, 2] = wrap_angle(mixed[:, 2])
    return mixed


def _moved(tracked: F64, index: NDArray[np.integer], corrected: F64, which: NDArray[np.integer]) -> F64:
    """Every scan as if rigidly attached to the known scan number `which` (N,)."""
    old, new = tracked[index[which]], corrected[which]
    turn = new[:, 2] - old[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    d = tracked[:, :2] - old[:, :2]
    moved: F64 = np.column_stack(
        (new[:, 0] + c * d[:, 0] - s * d[:, 1], new[:, 1] + s * d[:, 0] + c * d[:, 1], tracked[:, 2] + turn)
    )
    return moved
