"""Loop closure: overlaps with places of earlier visits correct the drift of tracking.

A session is cut into local maps of a few metres of travel. Each new local map is compared with older ones
that it may overlap: correlative scan matching over the uncertainty of tracking proposes poses, and a pose
counts as much as it is likely by the walls and the free space of both (`pc2grid.matching.evidence`). A robust
pose graph over the local maps gives the corrected poses (the scan-to-submap constraints of Hess et al.,
"Real-time loop closure in 2D lidar SLAM", 2016, between two submaps). Between the anchors of local maps the
correction is interpolated, because the error of tracking grows gradually.

After a long way a loop may be farther off than this search reaches. For these the session is its own
database: a place map, of some metres of travel, has a few described places, and a `SessionRecognizer` looks
it up among those before it as a query in a database (`signature.places.hypotheses.look_up`), without using
their poses. Signatures propose, the alignment of walls in both directions verifies.

A recognition alone may be wrong with high confidence: buildings repeat themselves, and some look alike when
they are turned by 180 degrees. What the recognizer does not know is that the drift of tracking is bounded. So
its evidence is that of an answer, and the tracked pose the prior: one equation tells how likely each place is
(`pc2grid.matching.evidence.masses`), and its loops count as much. Loops that contradict each other and the
travel between them are told by the pose graph.

Where tracking was lost and started again, the pose relative to earlier scans is unknown: a new segment
begins. Loops that were accepted between two segments join them again. A component of joined segments is a
part, and becomes a session of its own (`connected`).
"""

from __future__ import annotations

import math
import pickle
import sys
import zlib
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import compress

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pc2grid.estimation.line_map import evenly
from pc2grid.geometry import F64, I64, SE2
from pc2grid.matching.evidence import LEFT, Evidence, evidence_of, masses
from pc2grid.matching.search import SearchMap
from pc2grid.model import Loop, OccupancyGrid
from pc2grid.settings import ProjectionConfig
from signature.config import Config
from signature.paper import PlaceTable
from signature.places.hypotheses import look_up
from signature.places.places import Places
from signature.places.query import QueryMap, query_of
from signature.session.graph import Edge, Solution, WallDirection, optimise, wall_direction
from signature.session.keyframes import TURN_M_PER_RAD, Keyframe, Keyframes, grid_of
from signature.session.local_maps import LOCAL_MAPS, LocalMapParameters, LocalMaps, pose_at
from signature.session.part_maps import OptimisedKeyframes, interpolate_corrections
from signature.session.quality import position_sigmas
from signature.visible import SeenPlaces


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopParameters:
    """Numbers of loop closure. Chosen by hand and checked on the relations of fr079 and intel, unless noted.

    Cutting into local maps:

    travel_m : travel after which a local map is complete.

    Which pairs are compared:

    near_m : older local maps within this distance may overlap the newest one.
    compared : older local maps that the newest is compared with, and pairs of local maps of two place maps.

    How tracking drifts: the standard deviation of a tracked step, and how far a loop is searched.

    drift_m, drift_rad : standard deviations of position and yaw on a metre of travel: 0.4 degrees over 4 m
        (`docs/method.md`).
    certain_m, certain_rad : the window directly after a loop; it grows by two standard deviations.
    max_window_m, max_window_rad : its largest size.

    information_share : in the pose graph, of the information that a match reports: the errors of points on
        one wall are correlated.

    Place recognition:

    maps_per_place : consecutive local maps that make a place map: 12 m of travel, chosen on aces, csail and
        killian.
    """

    travel_m: float = 4.0
    near_m: float = 8.0
    compared: int = 10
    certain_m: float = 0.3
    certain_rad: float = math.radians(4.0)
    drift_m: float = 0.01
    drift_rad: float = 0.0018
    max_window_m: float = 3.0
    max_window_rad: float = math.radians(20.0)
    information_share: float = 0.1
    maps_per_place: int = 3

    def window(self, travel_m: float) -> tuple[float, float]:
        """Return the half widths of the search window, metres and radians, after so much travel."""
        return (
            min(self.certain_m + 2 * self.drift_m * travel_m, self.max_window_m),
            min(self.certain_rad + 2 * self.drift_rad * travel_m, self.max_window_rad),
        )

    @property
    def lost_m(self) -> float:
        """Return the travel that a lost part of the session counts as: that of the largest window."""
        return self.max_window_m / (2 * self.drift_m)

    def tracked_information(self, length_m: float, restart: bool) -> F64:
        """Return the information (3, 3) of a tracked step between anchors. restart : tracking was lost in
        between.

        However near they are: an anchor stands for its local map, and half of that drifts.
        """
        travel_m = self.lost_m if restart else max(length_m, 0.5 * self.travel_m)
        sigma = travel_m * np.array((self.drift_m, self.drift_m, self.drift_rad))
        return np.diag(sigma**-2)


LOOPS = LoopParameters()


class LoopCloser:
    """Closes loops while a session is recorded.

    keyframes : gets those of the session; local maps are drawn from them when needed.
    recognizer : gets the place maps whose overlaps are not all known; None: loops are searched near the
        tracked pose only.
    projection : how the grids for the recognizer are drawn.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        *,
        recognizer: SessionRecognizer | None = None,
        projection: ProjectionConfig = ProjectionConfig(),
        parameters: LoopParameters = LOOPS,
        local_map_parameters: LocalMapParameters = LOCAL_MAPS,
    ) -> None:
        self._parameters = parameters
        self._keyframes = keyframes
        self._local_maps = LocalMaps(keyframes, local_map_parameters)
        # The pose graph over the anchors of local maps, as it was solved last.
        self._nodes: F64 = np.empty((0, 3))  # x, y, yaw of each in the session
        self._edges: list[Edge] = []  # tracked steps and loops, in the order in which they were found
        self._walls: list[WallDirection] = []  # of each local map
        self._place_maps = PlaceMaps(self._local_maps, parameters.maps_per_place, recognizer, projection)
        self._travel_m = 0.0  # in the local map that is not complete yet
        self._travelled_m = array("d")  # at each local map; a lost part counts as `lost_m`
        self._drift_m = 0.0  # travel since the pose was last certain

    def add(self, keyframe: Keyframe) -> None:
        """Keep the next keyframe; every few metres this completes a local map."""
        if len(self._keyframes):
            step = self._keyframes.pose(len(self._keyframes) - 1).inverse() @ keyframe.T_session_base
            self._travel_m += math.hypot(step.x, step.y) + TURN_M_PER_RAD * abs(step.yaw)
            if self._travel_m > self._parameters.travel_m or keyframe.restart:
                self._complete_local_map()
        self._keyframes.append(keyframe)

    def finish(self) -> OptimisedKeyframes:
        """Solve the pose graph, measure its overlaps again, and solve it again. Return its poses, loops and
        parts; without a loop and without walls the poses are the tracked ones.

        The overlaps were measured on local maps that are bent by the drift of tracking. So these are drawn
        again with the optimised poses, and compared again.
        """
        if not len(self._keyframes):
            none = np.empty(0, np.int64)
            return OptimisedKeyframes(
                none, np.empty((0, 3)), (), segments=none, parts=none, anchors=none, sigma_m=np.empty(0)
            )
        self._complete_local_map()
        self._close_recognized(self._place_maps.finish())
        self._solve()
        self._local_maps.redraw(self._optimised())
        self._edges = [self._again(edge) if edge.loop else edge for edge in self._edges]
        solution = self._solve()
        scans, anchors, runs = self._keyframes.scans, self._local_maps.anchors, self._local_maps.runs
        loops = tuple(
            Loop(
                older=scans[anchors[edge.first]],
                newer=scans[anchors[edge.second]],
                T_older_newer=edge.T_first_second,
                information=edge.information,
                accepted=bool(accepted),
            )
            for edge, accepted in zip(self._edges, solution.accepted, strict=True)
            if edge.loop
        )
        begins = [number > 0 and run.start in self._keyframes.restarts for number, run in enumerate(runs)]
        segment = np.cumsum(begins, dtype=np.int64)
        edges = list(compress(self._edges, solution.accepted))
        part = connected(segment, [edge for edge in edges if edge.loop])
        lengths = [len(run) for run in runs]
        return OptimisedKeyframes(
            scans=np.array(scans, dtype=np.int64),
            poses=self._optimised(),
            loops=loops,
            segments=np.repeat(segment, lengths),
            parts=np.repeat(part, lengths),
            anchors=np.array(anchors, dtype=np.int64),
            sigma_m=self._sigmas(edges, part),
        )

    # --- during the session -------------------------------------------------------------------------------

    def _complete_local_map(self) -> None:
        """Make a local map of the last keyframes: place it by tracking, then compare it with older ones."""
        newest = len(self._nodes)
        self._local_maps.complete()
        restart = self._local_maps.runs[newest].start in self._keyframes.restarts
        self._travel_m = 0.0
        self._place(newest, restart)
        overlaps = list(self._overlaps(newest))
        self._close(overlaps)
        # Overlaps with the local maps just before show nothing but that tracking is smooth.
        recent = newest - 2 * self._parameters.maps_per_place
        known = any(edge.first < recent for edge in overlaps)
        self._close_recognized(self._place_maps.extend(restart=restart, known=known))

    def _place(self, newest: int, restart: bool) -> None:
        """Add the newest local map to the pose graph, a tracked step from the one before. restart : tracking
        was lost in between."""
        anchors, travelled_m = self._local_maps.anchors, 0.0
        pose = self._keyframes.pose(anchors[newest])
        if newest:
            step = self._keyframes.pose(anchors[newest - 1]).inverse() @ pose
            length_m = math.hypot(step.x, step.y)
            drift_m = self._parameters.lost_m if restart else length_m
            self._drift_m += drift_m
            travelled_m = self._travelled_m[-1] + drift_m
            information = self._parameters.tracked_information(length_m, restart)
            self._edges.append(Edge(newest - 1, newest, step, information))
            pose = pose_at(self._nodes, newest - 1) @ step
        self._travelled_m.append(travelled_m)
        self._nodes = np.vstack((self._nodes, (pose.x, pose.y, pose.yaw)))
        self._walls.append(wall_direction(self._local_maps[newest].normal_rad))

    def _relative(self, first: int, second: int) -> SE2:
        """Return T_first_second of two local maps by the present poses."""
        return pose_at(self._nodes, first).inverse() @ pose_at(self._nodes, second)

    def _solve(self) -> Solution:
        """Solve the pose graph for the poses that agree best with all edges."""
        solution = optimise(self._nodes, self._edges, self._walls)
        self._nodes = solution.poses
        return solution

    def _close(self, loops: list[Edge]) -> None:
        """Add loops to the pose graph, and solve it again."""
        if loops:
            self._drift_m *= 1.0 - max(loop.counts for loop in loops)
            self._edges += loops
            self._solve()

    def _overlaps(self, newest: int) -> Iterator[Edge]:
        """Yield verified overlaps of the newest local map with older ones, near its pose in the graph."""
        window = self._parameters.window(self._drift_m)
        # The local map before the newest is left out: tracking matched both against the same walls.
        before = self._nodes[: max(newest - 1, 0), :2]
        distance_m = np.hypot(*(before - self._nodes[newest, :2]).T)
        near = np.flatnonzero(distance_m < self._parameters.near_m + window[0]).tolist()
        # A robot that drives up and down passes a place dozens of times: some of all visits are chosen.
        for older in (near[k] for k in evenly(len(near), self._parameters.compared)):
            yield from self._compare(older, newest, self._relative(older, newest), window)

    def _compare(
        self, older: int, newer: int, guess: SE2, window: tuple[float, float], mass: float = 1.0
    ) -> list[Edge]:
        """Match two local maps near a guess; returns an edge, or none if they do not match.

        window : half widths of the search around the guess, metres and radians. mass : of the guess.
        """
        overlap = self._local_maps[older].overlap(self._local_maps[newer], guess, *window)
        if overlap is None:
            return []
        information = mass * self._parameters.information_share * overlap.information
        counts = mass * overlap.counts
        return [Edge(older, newer, overlap.pose, information, loop=True, counts=counts, mass=mass)]

    # --- place recognition --------------------------------------------------------------------------------

    def _close_recognized(self, found: Sequence[Recognition]) -> None:
        """Close the loops to the places that the newest place map may show; each counts as it is likely."""
        p = self._parameters
        loops: list[Edge] = []
        ways_m = [self._way_m(place) for place in found]
        prior = [self._prior(place, way_m) for place, way_m in zip(found, ways_m, strict=True)]
        mass = masses([place.evidence for place in found], prior)
        for place, way_m, likely in zip(found, ways_m, mass.tolist(), strict=True):
            # Places a short way apart show nothing but that tracking is smooth.
            if likely < LEFT or way_m < 2 * p.maps_per_place * p.travel_m:
                continue
            for older, newer, guess in self._place_maps.guesses(place)[: p.compared]:
                loops += self._compare(older, newer, guess, p.window(0.0), likely)
        self._close(loops)
        if loops:
            # The newest place map is where it belongs now: loops that the search near the tracked pose missed
            # are near.
            self._close([edge for number in self._place_maps.asked[-1] for edge in self._overlaps(number)])

    def _way_m(self, place: Recognition) -> float:
        """Return the travel from a recognised place to the newest one; a lost part counts as `lost_m`."""
        older, newest = self._place_maps.middles(place)
        return self._travelled_m[newest] - self._travelled_m[older]

    def _prior(self, place: Recognition, way_m: float) -> float:
        """Return how likely tracking has drifted to a recognised place on the way from it; 1 where it is
        tracked.

        The drift is a Gaussian. Its standard deviations are the window in which loops are searched after so
        much travel: in killian, aces, csail, intel and the workshop tracking alone is off by up to 1.7 % of
        the travel, 10.4 m and 10 degrees.
        """
        window_m, window_rad = self._parameters.window(way_m)
        drift = place.T_older_newer.inverse() @ self._relative(*self._place_maps.middles(place))
        off = math.hypot(drift.x / window_m, drift.y / window_m, drift.yaw / window_rad)
        return max(math.exp(-0.5 * off**2), sys.float_info.min)

    # --- at the end of the session ------------------------------------------------------------------------

    def _again(self, edge: Edge) -> Edge:
        """Measure an overlap again on the present local maps; return the old one if they no longer
        overlap.

        A recognised place stays as likely as it was: its alternatives are not measured again.
        """
        guess, window = self._relative(edge.first, edge.second), self._parameters.window(0.0)
        return next(iter(self._compare(edge.first, edge.second, guess, window, edge.mass)), edge)

    def _optimised(self) -> F64:
        """Return keyframe poses (K, 3) that follow the anchors of their local maps.

        The correction passes gradually from one anchor to the next. Where tracking was lost the error is a
        jump, so there each local map moves rigidly up to its end.
        """
        tracked = self._keyframes.poses()
        known: dict[int, SE2] = {}
        for number, run in enumerate(self._local_maps.runs):
            anchor = self._local_maps.anchors[number]
            correction = pose_at(self._nodes, number) @ pose_at(tracked, anchor).inverse()
            restarts = self._keyframes.restarts
            ends = [k for k, at in ((run[0], run.start), (run[-1], run.stop)) if at in restarts]
            for k in sorted({anchor, *ends}):
                known[k] = correction @ pose_at(tracked, k)
        return interpolate_corrections(
            tracked, list(known), np.array([(p.x, p.y, p.yaw) for p in known.values()])
        )

    def _sigmas(self, edges: Sequence[Edge], part: I64) -> F64:
        """Return the standard deviation (N,) in metres of the position of each local map within its part
        (N,). edges : those that are accepted."""
        sigma_m = np.zeros(len(part))
        number = np.empty(len(part), np.int64)  # of each local map within its part
        for own in (np.flatnonzero(part == k) for k in range(int(part.max(initial=-1)) + 1)):
            number[own] = np.arange(len(own))
            within = [
                replace(edge, first=int(number[edge.first]), second=int(number[edge.second]))
                for edge in edges
                if part[edge.first] == part[edge.second] == part[own[0]]
            ]
            sigma_m[own] = position_sigmas(self._nodes[own], within, [self._walls[k] for k in own])
        return sigma_m


_JOINING = 2
"""Different local maps on each of the two sides that must be in agreeing loops, to join two segments; a
single room may look like another one. Chosen by hand."""


def connected(segment: I64, loops: Sequence[Edge]) -> I64:
    """Return the number (N,) of the part of each local map, in the order in which the parts begin.

    segment : (N,) number of the segment of each, from 0. loops : accepted ones. Two segments are joined if
    enough different local maps of the one overlap enough different ones of the other.
    """
    ends: dict[tuple[int, int], list[Edge]] = {}
    for loop in loops:
        ends.setdefault((int(segment[loop.first]), int(segment[loop.second])), []).append(loop)
    joined = [
        pair
        for pair, between in ends.items()
        if len({loop.first for loop in between}) >= _JOINING
        and len({loop.second for loop in between}) >= _JOINING
    ]
    count = int(segment.max(initial=-1)) + 1
    rows, columns = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, part = np.unique(label[segment], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[part], dtype=np.int64)


# --- place recognition --------------------------------------------------------------------------------


class PlaceMaps:
    """The place maps of a session that were given to its recognizer.

    maps : consecutive local maps in a place map.
    recognizer : None: there are no place maps. projection : how their grids are drawn.
    asked : the local maps of each that was passed on.
    """

    def __init__(
        self,
        local_maps: LocalMaps,
        maps: int,
        recognizer: SessionRecognizer | None,
        projection: ProjectionConfig,
    ) -> None:
        self._local_maps, self._maps = local_maps, maps
        self._recognizer, self._projection = recognizer, projection
        self.asked: list[range] = []
        self._known_places: list[bool] = []  # whether each local map overlaps one of an earlier visit
        self._begin = 0  # first local map of the place that is not complete yet

    def extend(self, *, restart: bool, known: bool) -> Sequence[Recognition]:
        """Add the newest local map. Return what is recognised in the place map that it completes.

        restart : tracking was lost before it. known : it overlaps a local map of an earlier visit.

        A place map does not reach across a lost part of the session: it would be bent. If all its local maps
        overlap those of an earlier visit already, it is not passed on, as it adds nothing.
        """
        if restart:
            self._begin = len(self._known_places)
        self._known_places.append(known)
        place = range(self._begin, len(self._known_places))
        if len(place) < self._maps:
            return ()
        self._begin = place.stop
        return self._ask(place)

    def finish(self) -> Sequence[Recognition]:
        """Make a place map of the last local maps, which may overlap the one before; returns as `extend`
        does."""
        stop = len(self._known_places)
        return self._ask(range(max(stop - self._maps, 0), stop)) if self._begin < stop else ()

    def middles(self, found: Recognition) -> tuple[int, int]:
        """Return the local maps in whose frames a recognised place map and the newest one are drawn."""
        return _middle(self.asked[found.older]), _middle(self.asked[-1])

    def guesses(self, found: Recognition) -> list[tuple[int, int, SE2]]:
        """Return the pairs of local maps of a recognised place map and the newest one, the nearest first.

        Each is the older, the newer, and T_older_newer by the recognition.
        """
        pairs = []
        for older, T_place_older in self._within(self.asked[found.older]):
            for newer, T_place_newer in self._within(self.asked[-1]):
                # The last place map overlaps the one before. Neighbours are matched by tracking already.
                if newer - older < 2:
                    continue
                guess = T_place_older.inverse() @ found.T_older_newer @ T_place_newer
                pairs.append((older, newer, guess))
        return sorted(pairs, key=lambda pair: (math.hypot(pair[2].x, pair[2].y), *pair[:2]))

    def _within(self, place: range) -> list[tuple[int, SE2]]:
        """Return the local maps of a place map, and their tracked poses in its frame."""
        anchors = self._local_maps.anchors
        poses = self._local_maps.poses((anchors[number] for number in place), anchors[_middle(place)])
        return list(zip(place, poses, strict=True))

    def _ask(self, place: range) -> Sequence[Recognition]:
        """Draw the place map of consecutive local maps, in the frame of the anchor of the middle one, and
        pass it to the recognizer, unless all of them are known."""
        if self._recognizer is None or all(self._known_places[k] for k in place):
            return ()
        self.asked.append(place)
        runs = self._local_maps.runs
        keyframes, poses = self._local_maps.keyframes(
            range(runs[place[0]].start, runs[place[-1]].stop), self._local_maps.anchors[_middle(place)]
        )
        grid = grid_of(zip(keyframes, poses, strict=True), self._projection)
        return self._recognizer.recognize(grid, np.array([(pose.x, pose.y) for pose in poses]))


def _middle(numbers: range) -> int:
    """Return the local map in whose frame a place map is drawn."""
    return numbers[len(numbers) // 2]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionParameters:
    """Numbers of place recognition within a session, chosen by the time of `convert` on killian (1.9 km).

    views : places of a place map that are described. They are both what is asked and what is asked for.
    shortlist : so many earlier places are compared with it, those that are likeliest by their signatures.
    maps : prepared maps of earlier place maps that stay in memory, about 4 MB each.
    """

    views: int = 12
    shortlist: int = 10
    maps: int = 16


RECOGNITION = RecognitionParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """An earlier place map that shows the place of the newest one, and their relative pose.

    older : its number in the order of travel, from 0.
    T_older_newer : the frame of the newest place map in that of the older one. Exact to some decimetres; loop
        closure refines it on the local maps.
    evidence : that both show the same place, by their appearance.

    At most one recognition of a place map is right, or those at one place that several older ones show.
    """

    older: int
    T_older_newer: SE2
    evidence: Evidence


class SessionRecognizer:
    """The place maps of one session as a database of places that grows.

    >>> import pc2grid, signature
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     monday = pc2grid.build_map(log, signature.Config(), session="monday")
    >>> monday.session
    'monday'
    """

    def __init__(self, config: Config, parameters: RecognitionParameters = RECOGNITION) -> None:
        """Begin without any place map. config : they are described as the places of a database with this
        configuration."""
        self._made_with = config
        self._config = config.relocalize.model_copy(update={"views": parameters.views})
        self._parameters = parameters
        # Grids are kept compressed: some 10 kB each, so that a long session needs little memory.
        self._stored: list[bytes] = []
        self._seen: list[SeenPlaces] = []  # what is seen from the places of each
        self._map_of = lru_cache(parameters.maps)(lambda number: SearchMap.of(self._grid_of(number)))
        self._places: Places | None = None

    def recognize(self, grid: OccupancyGrid, path_m: F64) -> Sequence[Recognition]:
        """Return the earlier place maps that look like the newest one, each place with its own evidence.

        grid : its map, of a few metres of travel, long enough to be recognised; in its own frame, the base at
        one of its keyframes, in the middle. path_m : (K, 2) its keyframes. The last one of a session may be
        shorter, and overlap the one before.
        """
        query = query_of(grid, path_m, self._made_with, self._config)
        found = [] if self._places is None else self._look_up(query, self._places)
        self._remember(grid, query)
        return found

    def _look_up(self, query: QueryMap, places: Places) -> list[Recognition]:
        rows = places.order(query.views, query.center_m, self._config).rows[: self._parameters.shortlist]
        found = next(look_up(query, [places.areas(rows)], places, self._map_of, self._config))
        return [
            Recognition(older=h.session_index, T_older_newer=h.T_map_query, evidence=evidence)
            for h, evidence in zip(found, evidence_of(found, query.likeness), strict=True)
            if masses([evidence])[0] >= LEFT
        ]

    def _remember(self, grid: OccupancyGrid, query: QueryMap) -> None:
        """Add the newest place map to the places that later ones are looked up in."""
        count, sight_m = len(query.views), self._made_with.partition.radius_m
        table = PlaceTable(
            session_index=np.full(count, len(self._stored), np.int32),
            submap_id=np.arange(count, dtype=np.int32),
            center_m=np.array([view.center_m for view in query.views]).reshape(-1, 2),
        )
        self._stored.append(zlib.compress(pickle.dumps(grid), 1))
        self._seen.append(SeenPlaces.of(grid, table.center_m, sight_m))
        if not count:
            return
        if self._places is not None:
            table = PlaceTable.concatenated((self._places.table, table))
        areas_m2 = [0.0] * len(self._stored)
        self._places = Places(table, self._grid_of, sight_m, areas_m2, self._seen.__getitem__)

    def _grid_of(self, number: int) -> OccupancyGrid:
        grid: OccupancyGrid = pickle.loads(zlib.decompress(self._stored[number]))
        return grid
