"""Registration of a camera in the hand to the surfaces that it has seen."""

import numpy as np

from pc2grid.geometry import invert_pose, pose_from_rotation_vector, transform_points
from pc2grid.odometry.surface_map import SURFACES, SurfaceMap
from pc2grid.odometry.wheel_odometry import motion_size

SENSOR = np.zeros(3)


def corner(seed):
    """Points (N, 3) of a floor and two walls, with 5 mm of noise; each seed has points of its own."""
    rng = np.random.default_rng(seed)
    faces = rng.uniform(-1.0, 1.0, (3, 5000, 3))
    for axis, at_m in enumerate((1.5, 1.5, -1.0)):
        faces[axis, :, axis] = at_m
    return faces.reshape(-1, 3) + 0.005 * rng.standard_normal((15000, 3))


def pose_of(translation_m, rotation_rad):
    pose = pose_from_rotation_vector(np.array(rotation_rad))
    pose[:3, 3] = translation_m
    return pose


def seen_once():
    surfaces = SurfaceMap()
    start = np.eye(4)
    assert np.array_equal(surfaces.refine(corner(0), SENSOR, start), start)
    surfaces.extend(start)
    return surfaces


def test_three_faces_fix_all_six_degrees_of_freedom():
    true = pose_of((0.03, -0.02, 0.02), (0.01, -0.02, 0.02))
    points = transform_points(invert_pose(true), corner(1))
    found = seen_once().refine(points, SENSOR, np.eye(4))
    guessed_m, guessed_rad = motion_size(invert_pose(true))
    off_m, off_rad = motion_size(invert_pose(true) @ found)
    assert guessed_m > 0.04 and guessed_rad > 0.02
    assert off_m < 0.002 and off_rad < 0.002


def test_a_scan_of_another_place_keeps_its_guess():
    elsewhere = corner(1) + np.array([0.0, 0.0, 3.0])
    guess = pose_of((0.01, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert np.array_equal(seen_once().refine(elsewhere, SENSOR, guess), guess)


def test_far_points_count_only_where_there_are_no_near_ones():
    near, far = corner(1), corner(2) * 4.0
    surfaces, alone = seen_once(), seen_once()
    both = surfaces.refine(np.concatenate((near, far)), SENSOR, np.eye(4))
    assert np.array_equal(both, alone.refine(near, SENSOR, np.eye(4)))
    hall = SurfaceMap()
    hall.refine(far, SENSOR, np.eye(4))
    hall.extend(np.eye(4))
    shifted = pose_of((0.03, 0.0, 0.0), (0.0, 0.0, 0.0))
    found = hall.refine(transform_points(invert_pose(shifted), far), SENSOR, np.eye(4))
    assert motion_size(invert_pose(shifted) @ found)[0] < 0.01


def test_every_run_gives_the_same_pose():
    surfaces, points = seen_once(), corner(1) + 0.01
    assert len({surfaces.refine(points, SENSOR, np.eye(4)).tobytes() for _ in range(50)}) == 1


def test_only_the_latest_keyframes_are_kept():
    surfaces = seen_once()
    for k in range(1, SURFACES.keyframes + 5):
        pose = pose_of((0.15 * k, 0.0, 0.0), (0.0, 0.0, 0.0))
        surfaces.refine(corner(k)[::50], SENSOR, pose)
        surfaces.extend(pose)
    assert len(surfaces._keyframes) == SURFACES.keyframes
