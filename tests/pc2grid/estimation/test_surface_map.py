"""Registration of a carried sensor to the surfaces that it has seen."""

import numpy as np
import pytest

from pc2grid.estimation.line_map import weakest
from pc2grid.estimation.smoother import SPATIAL, PoseWithCovariance
from pc2grid.estimation.surface_map import SURFACES, SurfaceMap
from pc2grid.geometry import F64, invert_pose, motion_size, pose_from_rotation_vector, transform_points
from pc2grid.settings import RegistrationConfig

EDGE_M = 0.15


def held(pose: F64, sigma: float) -> PoseWithCovariance:
    """A prior with one standard deviation, in metres and radians."""
    return PoseWithCovariance(pose, sigma**2 * np.eye(6), np.array(SPATIAL))


def corner(seed: int, faces: tuple[int, ...] = (0, 1, 2)) -> F64:
    """Points (N, 3) of two walls (faces 0 and 1) and a floor (2), 5 mm of noise; each seed has its own."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (3, 5000, 3))
    for axis, at_m in enumerate((1.5, 1.5, -1.0)):
        points[axis, :, axis] = at_m
    chosen: F64 = points[list(faces)].reshape(-1, 3)
    return chosen + 0.005 * rng.standard_normal(chosen.shape)


def seen(points_m: F64) -> SurfaceMap:
    surfaces = SurfaceMap(EDGE_M, 20.0, RegistrationConfig())
    surfaces.add(points_m, np.eye(4))
    return surfaces


def test_three_faces_fix_all_six_degrees_of_freedom() -> None:
    true = pose_from_rotation_vector((0.03, -0.06, 0.05), (0.1, -0.08, 0.05))
    points = transform_points(invert_pose(true), corner(1))
    surfaces, weights = seen(corner(0)), np.ones(len(points))
    pose, _, overlap, measured = surfaces.match(points, weights, np.eye(4), held(np.eye(4), 1e3))
    off_m, off_rad = motion_size(invert_pose(true) @ pose)
    assert off_m < 0.003 and off_rad < 0.003  # of a guess that is 0.14 m and 0.08 rad off
    assert measured and overlap > 0.95


def test_along_a_wall_the_prior_decides_and_the_information_says_so() -> None:
    """A floor and one wall across x: hardly anything fixes y, and everything else is fixed."""
    wall_and_floor = (0, 2)
    true = pose_from_rotation_vector((0.0, 0.0, 0.0), (0.06, 0.0, 0.03))
    points = transform_points(invert_pose(true), corner(1, wall_and_floor))
    expected = pose_from_rotation_vector((0.0, 0.0, 0.0), (0.0, 0.04, 0.0))
    prior = held(expected, 0.05)
    surfaces, weights = seen(corner(0, wall_and_floor)), np.ones(len(points))
    pose, information, _, _ = surfaces.match(points, weights, expected, prior)
    assert np.abs(pose[[0, 2], 3] - (0.06, 0.03)).max() < 0.005
    assert abs(pose[1, 3] - 0.04) < 0.02  # the ends of the wall, 2 m apart, hold a little
    x, y, z = np.diag(information)[:3]
    assert y < 0.2 * min(x, z)


def test_a_floor_alone_does_not_measure_the_position() -> None:
    points = corner(1, (2,))
    middle = points[(np.abs(points[:, :2]) < 0.5).all(axis=1)]
    surfaces, prior = seen(corner(0, (2,))), held(np.eye(4), 1.0)
    _, _, overlap, measured = surfaces.match(middle[:100], np.ones(100), np.eye(4), prior)
    assert overlap == 1.0 and not measured


def test_what_only_seems_to_be_held_is_not() -> None:
    """A floor and one wall with 2 cm of noise: the voxels are uneven, so the tangent says that a shift along
    the wall is measured. Half a voxel aside nothing draws the points back. A corner holds all the same."""
    rng = np.random.default_rng(3)

    def after(faces: tuple[int, ...]) -> tuple[bool, bool, float]:
        """Whether the position seems to be measured, whether it is held, and the share of the information
        in its weakest direction that is left."""
        first, second = (
            corner(k, faces) + 0.02 * rng.standard_normal((5000 * len(faces), 3)) for k in (0, 1)
        )
        middle = second[(np.abs(second[:, 1]) < 0.7) | (second[:, 1] > 1.3)]  # not the ends of wall and floor
        surfaces, weights = seen(first), np.ones(len(middle))
        pose, information, _, measured = surfaces.match(middle, weights, np.eye(4), held(np.eye(4), 1.0))
        kept = surfaces.observable(middle, weights, pose)
        left = weakest(kept.T @ information @ kept) / weakest(information)
        return measured, np.array_equal(kept, np.eye(6)), left

    assert after((0, 2)) == (True, False, pytest.approx(0.0, abs=1e-6))
    assert after((0, 1, 2)) == (True, True, pytest.approx(1.0))


def test_a_scan_of_another_place_does_not_overlap() -> None:
    elsewhere = corner(1) + np.array([0.0, 0.0, 9.0])
    surfaces, weights = seen(corner(0)), np.ones(len(elsewhere))
    pose, _, overlap, _ = surfaces.match(elsewhere, weights, np.eye(4), held(np.eye(4), 1.0))
    assert overlap == 0.0
    assert np.allclose(pose, np.eye(4))  # nothing moves it from where it is expected


def test_what_is_far_behind_is_forgotten() -> None:
    """Five rooms, ten metres from one to the next, and a reach of eight: those of one and a half stay."""
    surfaces, sizes = SurfaceMap(EDGE_M, 8.0, RegistrationConfig()), []
    for k in range(5):
        surfaces.add(corner(k), pose_from_rotation_vector((0.0, 0.0, 0.0), (10.0 * k, 0.0, 0.0)))
        sizes.append(len(surfaces.fine))
    assert sizes[-1] < 1.5 * sizes[0]
    assert surfaces.fine.shapes[:, 0].min() > 29.0


def test_every_run_gives_the_same_bytes() -> None:
    def pose() -> bytes:
        points = corner(1) + 0.01
        prior = held(np.eye(4), 1.0)
        return seen(corner(0)).match(points, np.ones(len(points)), np.eye(4), prior)[0].tobytes()

    assert pose() == pose()


def test_the_equations_are_those_of_points_and_planes() -> None:
    """One voxel with a plane x = 0.5: H and g by numpy, as the textbook says."""
    rng = np.random.default_rng(3)
    inside = np.column_stack((np.full(400, 0.5), rng.uniform(0.01, 0.99, (400, 2))))
    surfaces = SurfaceMap(1.0, 20.0, RegistrationConfig())
    surfaces.add(inside, np.eye(4))
    points = np.array([(0.6, 0.4, 0.5), (0.45, 0.6, 0.6)])
    H, g, found = surfaces.fine.equations(points, np.ones(2), np.eye(4), 1e6)
    held = 1.0 - 0.02**2 / (inside[:, 1:].var(axis=0).max() + 0.02**2)  # less what the widest direction has
    normal, mean = np.array((1.0, 0.0, 0.0)), inside.mean(axis=0)
    J = np.hstack((np.tile(normal, (2, 1)), np.cross(points, normal)))
    r = (points - mean) @ normal
    assert found == 2.0
    assert np.allclose(H, held * J.T @ J, atol=0.01)
    assert np.allclose(g, held * J.T @ r, atol=0.01)


def test_the_first_point_of_each_voxel_is_kept() -> None:
    points = np.array([(0.1, 0.1, 0.1), (0.2, 0.2, 0.2), (1.1, 0.1, 0.1), (-0.1, 0.1, 0.1)], np.float32)
    voxels_of_1_m = SurfaceMap(1.0 / SURFACES.thinning, 20.0, RegistrationConfig())
    assert np.array_equal(voxels_of_1_m.thinned(points), points[[0, 2, 3]])
