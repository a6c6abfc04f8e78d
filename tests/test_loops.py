"""The pose graph, and maps that agree with themselves."""

import errno
import io
import math

import numpy as np
import pytest

from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.keyframes import Keyframe, Keyframes
from pc2grid.loops import LoopCloser, spread
from pc2grid.pose_graph import Edge, optimise
from pc2grid.sweep import BEARINGS, Sweep

INFORMATION = np.diag([1e4, 1e4, 1e5])


def square(count=40, side=10.0):
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


def drifting(truth, veer=0.01):
    poses, edges = [truth[0]], []
    for k in range(1, len(truth)):
        step = truth[k - 1].inverse() @ truth[k]
        measured = SE2(step.x * 1.01, step.y, step.yaw + veer)
        edges.append(Edge(k - 1, k, measured, INFORMATION))
        poses.append(poses[-1] @ measured)
    return poses, edges


def array(poses):
    return np.array([(p.x, p.y, p.yaw) for p in poses])


def test_one_loop_takes_the_drift_out_and_a_false_one_is_outvoted():
    truth = square()
    poses, edges = drifting(truth, veer=0.01)
    before = np.linalg.norm(array(poses)[-1, :2] - array(truth)[-1, :2])
    loops = [Edge(k, 39 - k, truth[k].inverse() @ truth[39 - k], INFORMATION, loop=True) for k in range(3)]
    false = Edge(5, 25, SE2(0.5, 0.0, 0.0), INFORMATION, loop=True)
    solved = optimise(array(poses), [*edges, *loops, false])
    after = np.linalg.norm(solved.poses[-1, :2] - array(truth)[-1, :2])
    assert before > 2.0 and after < 0.1
    assert solved.chi2[-1] > 100 * solved.chi2[-2]
    assert solved.believed[:39].all() and solved.believed[-2:].tolist() == [True, False]
    assert np.array_equal(solved.poses[0], array(truth)[0])


def test_exact_edges_are_solved_exactly_from_a_bad_start():
    truth = square(12)
    edges = [Edge(k, k + 1, truth[k].inverse() @ truth[k + 1], INFORMATION) for k in range(11)]
    start = array(truth) + np.random.default_rng(0).normal(0, 0.2, (12, 3)) * (np.arange(12) > 0)[:, None]
    solved = optimise(start, edges).poses
    assert np.abs(solved[:, :2] - array(truth)[:, :2]).max() < 1e-4


def test_no_edges_nothing_moves():
    assert np.array_equal(optimise(np.ones((3, 3)), []).poses, np.ones((3, 3)))


def test_corrections_pass_smoothly_between_keyframes():
    tracked = np.column_stack((np.arange(5.0), np.zeros(5), np.zeros(5)))
    corrected = np.array([[0.0, 0.0, 0.0], [4.0, 0.4, 0.0]])
    assert spread(tracked, [0, 4], corrected)[:, 1] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert spread(tracked, [0, 2], np.array([[0, 0, 0], [2, 1.0, 0]]))[4] == pytest.approx((4, 1, 0))


def ring_sweep(pose, walls):
    """What a laser all around sees of walls, each a segment ((x, y), (x, y))."""
    bearings = np.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    directions = np.column_stack((np.cos(bearings + pose.yaw), np.sin(bearings + pose.yaw)))
    ranges = np.full(BEARINGS, np.inf)
    for a, b in walls:
        a, b = np.array(a, float), np.array(b, float)
        d, o = b - a, a - (pose.x, pose.y)
        cross = directions[:, 0] * d[1] - directions[:, 1] * d[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (o[0] * d[1] - o[1] * d[0]) / cross
            u = (o[0] * directions[:, 1] - o[1] * directions[:, 0]) / cross
        ranges = np.where((t > 0) & (u >= 0) & (u <= 1) & (t < ranges), t, ranges)
    seen = np.isfinite(ranges)
    hits = np.column_stack((np.cos(bearings), np.sin(bearings)))[seen] * ranges[seen, None]
    return Sweep(
        stamp_ns=0,
        hits_m=hits.astype(np.float32),
        origin_m=np.zeros(2),
        free_m=np.where(seen, ranges, 0).astype(np.float32),
    )


def closed(poses, sweeps, restart=None):
    """What the closer makes of keyframes, as poses of all of them and as it says it."""
    keyframes = Keyframes()
    closer = LoopCloser(keyframes)
    for k, (pose, sweep) in enumerate(zip(poses, sweeps, strict=True)):
        keyframes.append(Keyframe(k, sweep, pose, restart=k == restart))
        closer.extend(keyframes[k])
    found = closer.finish()
    return spread(array(poses), found.scans, found.poses), found


BLOCK = [
    *[((-2, -2), (14, -2)), ((14, -2), (14, 12)), ((14, 12), (-2, 12)), ((-2, 12), (-2, -2))],
    *[((2, 2), (8, 2)), ((8, 2), (8, 5)), ((8, 5), (5, 8)), ((5, 8), (2, 8)), ((2, 8), (2, 2))],
]
"""A block in a hall."""


def test_two_laps_around_a_block_with_drift_agree_after_closing():
    truth = square(100) * 2
    poses, _ = drifting(truth, veer=0.003)
    before = np.linalg.norm(array(poses)[:, :2] - array(truth)[:, :2], axis=1)
    settled, found = closed(poses, [ring_sweep(pose, BLOCK) for pose in truth])
    assert before.max() > 3.0 and len(found.loops) > 3
    lap = settled[100:, :2] - settled[:100, :2]
    assert np.linalg.norm(lap, axis=1).max() < 0.04
    # Half a piece veers by a degree before its anchor: so much the whole map may be turned about its start.
    T_truth_map = SE2.fit(settled[:, :2], array(truth)[:, :2])
    assert abs(T_truth_map.yaw) < math.radians(1.0)
    assert np.linalg.norm(T_truth_map.apply(settled[:, :2]) - array(truth)[:, :2], axis=1).max() < 0.04
    for loop in found.loops:
        assert loop.older < loop.newer
        apart = (truth[loop.older].inverse() @ truth[loop.newer]).inverse() @ loop.T_older_newer
        assert math.hypot(apart.x, apart.y) < 0.1 and abs(apart.yaw) < 0.03
        # The information is right about the size of that error: 16 is beyond 0.1 % of what it promises.
        error = np.array([apart.x, apart.y, apart.yaw])
        assert error @ loop.information @ error < 16.0 and np.linalg.eigvalsh(loop.information)[0] > 10.0
    assert sum(loop.accepted for loop in found.loops) > 0.9 * len(found.loops)


def test_a_lost_stretch_is_a_guess_and_its_error_stays_in_it():
    """After the first lap tracking is lost, and begins anew 1 m and 10 degrees beside the truth."""
    truth = square(100) * 2
    beside = truth[100] @ SE2(0.8, -0.6, math.radians(10.0)) @ truth[100].inverse()
    poses = truth[:100] + [beside @ pose for pose in truth[100:]]
    settled, found = closed(poses, [ring_sweep(pose, BLOCK) for pose in truth], restart=100)
    assert {99, 100} <= set(found.scans.tolist())
    apart = np.linalg.norm(settled[:, :2] - array(truth)[:, :2], axis=1)
    assert apart.max() < 0.1


def test_work_and_ties_grow_with_the_way_and_not_with_its_square():
    """A lap more does not add to what each piece is compared with."""
    tried = []
    for laps in (2, 3, 4):
        truth = square(30) * laps
        sweeps = [ring_sweep(pose, BLOCK) for pose in truth[:30]] * laps
        found = closed(truth, sweeps)[1]
        tried.append(found.tried)
        assert found.loops and len(found.loops) <= found.tried
    assert tried[2] - tried[1] <= 1.1 * (tried[1] - tried[0])


def test_keyframes_come_back_from_a_file_as_they_were():
    small, spilled = Keyframes(), Keyframes(in_memory_bytes=1)
    rng = np.random.default_rng(0)
    kept = []
    for k in range(20):
        sweep = Sweep(
            stamp_ns=2**60 + k,
            hits_m=rng.normal(size=(k, 2)).astype(np.float32),
            origin_m=rng.normal(size=2),
            free_m=rng.random(8).astype(np.float32),
        )
        glimpses = rng.normal(size=(20 - k, 2)).astype(np.float32)
        kept.append(Keyframe(3 * k, sweep, SE2(*rng.normal(size=3)), k == 7, glimpses))
        small.append(kept[-1])
        spilled.append(kept[-1])
        spilled[k // 2]  # reading moves the file; the next goes to its end all the same
    for keyframes in (small, spilled):
        assert len(keyframes) == 20
        for got, want in zip(keyframes, kept, strict=True):
            assert (got.index, got.restart, got.T_map_base) == (want.index, want.restart, want.T_map_base)
            assert got.sweep.stamp_ns == want.sweep.stamp_ns
            for name in ("hits_m", "origin_m", "free_m"):
                assert np.array_equal(getattr(got.sweep, name), getattr(want.sweep, name))
            assert np.array_equal(got.glimpses_m, want.glimpses_m)
        keyframes.close()


def test_a_full_disk_under_the_keyframes_is_an_error_of_ours(monkeypatch):
    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.SpooledTemporaryFile", lambda max_size: Full())
    sweep = ring_sweep(SE2(), BLOCK)
    with pytest.raises(OutputError, match="no room for the scans of the map: No space left") as caught:
        Keyframes().append(Keyframe(0, sweep, SE2()))
    assert "TMPDIR" in caught.value.hint
