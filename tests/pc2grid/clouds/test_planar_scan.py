"""Scans of any kind, reduced to the plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from pc2grid.clouds.ground import Ground
from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan, project_to_plane
from pc2grid.geometry import F64
from pc2grid.settings import ProjectionConfig

CONFIG = ProjectionConfig()
GROUND = Ground(np.array([0.0, 0.0, 1.0]), 0.0, 2.5)


def bearing(degrees: float) -> int:
    return round(degrees / 360 * BEARINGS) % BEARINGS


def planar_scan_of(
    points: Sequence[tuple[float, ...]] | F64,
    ground: Ground | None = GROUND,
    sensor: tuple[float, ...] = (0.0, 0.0, 0.7),
) -> PlanarScan:
    return project_to_plane(
        np.array(points, float), stamp_ns=5, sensor_m=np.array(sensor), ground=ground, config=CONFIG
    )


def test_a_laser_beam_is_a_hit_and_the_free_space_before_it() -> None:
    planar_scan = planar_scan_of([(3.0, 0.0, 0.0), (0.0, 2.0, 0.0)], ground=None, sensor=(0, 0, 0))
    assert sorted(map(tuple, planar_scan.hits_m.tolist())) == [(0.0, 2.0), (3.0, 0.0)]
    assert planar_scan.free_m[bearing(0)] == 3.0 and planar_scan.free_m[bearing(90)] == 2.0
    assert planar_scan.free_m[bearing(180)] == 0.0


def test_height_band_decides_what_is_an_obstacle() -> None:
    planar_scan = planar_scan_of([(2.0, 0.0, 0.0), (0.0, 2.0, 1.0), (-2.0, 0.0, 2.5)])
    assert planar_scan.hits_m.tolist() == [[0.0, 2.0]]
    assert planar_scan.free_m[bearing(0)] == 2.0  # the floor was seen there, so nothing stands before it
    assert planar_scan.free_m[bearing(90)] == 2.0
    # towards the ceiling the ray leaves the band (1.8 m) after 1.1 of its 1.8 m climb
    assert planar_scan.free_m[bearing(180)] == pytest.approx(2.0 * 1.1 / 1.8, rel=1e-5)


def test_an_obstacle_ends_the_free_space_even_when_the_floor_is_seen_behind_it() -> None:
    planar_scan = planar_scan_of([(1.0, 0.0, 0.3), (4.0, 0.0, 0.0)])
    assert planar_scan.free_m[0] == 1.0


def test_gaps_between_beams_are_closed_but_not_those_of_missing_returns() -> None:
    angles = np.radians([10.0, 11.0, 20.0])
    planar_scan = planar_scan_of(
        np.column_stack((3 * np.cos(angles), 3 * np.sin(angles), 0 * angles)), ground=None
    )
    assert planar_scan.free_m[bearing(10.5)] == pytest.approx(3.0)
    assert planar_scan.free_m[bearing(15)] == 0.0


def test_far_returns_give_free_space_but_no_hits() -> None:
    planar_scan = planar_scan_of([(50.0, 0.0, 0.0)], ground=None)
    assert len(planar_scan.hits_m) == 0 and planar_scan.free_m[0] == CONFIG.max_range_m
