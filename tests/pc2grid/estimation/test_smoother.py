"""The smoother: every fault of odometry is an input of one test, and the oracle is a larger window."""

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from pc2grid.estimation.line_map import moved, steps
from pc2grid.estimation.smoother import (
    IN_THE_HAND,
    PLANAR,
    SMOOTHER,
    SPATIAL,
    PoseWithCovariance,
    Smoother,
    _without,
    normal_equations,
)
from pc2grid.geometry import F64, SE2, invert_pose, motion_size, pose_from_rotation_vector, skew
from tests.helpers.plain_smoother import plain_equations


def rotation_vectors(rotations: F64) -> F64:
    """Rotation vectors (N, 3) of rotation matrices (N, 3, 3)."""
    R = rotations
    twice = np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1)
    twice_sine = np.linalg.norm(twice, axis=1)
    angle = np.arctan2(twice_sine, np.einsum("naa->n", R) - 1.0)
    small = twice_sine < 1e-9
    result: F64 = twice * np.where(small, 0.5, angle / np.where(small, 1.0, twice_sine))[:, None]
    return result


def steps_plain(first: F64, second: F64) -> tuple[F64, F64, F64]:
    """`steps`, in numpy."""
    R = first[:, :3, :3].transpose(0, 2, 1)
    turn = R @ second[:, :3, :3]
    step = np.empty((len(first), 6))
    step[:, :3] = np.einsum("nab,nb->na", R, second[:, :3, 3] - first[:, :3, 3])
    step[:, 3:] = rotation_vectors(turn)
    # Of the rotation vector only the first term of the series is needed: steps are small, or count little.
    right = np.eye(3) + 0.5 * skew(step[:, 3:])
    by_first, by_second = np.zeros((len(first), 6, 6)), np.zeros((len(first), 6, 6))
    by_first[:, :3, :3] = -np.eye(3)
    by_first[:, :3, 3:] = skew(step[:, :3])
    by_first[:, 3:, 3:] = -right @ turn.transpose(0, 2, 1)
    by_second[:, :3, :3] = turn
    by_second[:, 3:, 3:] = right
    return step, by_first, by_second


Odometry = list[F64] | list[None]
WALLS_ALL_AROUND = np.diag([0.01**-2, 0.01**-2, 0.004**-2])
CORRIDOR = np.diag([5.0**-2, 0.01**-2, 0.004**-2])  # the scan says nothing along it
STEP = SE2(0.04, 0.0, 0.0)  # 0.4 m/s at 10 Hz
TURN = SE2(0.04, 0.0, 0.05)


def drive(scans: int = 60, turning: bool = True) -> list[F64]:
    """Straight on for two seconds, a turn of one radian, straight on."""
    pose, poses = SE2(), []
    for k in range(scans):
        poses.append(pose.lift())
        pose = pose @ (TURN if turning and 20 <= k < 40 else STEP)
    return poses


def wheels(true: list[F64], way: float = 1.0, turn: float = 1.0) -> list[F64]:
    """Odometry that reports this share of every distance and of every turn."""
    poses = [np.eye(4)]
    for a, b in itertools.pairwise(true):
        step = SE2.from_matrix(invert_pose(a) @ b)
        poses.append(poses[-1] @ SE2(way * step.x, way * step.y, turn * step.yaw).lift())
    return poses


def follow(true: list[F64], odometry: Odometry, information: F64, seed: int = 1) -> F64:
    """Error (N, 2), metres and radians, of the last pose after each scan.

    A scan is placed with 0.3 of the deviations that it states, which is what real ones do: they are
    correlated.
    """
    rng, smoother = np.random.default_rng(seed), Smoother(PLANAR)
    smoother.start(true[0], odometry[0])
    blind = information[0, 0] < 1.0
    found = [true[0]]
    for pose, reading in zip(true[1:], odometry[1:], strict=True):
        noise = rng.normal(size=3) * 0.3 / np.sqrt(np.diag(information))
        noise[0] *= not blind
        placed = pose @ SE2(*noise.tolist()).lift()
        expected = (
            smoother.after(*smoother.constant_velocity(0.1))
            if reading is None
            else smoother.by_odometry(reading)
        )
        guess = expected.pose if blind else placed
        belief = smoother.add(guess, 0.1, reading, match=(placed, information))
        found.append(belief.pose)
    return np.array([motion_size(invert_pose(t) @ f) for t, f in zip(true, found, strict=True)])


def late(odometry: list[F64]) -> list[F64]:
    """It stands still for eight scans and catches up."""
    return [odometry[20] if 20 < k < 28 else pose for k, pose in enumerate(odometry)]


def bunched(odometry: list[F64]) -> list[F64]:
    """Readings arrive three at a time."""
    return [odometry[k - k % 3] for k in range(len(odometry))]


def restarted(odometry: list[F64]) -> list[F64]:
    """A driver that begins again at zero."""
    return [pose if k < 30 else invert_pose(odometry[30]) @ pose for k, pose in enumerate(odometry)]


def coarse(odometry: list[F64]) -> list[F64]:
    """Logged to 10 cm."""
    return [SE2(round(p.x, 1), round(p.y, 1), p.yaw).lift() for p in map(SE2.from_matrix, odometry)]


FAULTS: dict[str, Callable[[list[F64]], Odometry]] = {
    "none": lambda true: wheels(true),
    "late": lambda true: late(wheels(true)),
    "bunched": lambda true: bunched(wheels(true)),
    "restarted": lambda true: restarted(wheels(true)),
    "logged coarsely": lambda true: coarse(wheels(true)),
    "a tenth too short, turns a tenth too far": lambda true: wheels(true, 0.9, 1.1),
    "the wrong sign": lambda true: wheels(true, -1.0),
    "mirrored": lambda true: wheels(true, 1.0, -1.0),
    "no odometry": lambda true: [None] * len(true),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_where_walls_are_all_around_no_fault_of_odometry_moves_the_pose(fault: str) -> None:
    """Half of a step of 0.04 m would be half of a motion missed or counted twice."""
    true = drive()
    error = follow(true, FAULTS[fault](true), WALLS_ALL_AROUND)
    assert error[:, 0].max() < 0.02 and np.degrees(error[:, 1].max()) < 0.4


def test_along_a_corridor_odometry_decides() -> None:
    true = drive(turning=False)
    assert follow(true, wheels(true), CORRIDOR)[:, 0].max() < 0.012


def test_along_a_corridor_odometry_that_was_late_is_followed_again() -> None:
    """While it stands still nothing says that the robot moves: 0.28 m are 7 steps of 0.04 m."""
    true = drive(turning=False)
    error = follow(true, late(wheels(true)), CORRIDOR)[:, 0]
    assert error[20:28].max() < 0.29 and error[29:].max() < 0.02


def test_the_systematic_errors_of_odometry_are_learned() -> None:
    """Along a corridor it then errs by less than a tenth of what it would without."""
    true = drive(300)
    smoother = Smoother(PLANAR)
    odometry = wheels(true, 0.95, 1.0)
    smoother.start(true[0], odometry[0])
    for pose, reading in zip(true[1:], odometry[1:], strict=True):
        smoother.add(pose, 0.1, reading, match=(pose, WALLS_ALL_AROUND))
    ahead = odometry[-1] @ SE2(0.95, 0.0, 0.0).lift()
    expected = smoother.by_odometry(ahead).pose
    off_m, _ = motion_size(invert_pose(true[-1] @ SE2(1.0, 0.0, 0.0).lift()) @ expected)
    assert off_m < 0.02  # it would be 0.05


def test_one_scan_that_lies_elsewhere_is_left_out_after_the_next_ones() -> None:
    true, smoother = drive(40), Smoother(PLANAR)
    odometry = wheels(true)
    smoother.start(true[0], odometry[0])
    for k, (pose, reading) in enumerate(zip(true[1:], odometry[1:], strict=True)):
        placed = pose @ SE2(0.5, 0.0, 0.0).lift() if k == 25 else pose
        expected = smoother.by_odometry(reading).pose
        belief = smoother.add(expected, 0.1, reading, match=(placed, WALLS_ALL_AROUND))
    assert motion_size(invert_pose(true[-1]) @ belief.pose)[0] < 0.005


def test_a_belief_says_how_far_off_it_is() -> None:
    """Normalised errors squared of x, y, yaw are 3 in the mean; a scan states three times its error here."""
    true = drive(turning=False)
    rng, chi2 = np.random.default_rng(4), []
    for _ in range(20):
        smoother = Smoother(PLANAR)
        smoother.start(true[0], true[0])
        for pose in true[1:20]:
            noise = rng.normal(size=3) / np.sqrt(np.diag(WALLS_ALL_AROUND))
            placed = pose @ SE2(*noise.tolist()).lift()
            belief = smoother.add(placed, 0.1, pose, match=(placed, WALLS_ALL_AROUND))
        chi2.append(belief.chi2(true[19]))
    assert 1.0 < np.mean(chi2) < 4.5


def test_in_the_hand_six_directions_are_estimated() -> None:
    """A hand that turns and rises, without odometry: half of the scans are left out, and it is followed."""
    rng, pose, smoother = np.random.default_rng(2), np.eye(4), Smoother(SPATIAL)
    information = np.diag([0.005**-2] * 3 + [0.003**-2] * 3)
    smoother.start(pose, None)
    for k in range(40):
        pose = pose @ pose_from_rotation_vector((0.01, -0.02, 0.05), (0.03, 0.0, 0.01))
        noise = rng.normal(size=(1, 6)) / np.sqrt(np.diag(information))
        match = (moved(pose[None], noise)[0], information) if k % 2 else None
        belief = smoother.add(smoother.after(*smoother.constant_velocity(0.1)).pose, 0.1, match=match)
    assert motion_size(invert_pose(pose) @ belief.pose)[0] < 0.02  # half of a step, too


def some_poses(count: int, seed: int) -> F64:
    rng = np.random.default_rng(seed)
    return np.array([pose_from_rotation_vector(rng.normal(size=3), rng.normal(size=3)) for _ in range(count)])


def test_steps_and_their_derivatives() -> None:
    first, second = some_poses(6, 0), some_poses(6, 1)
    for compiled, plain in zip(steps(first, second), steps_plain(first, second), strict=True):
        np.testing.assert_allclose(compiled, plain, atol=1e-12)
    near = moved(first, np.full((6, 6), 0.01))
    step, by_first, by_second = steps(first, near)
    for k in range(6):
        change = 1e-6 * np.eye(6)[k]
        numeric = (steps(first, moved(near, np.tile(change, (6, 1))))[0] - step) / 1e-6
        np.testing.assert_allclose(by_second[:, :, k], numeric, atol=1e-3)
        numeric = (steps(moved(first, np.tile(change, (6, 1))), near)[0] - step) / 1e-6
        np.testing.assert_allclose(by_first[:, :, k], numeric, atol=1e-3)


@pytest.mark.parametrize("free", [PLANAR, SPATIAL])
@pytest.mark.parametrize("few", [1, 8])
def test_the_compiled_equations_are_the_plain_ones(free: tuple[int, ...], few: int) -> None:
    """Of a drive whose odometry jumps, and is missing; whose scans are lost, and follow only each other."""
    rng, true, smoother = np.random.default_rng(5), drive(), Smoother(free, SMOOTHER._replace(lag=8))
    odometry = wheels(true, 0.95, 1.1)
    for k, pose in enumerate(true[10:34]):
        noise = pose_from_rotation_vector(*rng.normal(scale=0.02, size=(2, 3)))
        root, known = rng.normal(size=(2, len(free), len(free))), k % 4 != 1
        placed = pose @ noise, 100.0 * root[0] @ root[0].T
        motion = STEP.lift() @ noise, 10.0 * root[1] @ root[1].T
        reading, match = odometry[10 + k] if k % 7 < 5 else None, placed if known else None
        if k == 0:
            smoother.start(pose, reading)
            continue
        between = motion if k % 5 == 2 else None
        smoother.add(placed[0], 0.08 + 0.01 * (k % 3), reading, k % 6 != 3, match, between)
    own = smoother._state, smoother._window, smoother._prior, smoother._free, smoother._parameters
    H, g, scale = normal_equations(*own, smoother._drift_scale, few)
    smoother._drift_scale = scale
    plain_H, plain_g = plain_equations(smoother, few)
    # Derivatives of a turn are those of its first order.
    unit = np.sqrt(np.diag(plain_H) + 1e-9)
    np.testing.assert_allclose(H / np.outer(unit, unit), plain_H / np.outer(unit, unit), atol=2e-3)
    np.testing.assert_allclose(g / unit, plain_g / unit, atol=1e-3)


def test_what_is_marginalised_leaves_the_same_solution() -> None:
    root, g = np.random.default_rng(3).normal(size=(8, 8)), np.arange(8.0)
    H = root @ root.T + np.eye(8)
    reduced, gradient = _without(H, g, 2)
    rest = [0, 1, 2, 3, 6, 7]
    np.testing.assert_allclose(-np.linalg.solve(H, g)[rest], -np.linalg.solve(reduced, gradient), rtol=1e-6)


def test_the_density_of_a_belief_falls_with_the_distance() -> None:
    belief = PoseWithCovariance(np.eye(4), np.diag([0.1, 0.1, 0.05]) ** 2, np.array(PLANAR))
    densities = [belief.log_density(belief.chi2(SE2(x, 0.0, 0.0).lift())) for x in (0.0, 0.1, 0.3, 3.0)]
    assert densities == sorted(densities, reverse=True)
    assert densities[1] - densities[0] == pytest.approx(-0.5, abs=0.05)  # one standard deviation


def test_a_gyroscope_replaces_the_turn_of_the_motion_before() -> None:
    """Three steps of 0.1 m straight on; then the gyroscope says that the sensor turns."""
    smoother = Smoother(SPATIAL)
    pose, known = np.eye(4), 1e8 * np.eye(6)
    smoother.start(pose, None)
    for _ in range(3):
        pose = pose @ SE2(0.1, 0.0, 0.0).lift()
        smoother.add(pose, 0.1, match=(pose, known))
    turn = pose_from_rotation_vector((0.0, 0.3, 0.0))
    belief = smoother.after(*smoother.constant_velocity(0.1, turn))
    np.testing.assert_allclose(belief.pose[:3, :3], turn[:3, :3], atol=1e-3)
    np.testing.assert_allclose(belief.pose[:3, 3], (0.4, 0.0, 0.0), atol=0.02)
    assert belief.sigmas[1] < 0.1 * smoother.after(*smoother.constant_velocity(0.1)).sigmas[1]


def test_how_far_a_hand_goes_unseen_does_not_depend_on_how_often_it_is_looked_for() -> None:
    """Of one second nothing is known but the motion before: its deviation is the same at 5 and 20 Hz."""
    sigmas = []
    for rate in (5, 20):
        smoother = Smoother(SPATIAL, IN_THE_HAND)
        smoother.start(np.eye(4), None)
        for _ in range(rate):
            belief = smoother.add(np.eye(4), seconds=1.0 / rate)
        sigmas.append(belief.sigmas[0])
    assert sigmas[0] == pytest.approx(sigmas[1], rel=0.3)


def test_after_a_new_beginning_the_motion_goes_on() -> None:
    smoother = Smoother(SPATIAL, IN_THE_HAND)
    smoother.start(np.eye(4), None)
    walked = pose_from_rotation_vector((0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    for _ in range(5):
        smoother.add(smoother.belief.pose @ walked, seconds=0.1, motion=(walked, 1e6 * np.eye(6)))
    smoother.start(np.eye(4), None, smoother.speed)
    on, _ = smoother.constant_velocity(0.1)
    assert on[0, 3] == pytest.approx(0.1, abs=0.01)
