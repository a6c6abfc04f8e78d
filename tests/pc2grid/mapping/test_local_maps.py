"""Local maps that loops are closed on."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.mapping.keyframes import Keyframe
from pc2grid.mapping.local_maps import CAMERA_LOCAL_MAPS, LOCAL_MAPS, LocalMap, LocalMapParameters


def uneven_walls(seed: int) -> PlanarScan:
    """Two walls that meet in a corner, with ledges 5 cm deep and 15 cm apart; noise 3 mm."""
    rng = np.random.default_rng(seed)
    along = np.arange(-1.5, 1.5, 0.02)
    deep = 2.0 + 0.05 * (np.floor(along / 0.15) % 2)
    hits = np.concatenate((np.column_stack((along, deep)), np.column_stack((deep, along))))
    hits = (hits + rng.normal(size=hits.shape) * 0.003).astype(np.float32)
    return PlanarScan.of_hits(
        stamp_ns=0, hits_m=hits, origin_m=np.zeros(2), free_m=np.full(360, 1.5, np.float32)
    )


def rms_error_m(parameters: LocalMapParameters) -> float:
    """Of matches of a part of each wall, seen again, with the local map of both."""
    rng = np.random.default_rng(1)
    local_map = LocalMap([Keyframe(0, uneven_walls(0), SE2())], [SE2()], parameters)
    errors = []
    for seed in range(1, 21):
        again = uneven_walls(seed)
        x, y, yaw = rng.uniform(-1.0, 1.0, 3) * (0.05, 0.05, math.radians(2.0))
        first, second = rng.integers(0, 100, 2)
        part = np.r_[first : first + 50, 150 + second : 200 + second]
        guess = SE2(x, y, yaw)
        match = local_map.match(again.hits_m[part].astype(np.float64), again.normal_rad[part], guess)
        errors.append(math.hypot(match.pose.x, match.pose.y))
    return float(np.sqrt(np.mean(np.square(errors))))


def test_smaller_cells_place_uneven_walls_more_exactly() -> None:
    coarse_m, fine_m = rms_error_m(LOCAL_MAPS), rms_error_m(CAMERA_LOCAL_MAPS)
    assert fine_m < 0.01
    assert fine_m < 0.75 * coarse_m


def test_an_overlap_at_the_edge_counts_by_degrees() -> None:
    """At a step, the last bit of a number would decide whether a loop is closed. A laser keeps its step."""
    shares = np.linspace(0.0, 1.0, 2001)
    by_degrees, at_a_step = (
        np.array([parameters.counts(observed, 1.0) for observed in shares.tolist()])
        for parameters in (CAMERA_LOCAL_MAPS, LOCAL_MAPS)
    )
    assert np.abs(np.diff(by_degrees)).max() < 0.01
    assert np.interp((0.2, 0.35, 0.5), shares, by_degrees).tolist() == pytest.approx([0.0, 0.5, 1.0])
    assert np.unique(at_a_step).tolist() == [0.0, 1.0]
    assert CAMERA_LOCAL_MAPS.counts(1.0, 0.8) == pytest.approx(0.5)


def test_what_an_overlap_counts_is_in_its_information() -> None:
    """A local map compared with itself is observed and agrees throughout."""
    scan = uneven_walls(0)
    found = []
    for observed in (0.35, 1.0):
        parameters = dataclasses.replace(CAMERA_LOCAL_MAPS, min_observed=observed)
        local_map = LocalMap([Keyframe(0, scan, SE2())], [SE2()], parameters)
        found.append(local_map.overlap(local_map, SE2(0.05, 0.0, 0.0), 0.1, 0.05))
    full, half = found
    assert full is not None and half is not None
    assert (full.counts, half.counts) == pytest.approx((1.0, 0.5))
    assert half.information == pytest.approx(0.5 * full.information)
