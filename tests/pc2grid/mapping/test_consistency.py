"""A map that is bent is told from a map that is not, by its own scans."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.mapping.keyframes import Keyframe, grid_of
from pc2grid.mapping.quality import consistency_warning, measure_consistency
from pc2grid.model import Consistency, Trajectory
from pc2grid.settings import ProjectionConfig

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
    return PlanarScan.of_hits(
        stamp_ns=0,
        hits_m=points.astype(np.float32),
        origin_m=np.zeros(2),
        free_m=np.minimum(range_m, 10.0).astype(np.float32),
    )


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


def test_the_warning_is_one_line_that_names_place_and_time() -> None:
    keyframes, trajectory = drive(SE2(0.0, 0.6, 0.0))
    found = measured(keyframes, trajectory)
    text = consistency_warning(found, trajectory)
    assert text is not None and "\n" not in text
    longest = found.stretches[0]
    assert f"x {longest.x_m:.1f}, y {longest.y_m:.1f} m" in text
    assert f"{longest.from_ns / 1e9:.0f} to {longest.to_ns / 1e9:.0f} s" in text and "--start" in text
    assert consistency_warning(Consistency(), trajectory) is None
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
