"""The pose graph, and loop closure over it."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan
from pc2grid.geometry import F64, SE2
from pc2grid.matching.evidence import Evidence
from pc2grid.model import OccupancyGrid
from signature.session.graph import Edge, optimise
from signature.session.keyframes import Keyframe, Keyframes
from signature.session.local_maps import LocalMap, Overlap
from signature.session.loops import LoopCloser, LoopParameters, Recognition
from signature.session.part_maps import OptimisedKeyframes, interpolate_corrections
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import flat_scan

Wall = tuple[tuple[float, float], tuple[float, float]]
"""A segment from one point to another."""
INFORMATION = np.diag([1e4, 1e4, 1e5])


def square(count: int = 40, side: float = 10.0) -> list[SE2]:
    """True poses around a square of corridors."""
    poses = []
    for k in range(count):
        s = 4 * side * k / count
        edge, along = divmod(s, side)
        corner = [(0, 0), (side, 0), (side, side), (0, side)][int(edge)]
        yaw = edge * math.pi / 2
        poses.append(
            SE2(
                corner[0] + along * math.cos(yaw),
                corner[1] + along * math.sin(yaw),
                math.remainder(yaw, 2 * math.pi),
            )
        )
    return poses


def drifting(truth: list[SE2], veer: float = 0.01) -> tuple[list[SE2], list[Edge]]:
    poses: list[SE2] = [truth[0]]
    edges: list[Edge] = []
    for k in range(1, len(truth)):
        step = truth[k - 1].inverse() @ truth[k]
        measured = SE2(step.x * 1.01, step.y, step.yaw + veer)
        edges.append(Edge(k - 1, k, measured, INFORMATION))
        poses.append(poses[-1] @ measured)
    return poses, edges


def array(poses: list[SE2]) -> F64:
    return np.array([(p.x, p.y, p.yaw) for p in poses])


def weighted_error(poses: F64, edge: Edge) -> float:
    """Squared error of an edge, weighted by its information."""
    first, second = SE2(*poses[edge.first]), SE2(*poses[edge.second])
    apart = (first @ edge.T_first_second).inverse() @ second
    error = np.array([apart.x, apart.y, apart.yaw])
    return float(error @ edge.information @ error)


def test_one_loop_takes_the_drift_out_and_a_false_one_is_outvoted() -> None:
    truth = square()
    poses, edges = drifting(truth, veer=0.01)
    before = np.linalg.norm(array(poses)[-1, :2] - array(truth)[-1, :2])
    loops = [Edge(k, 39 - k, truth[k].inverse() @ truth[39 - k], INFORMATION, loop=True) for k in range(3)]
    false = Edge(5, 25, SE2(0.5, 0.0, 0.0), INFORMATION, loop=True)
    solved = optimise(array(poses), [*edges, *loops, false])
    after = np.linalg.norm(solved.poses[-1, :2] - array(truth)[-1, :2])
    assert before > 2.0 and after < 0.1
    assert weighted_error(solved.poses, false) > 100 * weighted_error(solved.poses, loops[-1])
    assert solved.accepted[:39].all() and solved.accepted[-2:].tolist() == [True, False]
    assert np.array_equal(solved.poses[0], array(truth)[0])


def test_corrections_pass_smoothly_between_keyframes() -> None:
    tracked = np.column_stack((np.arange(5.0), np.zeros(5), np.zeros(5)))
    corrected = np.array([[0.0, 0.0, 0.0], [4.0, 0.4, 0.0]])
    assert interpolate_corrections(tracked, [0, 4], corrected)[:, 1] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    beyond = interpolate_corrections(tracked, [0, 2], np.array([[0, 0, 0], [2, 1.0, 0]]))
    assert beyond[4] == pytest.approx((4, 1, 0))


def scan_of(pose: SE2, walls: list[Wall]) -> PlanarScan:
    """The planar scan of a laser that looks all around, between walls."""
    bearings = np.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    directions = np.column_stack((np.cos(bearings + pose.yaw), np.sin(bearings + pose.yaw)))
    ranges = np.full(BEARINGS, np.inf)
    for start, end in walls:
        d, o = np.subtract(end, start), np.subtract(start, (pose.x, pose.y))
        cross = directions[:, 0] * d[1] - directions[:, 1] * d[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (o[0] * d[1] - o[1] * d[0]) / cross
            u = (o[0] * directions[:, 1] - o[1] * directions[:, 0]) / cross
        ranges = np.where((t > 0) & (u >= 0) & (u <= 1) & (t < ranges), t, ranges)
    seen = np.isfinite(ranges)
    hits = np.column_stack((np.cos(bearings), np.sin(bearings)))[seen] * ranges[seen, None]
    return flat_scan(hits, np.where(seen, ranges, 0))


def closed(
    poses: list[SE2], planar_scans: list[PlanarScan], restart: int | None = None, **options: Any
) -> tuple[F64, OptimisedKeyframes]:
    """Settled poses of all keyframes, and the result of loop closure."""
    closer = LoopCloser(Keyframes(), **options)
    if "recognizer" in options:
        options["recognizer"].closer = closer
    for k, (pose, planar_scan) in enumerate(zip(poses, planar_scans, strict=True)):
        closer.add(Keyframe(k, planar_scan, pose, restart=k == restart))
    found = closer.finish()
    return interpolate_corrections(array(poses), found.scans, found.poses), found


BLOCK: list[Wall] = [
    *[((-2, -2), (14, -2)), ((14, -2), (14, 12)), ((14, 12), (-2, 12)), ((-2, 12), (-2, -2))],
    *[((2, 2), (8, 2)), ((8, 2), (8, 5)), ((8, 5), (5, 8)), ((5, 8), (2, 8)), ((2, 8), (2, 2))],
]
"""A block in a hall."""


def test_two_laps_around_a_block_with_drift_agree_after_closing() -> None:
    truth = square(100) * 2
    poses, _ = drifting(truth, veer=0.003)
    before = np.linalg.norm(array(poses)[:, :2] - array(truth)[:, :2], axis=1)
    settled, found = closed(poses, [scan_of(pose, BLOCK) for pose in truth])
    assert before.max() > 3.0 and len(found.loops) > 3
    lap = settled[100:, :2] - settled[:100, :2]
    assert np.linalg.norm(lap, axis=1).max() < 0.04
    # Half a local map turns by a degree before its anchor: so much may the whole map be turned.
    T_truth_map = SE2.fit(settled[:, :2], array(truth)[:, :2])
    assert abs(T_truth_map.yaw) < math.radians(1.0)
    assert np.linalg.norm(T_truth_map.apply(settled[:, :2]) - array(truth)[:, :2], axis=1).max() < 0.04
    for loop in found.loops:
        assert loop.older < loop.newer
        apart = (truth[loop.older].inverse() @ truth[loop.newer]).inverse() @ loop.T_older_newer
        assert math.hypot(apart.x, apart.y) < 2 * RESOLUTION_M and abs(apart.yaw) < 0.03
        # The information is right about the size of that error: 16 is beyond 0.1 % of what it promises.
        error = np.array([apart.x, apart.y, apart.yaw])
        assert error @ loop.information @ error < 16.0 and np.linalg.eigvalsh(loop.information)[0] > 10.0
    assert sum(loop.accepted for loop in found.loops) > 0.9 * len(found.loops)


def test_a_lost_stretch_is_a_guess_and_its_error_stays_in_it() -> None:
    """After the first lap tracking is lost, and starts again 1 m and 10 degrees beside the truth."""
    truth = square(100) * 2
    beside = truth[100] @ SE2(0.8, -0.6, math.radians(10.0)) @ truth[100].inverse()
    poses = truth[:100] + [beside @ pose for pose in truth[100:]]
    settled, found = closed(poses, [scan_of(pose, BLOCK) for pose in truth], restart=100)
    assert {99, 100} <= set(found.scans.tolist())
    apart = np.linalg.norm(settled[:, :2] - array(truth)[:, :2], axis=1)
    assert apart.max() < 2 * RESOLUTION_M


def test_work_and_loops_grow_with_the_way_and_not_with_its_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """One more lap does not change how many local maps each one is compared with."""
    compared: list[int] = []
    overlap = LocalMap.overlap

    def counted(*arguments: Any) -> Overlap | None:
        compared.append(1)
        return overlap(*arguments)

    monkeypatch.setattr(LocalMap, "overlap", counted)
    truth, closer, after_lap = square(30), LoopCloser(Keyframes()), []
    planar_scans = [scan_of(pose, BLOCK) for pose in truth]
    for lap in range(4):
        for k, (pose, planar_scan) in enumerate(zip(truth, planar_scans, strict=True)):
            closer.add(Keyframe(len(truth) * lap + k, planar_scan, pose))
        after_lap.append(len(compared))
    _, second, third, fourth = after_lap
    assert 0 < fourth - third <= 1.1 * (third - second)
    assert len(closer.finish().loops) > 3


HERE = SE2(0.0, 0.0, 0.0)
SURE = Evidence(known_agreement=1.0, compared=100.0, backward=1.0, looked_at=100.0, lead=0.1, likeness=0.0)
"""Evidence of a place with a mass of .99, if tracking puts it there, too."""


class KnowsTheTruth:
    """A recognizer that knows the true poses of the keyframes, and so of the place maps.

    off : each place is told so often, so far off, and with this evidence. closer : asks it.
    """

    closer: LoopCloser

    def __init__(self, truth: list[SE2], *off: tuple[SE2, Evidence]) -> None:
        self._truth, self._off = truth, off or ((HERE, SURE),)
        self.paths_m: list[F64] = []  # of each place map
        self.frames: list[SE2] = []  # true pose of each

    def recognize(self, grid: OccupancyGrid, path_m: F64) -> list[Recognition]:
        place = self.closer._place_maps.asked[-1]
        anchor = self.closer._local_maps.anchors[place[len(place) // 2]]
        self.paths_m.append(path_m)
        self.frames.append(self._truth[self.closer._keyframes.scans[anchor]])
        found = []
        for older, frame in enumerate(self.frames[:-1]):
            true = frame.inverse() @ self.frames[-1]
            if math.hypot(true.x, true.y) < 8.0:
                found += [
                    Recognition(older=older, T_older_newer=true @ off, evidence=evidence)
                    for off, evidence in self._off
                ]
        return found


def farthest(settled: F64, truth: list[SE2]) -> float:
    T_truth_session = SE2.fit(settled[:, :2], array(truth)[:, :2])
    return float(np.linalg.norm(T_truth_session.apply(settled[:, :2]) - array(truth)[:, :2], axis=1).max())


APART = LoopParameters(near_m=-100.0)
"""No local maps are near."""


def test_a_recognizer_closes_loops_where_no_local_maps_are_near() -> None:
    truth = square(100) * 2
    poses, _ = drifting(truth, veer=0.004)
    planar_scans = [scan_of(pose, BLOCK) for pose in truth]
    alone, _ = closed(poses, planar_scans, parameters=APART)
    settled, found = closed(poses, planar_scans, parameters=APART, recognizer=KnowsTheTruth(truth))
    assert farthest(alone, truth) > 1.0
    assert farthest(settled, truth) < 0.2 and sum(loop.accepted for loop in found.loops) > 3


def test_no_place_map_reaches_across_a_lost_part() -> None:
    truth = square(100)
    recognizer = KnowsTheTruth(truth)
    poses = truth[:35] + [SE2(5.0, 5.0, 1.0) @ pose for pose in truth[35:]]
    closed(poses, [scan_of(pose, BLOCK) for pose in truth], restart=35, recognizer=recognizer)
    assert recognizer.paths_m
    for path_m in recognizer.paths_m:
        assert np.linalg.norm(np.diff(path_m, axis=0), axis=1).max() < 1.0


# --- Which recognised places become loops ---


def counts(monkeypatch: pytest.MonkeyPatch, *off: tuple[SE2, Evidence], side: float = 10.0) -> float:
    """How much the first loop counts, of two laps of which the second is recognised; 0 without a loop.

    off : so far from the tracked poses, which are true. All local maps match where they are told to be.
    """
    monkeypatch.setattr(LocalMap, "overlap", lambda self, newer, guess, *_: Overlap(guess, INFORMATION, 1.0))
    truth = square(100, side) * 2
    scans = [scan_of(pose, BLOCK) for pose in truth]
    _, found = closed(truth, scans, parameters=APART, recognizer=KnowsTheTruth(truth, *off))
    full = APART.information_share * INFORMATION[0, 0]
    return float(found.loops[0].information[0, 0] / full) if found.loops else 0.0


def test_a_place_counts_as_it_is_likely_by_its_evidence_and_by_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    weak = replace(SURE, lead=-0.05)
    sure, doubtful = counts(monkeypatch, (HERE, SURE)), counts(monkeypatch, (HERE, weak))
    off = counts(monkeypatch, (SE2(0.0, 3.0, 0.0), SURE))  # after 40 m; 1.1 m are a standard deviation
    assert sure > 0.95 and 0.05 < doubtful < 0.2 and 0.2 < off < 0.6
    assert counts(monkeypatch, (SE2(0.0, 20.0, 0.0), SURE)) == 0.0


def test_a_building_turned_by_half_is_never_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert counts(monkeypatch, (SE2(0.0, 0.0, math.pi), replace(SURE, lead=0.2))) == 0.0


def test_of_two_places_for_one_place_map_the_tracked_one_is_likelier(monkeypatch: pytest.MonkeyPatch) -> None:
    alike = (HERE, SURE), (SE2(0.0, 2.0, 0.0), SURE)
    right, wrong = counts(monkeypatch, *alike), counts(monkeypatch, alike[1])
    assert counts(monkeypatch, alike[0]) - 0.02 > right > 0.75 and wrong < 0.9


def test_a_place_a_short_way_back_is_no_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two place maps are 24 m: of two laps of 12 m no places lie so far apart, of two of 20 m some do."""
    assert counts(monkeypatch, (HERE, SURE), side=3.0) == 0.0
    assert counts(monkeypatch, (HERE, SURE), side=5.0) > 0.2


def test_a_recognised_place_ties_what_was_lost_to_the_rest() -> None:
    """After the first lap tracking is lost, and starts again 2 m and 40 degrees beside the truth."""
    truth = square(100) * 2
    beside = truth[100] @ SE2(1.6, -1.2, math.radians(40.0)) @ truth[100].inverse()
    poses = truth[:100] + [beside @ pose for pose in truth[100:]]
    scans = [scan_of(pose, BLOCK) for pose in truth]
    alone, _ = closed(poses, scans, restart=100, parameters=APART)
    settled, _ = closed(poses, scans, restart=100, parameters=APART, recognizer=KnowsTheTruth(truth))
    assert farthest(alone, truth) > 1.0 and farthest(settled, truth) < 0.2
