"""A session that was lost in between is divided there; loops join what they can."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.model import Health, ReadReport, RegisteredScan, SessionMap, Trajectory
from pc2grid.settings import ProjectionConfig
from signature.session.graph import Edge
from signature.session.keyframes import Keyframe, Keyframes, Track
from signature.session.loops import LoopCloser, LoopParameters, connected
from signature.session.part_maps import (
    OptimisedKeyframes,
    draw_parts,
    height_warnings,
    long_enough,
    part_reports,
    with_track_warnings,
)
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import drive, office

LAP_M = [(2.0, 7.0), (11.0, 7.0), (11.0, 3.0), (9.5, 5.0), (9.5, 7.0), (18.5, 7.0), (16.5, 4.0), (16.5, 7.0)]
"""Along the corridor of the office, and into two of its rooms."""
WITHOUT_LOOPS = LoopParameters(compared=0)


def on_one_floor(trajectory: Trajectory) -> Track:
    """What tracking says of scans on one floor."""
    count = len(trajectory)
    return Track(trajectory=trajectory, disagreements=[None] * count, readings=np.full((count, 4, 4), np.nan))


def keyframes_of(
    blunder: SE2 | None = None, *, lost: bool = False
) -> tuple[list[Keyframe], Trajectory, list[SE2]]:
    """Keyframes of laps through the office, with the true poses.

    blunder : the tracked pose of the second lap is wrong by this from its first scan on. lost : tracking says
        so, because it started again there.
    """
    keyframes, stamps, poses, truths = [], [], [], []
    wrong, middle = SE2(), begin_of_second_lap()
    for registered, planar_scan, truth in two_laps():
        begins = len(poses) == middle
        true_pose = SE2.from_matrix(registered.T_session_base)
        if begins:
            wrong = true_pose @ (blunder or SE2()) @ true_pose.inverse()
        pose = wrong @ true_pose
        keyframes.append(Keyframe(len(poses), planar_scan, pose, restart=lost and begins))
        stamps.append(planar_scan.stamp_ns)
        poses.append(pose.lift())
        truths.append(truth)
    trajectory = Trajectory(
        stamps_ns=np.array(stamps), T_session_base=np.array(poses), health=(Health.FINE,) * len(poses)
    )
    return keyframes, trajectory, truths


@functools.cache
def two_laps() -> list[tuple[RegisteredScan, PlanarScan, SE2]]:
    return list(drive(office(), [*LAP_M, *LAP_M[::-1]]))


@functools.cache
def begin_of_second_lap() -> int:
    return len(list(drive(office(), LAP_M)))


def mapped(
    keyframes: list[Keyframe], trajectory: Trajectory, parameters: LoopParameters
) -> tuple[OptimisedKeyframes, list[SessionMap]]:
    kept = Keyframes()
    closer = LoopCloser(kept, parameters=parameters)
    for keyframe in keyframes:
        closer.add(keyframe)
    closed = closer.finish()
    return closed, draw_parts(kept, on_one_floor(trajectory), closed, ProjectionConfig())


def wrong_m(part: SessionMap, truths: list[SE2], first: int = 0) -> float:
    """Largest distance of the positions of a part, whose first scan is `first`, from the true ones."""
    T_part_map = truths[first].inverse()
    true_m = np.array([(T_part_map @ pose).apply(np.zeros((1, 2)))[0] for pose in truths])
    found_m = part.trajectory.planar()[:, :2]
    return float(np.hypot(*(found_m - true_m[first : first + len(found_m)]).T).max())


def test_a_restart_that_no_loop_joins_gives_two_parts_each_in_its_own_frame() -> None:
    keyframes, trajectory, truths = keyframes_of(SE2(3.0, -2.0, 1.0), lost=True)
    closed, parts = mapped(keyframes, trajectory, WITHOUT_LOOPS)
    middle = begin_of_second_lap()
    assert closed.parts.tolist() == [0] * middle + [1] * (len(truths) - middle)
    assert [len(part.trajectory) for part in parts] == [middle, len(truths) - middle]
    # Tracking is exact here; the axes of the walls move it by less than a millimetre.
    assert wrong_m(parts[0], truths) < 1e-3 and wrong_m(parts[1], truths, middle) < 1e-3
    assert not any(part.consistency is None or part.consistency.bent for part in parts)
    assert parts[1].grid.occupied.any()


def test_a_restart_that_loops_join_gives_one_part() -> None:
    keyframes, trajectory, truths = keyframes_of(SE2(0.8, -0.6, 0.15), lost=True)
    closed, (part,) = mapped(keyframes, trajectory, LoopParameters())
    assert closed.segments.max() == 1 and not closed.parts.any()
    assert any(loop.accepted for loop in part.loops)
    assert wrong_m(part, truths) < 2 * RESOLUTION_M


@pytest.mark.parametrize(
    ("segments", "loops", "parts"),
    [
        ([0] * 6, (), [0] * 6),
        ([0, 0, 1, 1, 2, 2], (), [0, 0, 1, 1, 2, 2]),
        ([0, 0, 1, 1, 2, 2], ((0, 5), (1, 4)), [0, 0, 1, 1, 0, 0]),
        ([0, 0, 1, 1, 2, 2], ((0, 5), (0, 4)), [0, 0, 1, 1, 2, 2]),  # a single room may look like others
        ([0, 0, 1, 1, 2, 2], ((0, 1), (0, 1), (2, 4), (3, 5)), [0, 0, 1, 1, 1, 1]),
    ],
)
def test_loops_join_segments(
    segments: list[int], loops: tuple[tuple[int, int], ...], parts: list[int]
) -> None:
    edges = [Edge(first, second, SE2(), np.eye(3), loop=True) for first, second in loops]
    assert connected(np.array(segments), edges).tolist() == parts


def part_of(length_m: float, begin_ns: int) -> SessionMap:
    count = round(length_m / 0.2) + 1
    poses = np.array([SE2(0.2 * k, 0.0, 0.0).lift() for k in range(count)])
    stamps_ns, health = begin_ns + np.arange(count) * 10**8, (Health.FINE,) * count
    way = Trajectory(stamps_ns=stamps_ns, T_session_base=poses, health=health)
    report = ReadReport(scans_read=count)
    return SessionMap(session="", sensor="laser", grid=office(), submaps=(), trajectory=way, report=report)


def test_a_part_too_short_to_belong_enough_is_left_out_and_counted() -> None:
    long, short, other = part_of(20.0, 0), part_of(3.0, 30 * 10**9), part_of(12.0, 60 * 10**9)
    kept = long_enough([long, short, other])
    assert kept == [long, other]
    read = ReadReport(scans_read=300, bytes_lost=7)
    first, second = part_reports(read, "log", [long, short, other], kept)
    assert first.scans_skipped == {"in a part too short to be of use": len(short.trajectory)}
    assert first.scans_read + second.scans_read == 300 and first.bytes_lost == 7 and not second.lossy
    (warning,) = first.warnings
    assert "log from 0 s (20 m), log#2 from 60 s (12 m); 1 shorter than 8 m left out" in warning
    assert long_enough([short]) == [short]


def test_a_sensor_that_is_carried_to_another_floor_is_told_of_once() -> None:
    heights_m = np.repeat((0.0, 3.0), 10)
    poses = np.tile(np.eye(4), (20, 1, 1))
    stamps_ns = np.arange(20) * 10**9
    way = Trajectory(stamps_ns=stamps_ns, T_session_base=poses, health=(Health.FINE,) * 20)
    (warning,) = height_warnings(heights_m, way)
    assert "changes by 3.0 m" in warning and "from 10 s" in warning
    assert not height_warnings(0.5 * heights_m, way)
    assert not height_warnings(np.full(20, np.nan), way)
    poses[:, 2, 3] = heights_m
    track = replace(on_one_floor(way), readings=poses, left_out=3, warning="so")
    report = with_track_warnings(ReadReport(), track)
    assert report.warnings == ("so", warning) and list(report.scans_skipped.values()) == [3]
