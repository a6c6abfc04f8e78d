"""The axes of a building hold the headings where no loop does, and only where the walls are right-angled."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2, wrap_angle
from pc2grid.mapping.graph import Edge, WallDirection, optimise
from pc2grid.mapping.loops import LOOPS
from pc2grid.mapping.quality import position_sigmas

STEP_M = 4.0
STEP_INFORMATION = LOOPS.tracked_information(STEP_M, restart=False)


def corridor(headings_rad: list[float]) -> np.ndarray:
    """Poses (N, 3) of a drive with these headings, 4 m from pose to pose."""
    poses = [(0.0, 0.0, headings_rad[0])]
    for heading in headings_rad[1:]:
        x, y, yaw = poses[-1]
        poses.append((x + STEP_M * math.cos(yaw), y + STEP_M * math.sin(yaw), heading))
    return np.array(poses)


def tracked(truth: np.ndarray, error_rad: np.ndarray) -> tuple[np.ndarray, list[Edge]]:
    """The poses and steps of a drive whose tracking turns by `error_rad` (N - 1,) too much in each step."""
    poses = [SE2(*truth[0])]
    edges = []
    for k, turned in enumerate(error_rad):
        step = SE2(*truth[k]).inverse() @ SE2(*truth[k + 1])
        step = SE2(step.x, step.y, step.yaw + turned)
        poses.append(poses[-1] @ step)
        edges.append(Edge(k, k + 1, step, STEP_INFORMATION))
    return np.array([(p.x, p.y, p.yaw) for p in poses]), edges


def walls_seen(truth: np.ndarray, wall_rad: np.ndarray | float) -> list[WallDirection]:
    """What drives past walls with these directions (N,) in the world show in the frame of each pose."""
    right = math.pi / 2
    seen = (wall_rad - truth[:, 2] + right / 2) % right - right / 2
    noise = np.random.default_rng(1).normal(0.0, math.radians(0.8), len(truth))
    return [WallDirection(float(angle), 0.8) for angle in seen + noise]


def off(poses: np.ndarray, truth: np.ndarray) -> float:
    """RMS distance in metres after the poses were placed on the truth."""
    placed = SE2.fit(poses[:, :2], truth[:, :2]).apply(poses[:, :2])
    return float(np.sqrt(((placed - truth[:, :2]) ** 2).sum(axis=1).mean()))


DRIFT_RAD = np.random.default_rng(3).normal(0.0, math.radians(0.3), 99)
"""What loop closure expects of tracking: 3 degrees after 99 steps."""
TURNING = [0.0] * 50 + [math.pi / 2] * 50


def test_axes_straighten_a_drive_without_loops() -> None:
    truth = corridor(TURNING)
    poses, edges = tracked(truth, DRIFT_RAD)
    held = optimise(poses, edges, walls_seen(truth, 0.0)).poses
    assert np.allclose(optimise(poses, edges).poses, poses)
    assert off(held, truth) < 0.5 * off(poses, truth)


def test_the_frame_of_a_building_does_not_matter() -> None:
    truth = corridor([heading + 0.7 for heading in TURNING])
    poses, edges = tracked(truth, DRIFT_RAD)
    held = optimise(poses, edges, walls_seen(truth, 0.7)).poses
    assert off(held, truth) < 0.5 * off(poses, truth)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_walls_in_any_direction_leave_a_drive_as_it_is(seed: int) -> None:
    truth = corridor(TURNING)
    poses, edges = tracked(truth, np.zeros(len(truth) - 1))
    anyhow = np.random.default_rng(seed).uniform(0.0, math.pi / 2, len(truth))
    held = optimise(poses, edges, walls_seen(truth, anyhow)).poses
    assert off(held, truth) < 0.2 * off(tracked(truth, DRIFT_RAD)[0], truth)


def test_a_wing_at_another_angle_keeps_it() -> None:
    skew = math.radians(8.0)
    truth = corridor([0.0] * 30 + [skew] * 20)
    poses, edges = tracked(truth, np.zeros(len(truth) - 1))
    wall = np.array([0.0] * 30 + [skew] * 20)
    held = optimise(poses, edges, walls_seen(truth, wall)).poses
    turned = wrap_angle(held[35:, 2].mean() - held[:25, 2].mean())
    assert turned == pytest.approx(skew, abs=math.radians(1.0))


def test_a_heading_that_the_axes_hold_is_stated_to_be_more_precise() -> None:
    truth = corridor(TURNING)
    _, edges = tracked(truth, np.zeros(len(truth) - 1))
    alone, _ = position_sigmas(truth, edges)
    held, _ = position_sigmas(truth, edges, walls_seen(truth, 0.0))
    assert held.max() < 0.7 * alone.max()
