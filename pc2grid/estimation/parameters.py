"""The numbers of tracking and scan matching. Where no other origin is given, a number was chosen by hand."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchingParameters:
    """Point-to-line scan matching.

    cell_m : edge of a cell of moments. It is also the standard deviation that one point counts with, far
        above the noise of a range: the errors of neighbours on one wall are not independent.
    sectors : number of directions by which surfaces are distinguished; a point uses its own and the two
        beside it.
    least_points : with fewer points (sum of their weights) across it, a direction of the position counts as
        not measured.
    residual_scale_m : scale of the Cauchy weight of a point, times the radius of its neighbourhood in cells.
    prior_scale : scale of the Cauchy weight of the prior, in standard deviations.
    near_sigma_m : the same of a point that KISS-ICP has brought near.
    radii_cells : half width of the neighbourhood that gives each point its line, one entry an iteration:
        wide first for a large basin of convergence, then narrow for accuracy.
    converged : the iterations end when x, y (m) and yaw (rad) change by less than this in sum.
    """

    cell_m: float = 0.1
    near_sigma_m: float = 0.4
    sectors: int = 8
    least_points: float = 0.44
    residual_scale_m: float = 0.05
    prior_scale: float = 2.0
    radii_cells: tuple[int, ...] = (3, 3, 2, 2, 1, 1, 1, 1, 1, 1)
    converged: float = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingParameters:
    """Tracking from scan to scan.

    Points:

    max_points : of a scan, chosen at random; a depth image has 300 000.
    floor_slack_m : height up to which points count as floor.

    Ground:

    rolling_every : scans from one look at the floor to the next. The floor under wheels is the mean of all.

    Odometry:

    gap : odometry does not go on over a time of more than so many usual intervals between scans.
    fastest : in m/s and in rad/s; odometry that reports a faster motion is not believed, with an allowance of
        `jump`, m and rad, for noise.

    Refinement in the plane:

    matched_hits : hits of a scan that are matched, at most, evenly chosen.
    followed : last scans that a scan is matched with which does not fit the local map.
    hit_weight : what a hit tells as a share of one that is independent of its neighbours.
    sure_overlap : least overlap of a placement that alone decides between odometry and the motion before;
        with less, placements are searched for if the prediction leaves enough open.
    search_above_m, search_above_rad : it is made only if its half width, `KERNEL` standard deviations,
        exceeds one of these; a refinement alone converges over less.
    search_most_m : largest half width.
    search_sigma_m : of the likelihood field that is searched; its steps are 0.2 m and 2 degrees.

    Local maps and keyframes:

    keyframe_travel_m, keyframe_turn_rad : a scan joins the local maps after this motion.
    map_travel_m : travel after which a new local map is begun.

    Health:

    min_overlap : least share of the hits that meet a line of the local map, or of the points a surface.
    known_m, known_rad : a scan of a sensor in the hand without odometry is lost if a standard deviation of
        its pose on the local map is larger. The first is half of what a right answer may be off.
    give_up_scans : lost scans in a row after which tracking starts again.
    standing_m, standing_rad : a base stands while its odometry changes by no more.
    changed_s : time for which no scan of a standing base fits well, after which the walls have changed; a
        ride in a lift takes longer.
    """

    max_points: int = 40_000
    floor_slack_m: float = 0.1

    rolling_every: int = 8

    gap: float = 10.0
    fastest: float = 4.0
    jump: float = 0.3

    matched_hits: int = 700
    followed: int = 5
    hit_weight: float = 0.3
    sure_overlap: float = 0.6
    search_above_m: float = 0.3
    search_above_rad: float = 0.2
    search_most_m: float = 3.0
    search_sigma_m: float = 0.15

    keyframe_travel_m: float = 0.2
    keyframe_turn_rad: float = math.radians(10.0)
    map_travel_m: float = 5.0

    min_overlap: float = 0.3
    known_m: float = 0.15
    known_rad: float = math.radians(3.0)
    give_up_scans: int = 10
    standing_m: float = 0.02
    standing_rad: float = 0.01
    changed_s: float = 3.0


MATCHING_PARAMETERS = MatchingParameters()
CAMERA_MATCHING = MatchingParameters(cell_m=0.05, radii_cells=(6, 4, 4, 2, 2, 1, 1, 1, 1, 1))
"""For a depth camera on wheels.

A hit is the mean of some dozen pixels: 2 to 10 mm from the wall at ranges up to 6 m (simulated), so it
counts more than a beam of a laser. A camera sees a quarter of its surroundings, and an error of a turn
stays if the view passes on before the scans have corrected odometry. The cells are smaller, because not
noise but the shape of walls within a cell limits the heading of a scan (RMS 0.10 instead of 0.14 degrees on
a map with true poses; as much without any noise). Chosen on 60 m of intel, seed 2: ATE of tracking 0.016
instead of 0.042 m.

Weights that fall with the square of the range were tried there, and made the heading worse (ATE 0.018 to
0.044 m): the noise of a hit is small beside the shape of walls, and far hits determine the heading.
"""
TRACKING_PARAMETERS = TrackingParameters()
