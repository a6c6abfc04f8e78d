"""The map of columns: a room with a table, seen by a camera at the height of a hand that looks down."""

import math

import numpy as np
import pytest

from pc2grid.clouds.columns import ColumnMap
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import F32, F64, SE2
from pc2grid.settings import ProjectionConfig
from pc2grid.simulate.scene import Scene, prism

EYE = np.array((1.0, 2.0, 1.5))
CONFIG = ProjectionConfig()


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> F32:
    """The six faces of a box."""
    (a, b, bottom), (c, d, top) = low, high
    return prism(np.array([(a, b), (c, b), (c, d), (a, d)]), bottom, top)


def room() -> Scene:
    """5 x 4 m and 2.5 m high, with a table: its top is 1 x 2 m, 0.72 m high, and 2 m from the eye."""
    return Scene(
        np.concatenate([box((0.0, 0.0, 0.0), (5.0, 4.0, 2.5)), box((3.0, 1.0, 0.70), (4.0, 3.0, 0.72))])
    )


def looks(scene: Scene, pitches_deg: tuple[float, ...], yaws_deg: tuple[float, ...]) -> list[F64]:
    """Points (N, 3) of images of 64 x 48 degrees, pitched down, seen from `EYE`."""
    up, side = np.meshgrid(
        np.tan(np.radians(np.linspace(-24, 24, 97))), np.tan(np.radians(np.linspace(-32, 32, 129)))
    )
    images = []
    for pitch in np.radians(pitches_deg):
        for yaw in np.radians(yaws_deg):
            forward = np.array(
                (math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), -math.sin(pitch))
            )
            left = np.array((-math.sin(yaw), math.cos(yaw), 0.0))
            rays = forward + side.reshape(-1, 1) * left + up.reshape(-1, 1) * np.cross(forward, left)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            away = scene.cast(np.hstack((np.tile(EYE, (len(rays), 1)), rays)).astype(np.float32))
            images.append(EYE + away[np.isfinite(away), None] * rays[np.isfinite(away)])
    return images


@pytest.fixture(scope="module")
def planar_scan() -> PlanarScan:
    columns = ColumnMap(6.0, "depth", CONFIG)
    for points in looks(room(), (0.0, 20.0, 40.0), tuple(range(-180, 180, 30))):
        columns.add(points, points, EYE, 0.0)
    return columns.cut(SE2(), EYE, 7)


def test_the_walls_of_the_room_are_hits_and_the_table_is_not(planar_scan: PlanarScan) -> None:
    x, y = planar_scan.hits_m.T
    off_m = np.minimum.reduce([np.abs(x), np.abs(x - 5.0), np.abs(y), np.abs(y - 4.0)])
    assert len(x) > 250 and off_m.max() < 0.05  # 18 m of walls, a cell of 0.05 m


def test_a_step_is_low_and_no_wall() -> None:
    """A platform of 0.3 m, from x = 3 to the wall: its edge is an obstacle of little height."""
    scene = Scene(
        np.concatenate([box((0.0, 0.0, 0.0), (5.0, 4.0, 2.5)), box((3.0, 0.0, 0.0), (5.0, 4.0, 0.3))])
    )
    columns = ColumnMap(6.0, "depth", CONFIG)
    for points in looks(scene, (0.0, 25.0, 45.0), (-30.0, 0.0, 30.0)):
        columns.add(points, points, EYE, 0.0)
    found = columns.cut(SE2(), EYE, 0)
    inside = (np.abs(found.hits_m - (2.5, 2.0)) < (2.3, 1.8)).all(axis=1)
    assert not inside.any()
    assert (np.abs(found.low_m[:, 0] - 3.1) < 0.2).any()


@pytest.mark.parametrize(("doubt_m", "is_floor"), [(0.0, False), (0.3, True)])
def test_what_lies_within_the_doubt_of_the_floor_is_floor(doubt_m: float, is_floor: bool) -> None:
    """The floor was expected 0.35 m lower: it is an obstacle, unless that is how far it is known."""
    columns = ColumnMap(6.0, "depth", CONFIG)
    scene = Scene(box((0.0, 0.0, 0.0), (5.0, 4.0, 2.5)))
    for points in looks(scene, (25.0, 45.0), (-30.0, 0.0, 30.0)):
        columns.add(points, points, EYE, -0.35, doubt_m)
    found = columns.cut(SE2(), EYE, 0)
    inside = (np.abs(found.low_m - (2.5, 2.0)) < (2.3, 1.8)).all(axis=1)
    assert inside.any() != is_floor
    assert found.free_m[0] > 1.0


def test_what_has_gone_is_forgotten() -> None:
    """A cupboard stands 2 m ahead; it is carried away, and the wall behind it is seen a few times."""
    with_cupboard = Scene(
        np.concatenate([box((0.0, 0.0, 0.0), (5.0, 4.0, 2.5)), box((3.0, 1.5, 0.0), (3.5, 2.5, 2.0))])
    )
    without = Scene(box((0.0, 0.0, 0.0), (5.0, 4.0, 2.5)))
    columns = ColumnMap(6.0, "depth", CONFIG)
    free_m = []
    for scene, times in ((with_cupboard, 3), (without, 20)):
        for _ in range(times):
            for points in looks(scene, (0.0, 20.0), (0.0,)):
                columns.add(points, points, EYE, 0.0)
        free_m.append(float(columns.cut(SE2(), EYE, 0).free_m[0]))
    assert free_m == pytest.approx([2.0, 4.0], abs=0.1)


def test_the_window_moves_with_the_sensor_and_memory_does_not_grow() -> None:
    """Along a corridor of 40 m with a reach of 4 m: the walls beside the sensor are always seen."""
    columns, counts = ColumnMap(4.0, "lidar", CONFIG), []
    held = columns._evidence.nbytes
    z, x = np.meshgrid(np.linspace(0.0, 2.4, 49), np.linspace(-4.0, 4.0, 401))
    for k in range(80):
        eye = np.array((0.5 * k, 0.0, 1.0))
        walls = [
            np.column_stack((x.ravel() + eye[0], np.full(x.size, side), z.ravel())) for side in (-1.02, 1.02)
        ]
        points = np.concatenate(walls)
        columns.add(points, points, eye, 0.0)
        counts.append(len(columns.cut(SE2(float(eye[0]), 0.0, 0.0), eye, 0).hits_m))
    assert columns._evidence.nbytes == held
    assert min(counts[10:]) > 0.8 * max(counts)


def test_agreement_tells_a_place_from_free_space() -> None:
    columns = ColumnMap(6.0, "depth", CONFIG)
    points = np.concatenate(looks(room(), (20.0,), (0.0, 40.0, -40.0)))
    columns.add(points, points, EYE, 0.0)
    assert columns.agreement(points)[0] > 0.95
    nearer = EYE + 0.6 * (points - EYE)
    assert columns.agreement(nearer)[0] < -0.5


def test_what_rays_pass_over_is_a_thing_however_much_of_it_is_occupied() -> None:
    """A cupboard 1.1 m high before a wall that is seen over it: less than half of what is observed there is
    free. Its ends, over which hardly a ray passes, may look like a wall still."""
    cupboard = box((3.0, 1.0, 0.0), (3.4, 3.0, 1.1))
    scene = Scene(np.concatenate([box((0.0, 0.0, 0.0), (5.0, 4.0, 2.5)), cupboard]))
    columns = ColumnMap(6.0, "depth", CONFIG)
    for points in looks(scene, (0.0, 20.0, 40.0), (-20.0, 0.0, 20.0)):
        columns.add(points, points, EYE, 0.0)
    planar_scan = columns.cut(SE2(), EYE, 7)
    x, y = planar_scan.low_m.T
    front = (np.abs(x - 3.0) < 0.1) & (y > 1.1) & (y < 2.9)
    assert front.sum() * CONFIG.resolution_m > 1.5  # of 1.8 m
    assert (planar_scan.hits_m[:, 0] > 4.9).sum() > 20  # the wall behind it, 1 m of 4 at least
    near = planar_scan.hits_m[np.abs(planar_scan.hits_m[:, 0] - 3.0) < 0.1]
    assert not (np.abs(near[:, 1] - 2.0) < 0.9).any()


def test_each_hit_and_thing_tells_the_heights_that_it_was_seen_at(planar_scan: PlanarScan) -> None:
    """Slices below 0.6 m, up to 1.1 m, and above: the wall fills all, the table top only the middle one."""
    walls, things = np.split(planar_scan.heights, [len(planar_scan.hits_m)])
    assert len(things) == len(planar_scan.low_m)
    assert np.mean(walls == 0b000_111) > 0.95
    inside = np.abs(planar_scan.low_m - (3.5, 2.0)).max(axis=1) < 0.4
    assert np.mean((things[inside] & 0b111) == 0b010) > 0.95  # occupied in the middle only
    assert np.mean((things[inside] & 0b100_000) > 0) > 0.95  # rays have passed over it
