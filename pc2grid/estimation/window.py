"""What the smoother keeps of the last scans: their evidence, what is estimated of them, and what those before
say. All are tuples of arrays, which compiled code takes as they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pc2grid.arrays import F64, BoolGrid
from pc2grid.estimation.belief import KERNEL
from pc2grid.estimation.manifold import moved

ERRORS = 4
"""Systematic errors of odometry that are estimated."""
LEAST_S = 1e-3
"""Scans follow each other no faster."""


class SmootherParameters(NamedTuple):
    """Numbers of the smoother; chosen by hand.

    lag : scans whose states are estimated together.
    reading_m, reading_rad : standard deviations of a reading of odometry: resolution, and jitter of its time.
    drift : standard deviation of odometry over one metre (m), over one radian and, for the turn, over one
        metre (rad); it grows with the square root of the way. drift_turn_m : that of the position over a turn
        of one radian.
    unsteady, growth : without odometry, the change of the motion from one scan to the next is `unsteady`, in
        m/s and rad/s, times the time between them to the power of 1 + `growth`: a robot indoors starts, stops
        and turns. With a growth of 0.5, that of a hand does not depend on the rate of the scans.
    gyroscope_radps : of a gyroscope, with its bias.
    steady_s : the motion before is taken over this time, so that an error of one pose does not come back in
        the next with the other sign.
    scale, direction_rad, yaw_rad_per_m, turn : standard deviations, over robots, of the systematic errors.
    kernel : see `pc2grid.estimation.belief.KERNEL`.
    iterations : of Gauss-Newton, at most. converged : they end when no unknown changes by more.
    """

    lag: int = 12
    reading_m: float = 0.01
    reading_rad: float = 0.004
    drift: float = 0.05
    drift_turn_m: float = 0.03
    unsteady: float = 0.4
    growth: float = 0.0
    gyroscope_radps: float = 0.02
    steady_s: float = 0.3
    scale: float = 0.05
    direction_rad: float = math.radians(2.0)
    yaw_rad_per_m: float = math.radians(2.0)
    turn: float = 0.05
    kernel: float = KERNEL
    iterations: int = 5
    converged: float = 1e-2


SMOOTHER = SmootherParameters()
IN_THE_HAND = SmootherParameters(
    reading_m=0.002, reading_rad=0.001, drift=0.005, drift_turn_m=0.005, unsteady=0.9, growth=0.5,
    scale=1e-6, direction_rad=1e-6, yaw_rad_per_m=1e-6, turn=1e-6,
)  # fmt: skip
"""For odometry in six degrees of freedom, which is visual and inertial: it is exact to millimetres from image
to image, drifts by a percent, and has no wheels whose errors are always the same. Chosen by hand."""


class Window(NamedTuple):
    """The evidence of the last N scans; what is not measured has infinite standard deviations, or no
    information.

    seconds : (N,) since the scan before. jumps : (N,) whether the reading does not go on from the one before.
    read : (N, 4, 4) T_odom_base, with read_sigma (N, D). match : (N, 4, 4) T_session_base, with
    match_information (N, D, D). motion : (N, 6) step from the scan before, with motion_information (N, D, D).
    """

    seconds: F64
    jumps: BoolGrid
    read: F64
    read_sigma: F64
    match: F64
    match_information: F64
    motion: F64
    motion_information: F64

    def part(self, begin: int, end: int) -> Window:
        """Of the scans from `begin` to before `end`."""
        return Window._make(rows[begin:end] for rows in self)

    def then(self, more: Window) -> Window:
        """With further scans."""
        return Window._make(map(np.concatenate, zip(self, more, strict=True)))


class State(NamedTuple):
    """What is estimated of the last N scans.

    poses : (N, 4, 4) T_session_base. readings : (N, 4, 4) T_odom_base as odometry without errors would
        report.
    errors : (4,) systematic errors of odometry: scale, direction, yaw per metre, turn.
    """

    poses: F64
    readings: F64
    errors: F64

    def changed(self, errors: F64, changes: F64) -> State:
        """After changes of the errors (4,), and (2, N, 6) of poses and readings."""
        of_poses, of_readings = changes
        return State(moved(self.poses, of_poses), moved(self.readings, of_readings), self.errors + errors)

    def part(self, begin: int, end: int) -> State:
        """Of the scans from `begin` to before `end`."""
        return State(self.poses[begin:end], self.readings[begin:end], self.errors)


class Prior(NamedTuple):
    """What the marginalised scans say: the first unknowns are those of `about`, less `shift` (P,)."""

    about: State
    shift: F64
    information: F64
