"""Two equal corridors with equal rooms: nothing but the travel tells one from the other."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan
from pc2grid.geometry import F64, SE2
from pc2grid.mapping.keyframes import Keyframe, Keyframes
from pc2grid.mapping.loops import LoopCloser
from signature.config import Config
from signature.localization.place_recognition import SessionRecognizer

LENGTH_M, PITCH_M, ROOM_M, APART_M, STEP_M = 42.0, 7.0, 5.0, 16.0, 0.3


def equal_corridors() -> F64:
    """Walls (W, 2, 2) of two parallel corridors 2 m wide, `APART_M` apart and joined at both ends, with a
    furnished room on their left every `PITCH_M`; all rooms are the same."""
    walls: list[tuple[tuple[float, float], tuple[float, float]]] = []
    for y in (0.0, APART_M):
        top, back = y + 1.0, y + 1.0 + ROOM_M
        for x in np.arange(0.0, LENGTH_M, PITCH_M).tolist():
            left, right = x + 1.0, x + PITCH_M
            walls += [((x, top), (x + 3.0, top)), ((x + 4.0, top), (right, top))]
            walls += [
                ((left, top), (left, back)),
                ((left, back), (right, back)),
                ((right, back), (right, top)),
            ]
            walls += [
                ((left + 0.5, back - 1.0), (left + 2.0, back - 1.0)),
                ((right - 1.0, y + 3.0), (right, y + 3.0)),
            ]
        walls += [((2.0, y - 1.0), (LENGTH_M - 2.0, y - 1.0))] if y else []
    walls += [((-2.0, -1.0), (LENGTH_M + 2.0, -1.0)), ((-2.0, APART_M + 1.0), (0.0, APART_M + 1.0))]
    walls += [
        ((-2.0, -1.0), (-2.0, APART_M + 1.0)),
        ((LENGTH_M + 2.0, -1.0), (LENGTH_M + 2.0, APART_M + 1.0)),
    ]
    walls += [((LENGTH_M, APART_M + 1.0), (LENGTH_M + 2.0, APART_M + 1.0))]
    walls += [((0.0, 1.0), (0.0, APART_M - 1.0)), ((LENGTH_M, 1.0), (LENGTH_M, APART_M - 1.0))]
    walls += [
        ((0.0, APART_M - 1.0), (2.0, APART_M - 1.0)),
        ((LENGTH_M - 2.0, APART_M - 1.0), (LENGTH_M, APART_M - 1.0)),
    ]
    return np.array(walls)


def driven(rng: np.random.Generator) -> list[SE2]:
    """True poses of a drive through the first corridor, back through the second, and into the first again;
    some rooms are visited."""
    points: list[tuple[float, float]] = [(-1.0, 0.0)]
    for y, forward in ((0.0, True), (APART_M, False), (0.0, True)):
        doors = np.arange(0.0, LENGTH_M, PITCH_M) + 3.5
        points.append((-1.0 if forward else LENGTH_M + 1.0, y))
        for door in doors if forward else doors[::-1]:
            if rng.random() < 0.4:
                points += [(door, y), (door, y + 2.5), (door, y)]
        points.append((LENGTH_M + 1.0 if forward else -1.0, y))
    poses: list[SE2] = []
    for (x, y), (to_x, to_y) in pairwise(points):
        length, yaw = math.hypot(to_x - x, to_y - y), math.atan2(to_y - y, to_x - x)
        for k in range(round(length / STEP_M)):
            share = k * STEP_M / length
            poses.append(SE2(x + share * (to_x - x), y + share * (to_y - y), yaw))
    return poses


def tracked(truth: list[SE2], rng: np.random.Generator) -> list[SE2]:
    """The poses with drift: up to 2 % of the way and 0.05 degrees per metre, and some noise."""
    scale = 1.0 + rng.uniform(-0.02, 0.02)
    veer = math.radians(rng.uniform(-0.05, 0.05))
    poses = [truth[0]]
    for before, after in pairwise(truth):
        step = before.inverse() @ after
        length = math.hypot(step.x, step.y)
        noise = rng.normal(0.0, math.radians(0.1))
        poses.append(poses[-1] @ SE2(scale * step.x, scale * step.y, step.yaw + veer * length + noise))
    return poses


def scan_at(pose: SE2, walls: F64, rng: np.random.Generator) -> PlanarScan:
    """The planar scan of a laser that looks all around, 15 m far, with 1 cm of noise."""
    bearings = np.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    along = np.column_stack((np.cos(bearings + pose.yaw), np.sin(bearings + pose.yaw)))
    d, o = (walls[:, 1] - walls[:, 0])[:, None], (walls[:, 0] - (pose.x, pose.y))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = along[:, 0] * d[..., 1] - along[:, 1] * d[..., 0]
        t = (o[..., 0] * d[..., 1] - o[..., 1] * d[..., 0]) / cross
        u = (o[..., 0] * along[:, 1] - o[..., 1] * along[:, 0]) / cross
    ranges = np.where((t > 0) & (u >= 0) & (u <= 1), t, np.inf).min(axis=0)
    seen = ranges < 15.0
    noisy = ranges + rng.normal(0.0, 0.01, len(ranges))
    hits = np.column_stack((np.cos(bearings), np.sin(bearings)))[seen] * noisy[seen, None]
    return PlanarScan.of_hits(
        stamp_ns=0,
        hits_m=hits.astype(np.float32),
        origin_m=np.zeros(2),
        free_m=np.where(seen, noisy, 0).astype(np.float32),
    )


def closed(seed: int) -> tuple[int, int, int]:
    """Loops of a drive: accepted ones, false ones among these, and those between visits of one corridor."""
    rng = np.random.default_rng(seed)
    walls, truth = equal_corridors(), driven(rng)
    poses = tracked(truth, rng)
    closer = LoopCloser(Keyframes(), recognizer=SessionRecognizer(Config()))
    for k, (pose, true) in enumerate(zip(poses, truth, strict=True)):
        closer.add(Keyframe(k, scan_at(true, walls, rng), pose))
    accepted = [loop for loop in closer.finish().loops if loop.accepted]
    false = again = 0
    for loop in accepted:
        off = (truth[loop.older].inverse() @ truth[loop.newer]).inverse() @ loop.T_older_newer
        false += math.hypot(off.x, off.y) > 0.5 or abs(off.yaw) > math.radians(5.0)
        again += loop.newer - loop.older > 200
    return len(accepted), false, again


@pytest.mark.parametrize("seed", [0, 1])
def test_equal_corridors_are_not_folded(seed: int) -> None:
    accepted, false, again = closed(seed)
    assert accepted > 0 and false == 0 and again > 0
