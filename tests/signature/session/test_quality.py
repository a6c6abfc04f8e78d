"""A map that is bent is told from a map that is not, by its own scans."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import F64, SE2
from pc2grid.model import Consistency, Health, Precision, Trajectory
from pc2grid.settings import ProjectionConfig
from signature.session.graph import Edge, optimise
from signature.session.keyframes import Keyframe, grid_of
from signature.session.quality import (
    consistency_warning,
    measure_consistency,
    position_sigmas,
    precision_of,
    precision_warning,
)
from tests.helpers.simulated_drives import flat_scan

LENGTH_M, WIDTH_M = 20.0, 2.0
IN_PLACE = SE2()


def scan_of_corridor(at: SE2) -> PlanarScan:
    """What a sensor sees all around in a corridor along x with a wall on either side, up to 10 m."""
    bearings = at.yaw + np.arange(1440) * (2 * math.pi / 1440)
    c, s = np.cos(bearings), np.sin(bearings)
    with np.errstate(divide="ignore"):
        to_end = np.where(c >= 0, (LENGTH_M - at.x) / c, -at.x / c)
        to_side = np.where(s >= 0, (WIDTH_M / 2 - at.y) / s, (-WIDTH_M / 2 - at.y) / s)
    range_m = np.minimum(to_end, to_side)
    hit = range_m < 10.0
    points = at.inverse().apply(np.column_stack((at.x + range_m * c, at.y + range_m * s))[hit])
    return flat_scan(points, np.minimum(range_m, 10.0))


def drive(offset: SE2 = IN_PLACE) -> tuple[list[Keyframe], Trajectory]:
    """There and back along the corridor; the way back is believed to be moved by `offset`."""
    x = np.arange(1.0, LENGTH_M - 1.0, 0.25)
    true = [SE2(float(v), 0.0, 0.0) for v in x] + [SE2(float(v), 0.1, math.pi) for v in x[::-1]]
    believed = [pose if k < len(x) else offset @ pose for k, pose in enumerate(true)]
    keyframes = [
        Keyframe(k, scan_of_corridor(pose), at)
        for k, (pose, at) in enumerate(zip(true, believed, strict=True))
    ]
    return keyframes, Trajectory(
        stamps_ns=np.arange(len(true)) * 10**9, T_session_base=np.array([pose.lift() for pose in believed])
    )


def measured(keyframes: list[Keyframe], trajectory: Trajectory) -> Consistency:
    drawn = grid_of(((keyframe, keyframe.T_session_base) for keyframe in keyframes), ProjectionConfig())
    return measure_consistency(keyframes, drawn, trajectory)


def with_hits(keyframe: Keyframe, more_m: np.ndarray) -> Keyframe:
    """The keyframe with more hits (N, 2), base frame."""
    scan = keyframe.planar_scan
    hits_m = np.vstack((scan.hits_m, more_m)).astype(np.float32)
    return replace(keyframe, planar_scan=replace(scan, hits_m=hits_m, normal_rad=np.zeros(len(hits_m))))


def test_a_corridor_driven_twice_agrees_with_its_map() -> None:
    keyframes, trajectory = drive()
    assert measured(keyframes, trajectory) == Consistency()
    assert consistency_warning(Consistency(), trajectory) is None


@pytest.mark.parametrize(
    "offset", [SE2(0.0, 0.6, 0.0), SE2(0.0, -0.5, 0.0), SE2(0.0, 0.0, math.radians(5.0))]
)
def test_a_way_back_that_is_drawn_aside_is_found_where_it_lies(offset: SE2) -> None:
    keyframes, trajectory = drive(offset)
    found = measured(keyframes, trajectory)
    assert found.bent and found.hits_on_free > 0.05 and found.contradicted > 0.1
    longest = found.stretches[0]
    path = trajectory.planar()
    assert np.hypot(path[:, 0] - longest.x_m, path[:, 1] - longest.y_m).min() < 1e-9
    assert longest.from_ns < longest.to_ns and longest.length_m > 1.0 and longest.share >= 0.2
    lengths = [stretch.length_m for stretch in found.stretches]
    assert lengths == sorted(lengths, reverse=True)
    text = consistency_warning(found, trajectory)
    assert text is not None and "\n" not in text
    assert f"x {longest.x_m:.1f}, y {longest.y_m:.1f} m" in text
    assert f"{longest.from_ns / 1e9:.0f} to {longest.to_ns / 1e9:.0f} s" in text and "--start" in text
    has_it = consistency_warning(found, trajectory, with_odometry=True)
    assert "odometry" in text and has_it is not None and "odometry" not in has_it and "--start" in has_it


def test_people_who_pass_do_not_bend_a_map() -> None:
    keyframes, trajectory = drive()
    rng = np.random.default_rng(3)
    crowded = []
    for keyframe in keyframes:
        # Two people of 0.4 m width, somewhere within 3 m of the robot.
        centres = rng.uniform((-3.0, -0.6), (3.0, 0.6), (2, 2))
        people = (centres[:, None] + np.linspace((-0.2, 0.0), (0.2, 0.0), 8)).reshape(-1, 2)
        crowded.append(with_hits(keyframe, people))
    found = measured(crowded, trajectory)
    assert found.hits_on_free < 0.02
    assert not found.bent


def test_an_object_that_was_there_on_the_way_out_only_does_not_bend_a_map() -> None:
    keyframes, trajectory = drive()
    edge = np.linspace(0.0, 0.6, 25)
    box = np.vstack([np.column_stack((edge + 9.0, 0 * edge + y)) for y in (0.4, 0.9)])
    crowded = []
    for keyframe in keyframes:
        pose = keyframe.T_session_base
        there = keyframe.index < len(keyframes) // 2 and abs(pose.x - 9.3) < 5.0
        crowded.append(with_hits(keyframe, pose.inverse().apply(box)) if there else keyframe)
    assert not measured(crowded, trajectory).bent


# --- How exactly the places of a map are known: the pose graph says it, and repeated drives agree ---


STEP = np.diag([0.03**-2, 0.03**-2, np.radians(0.4) ** -2])
LOOP = np.diag([0.02**-2, 0.02**-2, np.radians(0.2) ** -2])


def hall_and_wing() -> F64:
    """Twice around a hall of 16 by 16 m in steps of 4 m, then 40 m along a wing: poses (N, 3)."""
    side = [(4.0, 0.0, 0.0)] * 4 + [(0.0, 0.0, np.pi / 2)]
    pose, poses = SE2(0.0, 0.0, 0.0), []
    for step in side * 8 + [(4.0, 0.0, 0.0)] * 10:
        poses.append((pose.x, pose.y, pose.yaw))
        pose = pose @ SE2(*step)
    return np.array(poses)


TRUTH = hall_and_wing()
ROUND = 20  # steps of one lap
WING = slice(2 * ROUND + 1, None)


def edges(truth: F64, *, loops: bool = True, rng: np.random.Generator | None = None) -> list[Edge]:
    """Tracked steps, and loops between the laps; with noise as their information says, if `rng` is given."""
    pairs = [(k, k + 1, STEP, False) for k in range(len(truth) - 1)]
    pairs += [(k, k + ROUND, LOOP, True) for k in range(0, ROUND, 2) if loops]
    found = []
    for i, j, information, loop in pairs:
        covariance = np.linalg.inv(information)
        noise = np.zeros(3) if rng is None else rng.multivariate_normal(np.zeros(3), covariance)
        measured = SE2(*truth[i]).inverse() @ SE2(*truth[j]) @ SE2(*noise)
        found.append(Edge(i, j, measured, information, loop=loop))
    return found


def placed(poses: F64, truth: F64) -> F64:
    """Errors (N, 2) of positions after the least squares placement on the truth."""
    return SE2.fit(poses[:, :2], truth[:, :2]).apply(poses[:, :2]) - truth[:, :2]


@pytest.mark.parametrize("loops", [True, False])
def test_repeated_drives_scatter_as_stated(loops: bool) -> None:
    rng = np.random.default_rng(5)
    sigma = position_sigmas(TRUTH, edges(TRUTH, loops=loops))
    errors = np.array(
        [placed(optimise(TRUTH, edges(TRUTH, loops=loops, rng=rng)).poses, TRUTH) for _ in range(80)]
    )
    scatter = np.sqrt([np.linalg.eigvalsh(np.cov(errors[:, k].T))[-1] for k in range(len(TRUTH))])
    assert np.all(np.abs(np.log(scatter / sigma)) < np.log(1.5))
    assert abs(np.log(scatter / sigma).mean()) < 0.2


def test_loops_make_places_surer_and_the_end_of_a_wing_is_known_least() -> None:
    sigma = position_sigmas(TRUTH, edges(TRUTH))
    assert np.all(np.diff(sigma[WING]) > 0.0)
    assert sigma[-1] > 3.0 * np.median(sigma[: 2 * ROUND])
    without = position_sigmas(TRUTH, edges(TRUTH, loops=False))
    assert sigma.max() < 0.7 * without.max()
    back = Edge(0, len(TRUTH) - 1, SE2(*TRUTH[0]).inverse() @ SE2(*TRUTH[-1]), LOOP, loop=True)
    tied = position_sigmas(TRUTH, [*edges(TRUTH), back])
    assert tied[-1] < 0.5 * sigma[-1]


def way(length_m: float = 30.0) -> Trajectory:
    count = round(length_m / 0.5) + 1
    return Trajectory(
        stamps_ns=7 * 10**9 + np.arange(count) * 10**9,
        T_session_base=np.array([SE2(0.5 * k, 1.0, 0.0).lift() for k in range(count)]),
        health=(Health.FINE,) * count,
    )


def test_the_loose_stretch_is_named_with_its_place_and_what_to_do() -> None:
    scans, sigma_m = np.array([4, 12, 20, 28, 36, 44, 52]), np.array([0.1, 0.1, 0.2, 0.3, 0.6, 0.9, 1.2])
    found = precision_of(way(), scans, sigma_m)
    (loose,) = found.loose
    assert (loose.from_ns, loose.to_ns) == (39 * 10**9, 67 * 10**9)  # from scan 32 to the end
    assert (loose.x_m, loose.y_m, loose.sigma_m, loose.length_m) == (26.0, 1.0, 1.2, pytest.approx(14.0))
    assert found.at(int(way().stamps_ns[48])) == pytest.approx(1.05)
    text = precision_warning(found, way())
    assert text is not None
    for part in ("14 m of the travel, 32 to 60 s", "near x 26.0, y 1.0 m", "off by 1.2 m", "come back"):
        assert part in text


def test_a_map_that_is_tied_well_has_no_warning() -> None:
    scans = np.array([4, 12, 20])
    assert precision_warning(precision_of(way(), scans, np.array([0.1, 0.5, 0.2])), way()) is None
    # Less than a local map: nothing to come back to.
    assert precision_of(way(1.0), np.array([1]), np.array([2.0])).loose == ()
    assert precision_of(way(), np.empty(0, np.int64), np.empty(0)) == Precision()
