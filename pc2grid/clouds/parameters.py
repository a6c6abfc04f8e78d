"""The numbers of the cloud stage. Where no other origin is given, a number was chosen by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudParameters:
    """How one cloud is processed.

    Ground plane:

    ground_sample, ground_voxel_m, ground_points : the floor is looked for in a random sample of a scan, of
        which Open3D keeps one point a voxel, and of these again a sample, each of at most this size.
    ground_min_points : with fewer points no plane is looked for.
    max_tilt_rad : largest angle between a floor's normal and the z axis of the base.
    plane_tolerance_m : half thickness of a floor, three to four times the range noise of a lidar.
    search_iterations, search_planes : RANSAC iterations for each plane, and how many planes are taken out
        of a cloud, the largest first, before the search gives up. 300 draws of three points contain three
        floor points with a probability of 99 % where a quarter of the points lies on the floor.
    expected_iterations : the same where the plane is known to 2 * `plane_tolerance_m`, so that nearly all
        candidates lie on it.
    min_plane_share : smallest share of a scan that lies on a floor (`min_plane_points`: or this many).
    beneath_m, max_beneath_share : a floor has at most this share of the points farther than this below it.
        This separates a floor from a table.
    min_plane_extent_m : standard deviation of the points of a floor along its shorter side. A narrower
        strip, such as the foot of a wall, does not determine the tilt.
    step_tilt_rad, step_height_m : largest change of the floor against what was expected.

    Normals:

    reach_m, reach_per_m : radius of the neighbourhood of a hit, and its growth with the range, since the
        distance between beams grows with it.
    sparse_factor : the neighbourhood is this many times as wide where it contains fewer than three hits.
    max_flatness : largest ratio of the variances across and along a surface.

    Planar scan:

    limit_sigmas : hits so many standard deviations before the farthest depth of a camera, or beyond, are left
        out; see `pc2grid.clouds.depth_limit`.
    max_gap_bins : bearings without a return between two with one count as seen up to this many.
    """

    ground_sample: int = 10_000
    ground_voxel_m: float = 0.1
    ground_points: int = 2500
    ground_min_points: int = 50
    max_tilt_rad: float = math.radians(35.0)
    plane_tolerance_m: float = 0.04
    search_iterations: int = 300
    search_planes: int = 8
    expected_iterations: int = 20
    min_plane_share: float = 0.02
    min_plane_points: int = 30
    beneath_m: float = 0.12
    max_beneath_share: float = 0.05
    min_plane_extent_m: float = 0.15
    step_tilt_rad: float = math.radians(3.0)
    step_height_m: float = 0.06

    reach_m: float = 0.08
    reach_per_m: float = 0.02
    sparse_factor: float = 4.0
    max_flatness: float = 0.3

    limit_sigmas: float = 2.0
    max_gap_bins: int = 5


CLOUD_PARAMETERS = CloudParameters()
