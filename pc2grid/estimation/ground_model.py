"""The floor under a base on wheels, and the test whether a base is on wheels."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.clouds.ground import Ground, assumed_ground, find_ground
from pc2grid.estimation.line_map import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.geometry import F32, F64, SE2, leveling
from pc2grid.model import SENSOR_MODELS, Scan

_UPRIGHT_HEIGHT_M, _UPRIGHT_TILT_RAD = 0.05, math.radians(0.5)
"""A base on wheels keeps its height and its tilt within these, as its odometry reports them: an EKF in three
dimensions reports some tenths of a degree; a phone in the hand (depth/room) 0.8 to 6.5 degrees in a second.
Without odometry, a sensor that is mounted lower than this above its base is in the hand."""
DECIDING_SCANS = 20
"""So many scans of a base that moves decide whether it is on wheels; what tilts and rises later is on a ramp.
By hand."""


class GroundModel:
    """The floor in the base frame, averaged over the scans that show it.

    ground : the floor; None for a planar laser, which measures none.
    """

    def __init__(self, ground: Ground | None, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self.ground = ground
        self._parameters = parameters
        self._scans = 0
        self._observations = int(ground is not None and ground.seen)  # that have shown the floor

    @classmethod
    def start(
        cls, points_m: F32, scan: Scan, parameters: TrackingParameters = TRACKING_PARAMETERS
    ) -> GroundModel:
        """Find the floor in the first scan.

        It is searched for at the height given by the mounting of the sensor, then as the lowest level plane;
        else it is assumed. points_m : (N, 3) points of the scan that are used, base frame.
        """
        if SENSOR_MODELS[scan.sensor].planar:
            return cls(None, parameters)
        sensor_m = scan.T_base_sensor[:3, 3]
        assumed = assumed_ground(scan.T_base_sensor)
        found = find_ground(points_m, sensor_m, assumed) if assumed.offset_m == 0.0 else None
        return cls(found or find_ground(points_m, sensor_m) or assumed, parameters)

    def follow(self, points_m: F32, scan: Scan) -> None:
        """Update the floor by the points (N, 3) of a scan; only every `rolling_every`th scan is used.

        Wheels do not tilt against the floor, and a ramp ahead soon passes.
        """
        if self.ground is None:
            return
        self._scans += 1
        if self._scans % self._parameters.rolling_every == 0:
            found = find_ground(points_m, scan.T_base_sensor[:3, 3], self.ground)
            if found is not None:
                self._observations += 1
                self.ground = self.ground.toward(found, 1.0 / self._observations)

    def remove(self, points_m: F32) -> F32:
        """Remove the floor from points (N, 3), for KISS-ICP."""
        if self.ground is None or not len(points_m):
            return points_m
        return points_m[self.ground.heights(points_m) > self._parameters.floor_slack_m]

    def T_level_base(self) -> F64:
        """Return tilt and height (4, 4) of the base over the floor. The heading of the base stays."""
        if self.ground is None:
            return np.eye(4)
        level = leveling(self.ground.normal)
        # Levelling is the smallest rotation, which may change the heading: turn it back.
        turn = SE2(0.0, 0.0, -SE2.from_matrix(level).yaw).lift()
        level[:3, :3] = turn[:3, :3] @ level[:3, :3]
        return level


def is_rolling(scan: Scan, first: Scan | None = None) -> bool:
    """Return True if the base stays upright: by its odometry, or without odometry by the mounting.

    first : the first scan, whose height is that of a base on wheels. A planar laser is taken to be on wheels.
    """
    T = scan.T_odom_base
    if SENSOR_MODELS[scan.sensor].planar:
        return True
    if T is None:
        return float(scan.T_base_sensor[2, 3]) > _UPRIGHT_HEIGHT_M
    before = T if first is None or first.T_odom_base is None else first.T_odom_base
    level = float(T[2, 2]) > math.cos(_UPRIGHT_TILT_RAD)
    return level and abs(float(T[2, 3] - before[2, 3])) < _UPRIGHT_HEIGHT_M
