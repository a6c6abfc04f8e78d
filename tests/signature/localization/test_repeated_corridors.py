"""Two equal corridors with equal rooms: nothing but the travel tells one from the other."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from signature.config import Config
from signature.session.keyframes import Keyframe, Keyframes
from signature.session.loops import LoopCloser, SessionRecognizer
from tests.helpers.simulated_drives import look, plan

PITCH_M, APART_M, STEP_M = 7.0, 16.0, 0.3
ROOM = [(0, 1, 3, 1), (4, 1, 7, 1), (1, 1, 1, 6), (1, 6, 7, 6), (7, 6, 7, 1), (1.5, 5, 3, 5), (6, 3, 7, 3)]
"""On the left of a corridor: its wall with a door, the other three, a table and a shelf."""
ROUND = [
    (0, 1, 0, 15),
    (0, 15, 2, 15),
    (42, 1, 42, 15),
    (40, 15, 42, 15),
    (2, 15, 40, 15),
    (-2, 17, 0, 17),
    (42, 17, 44, 17),
]
"""Walls around the block between the corridors, and beside the ends of the second one."""


def equal_corridors() -> OccupancyGrid:
    """Two parallel corridors 2 m wide, joined at both ends, each with six equal rooms on its left."""
    rooms = [(a + x, b + y, c + x, d + y) for y in (0, 16) for x in range(0, 42, 7) for a, b, c, d in ROOM]
    walls = [(a + 2, b + 1, c + 2, d + 1) for a, b, c, d in [*rooms, *ROUND]]
    return replace(plan(46.0, 24.0, walls), origin_m=(-2.0, -1.0))


def driven(rng: np.random.Generator) -> list[SE2]:
    """True poses of a drive through the first corridor, back through the second, and into the first again;
    some rooms are visited."""
    points: list[tuple[float, float]] = [(-1.0, 0.0)]
    for y, forward in ((0.0, True), (APART_M, False), (0.0, True)):
        doors = np.arange(0.0, 42.0, PITCH_M) + 3.5
        points.append((-1.0 if forward else 43.0, y))
        for door in doors if forward else doors[::-1]:
            if rng.random() < 0.4:
                points += [(door, y), (door, y + 2.5), (door, y)]
        points.append((43.0 if forward else -1.0, y))
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


def closed(seed: int) -> tuple[int, int, int]:
    """Loops of a drive: accepted ones, false ones among these, and those between visits of one corridor."""
    rng = np.random.default_rng(seed)
    grid, truth = equal_corridors(), driven(rng)
    poses = tracked(truth, rng)
    closer = LoopCloser(Keyframes(), recognizer=SessionRecognizer(Config()))
    for k, (pose, true) in enumerate(zip(poses, truth, strict=True)):
        closer.add(Keyframe(k, look(grid, true, 0, 2 * math.pi, 15.0), pose))
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
