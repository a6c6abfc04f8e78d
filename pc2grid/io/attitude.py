"""The attitude of an IMU: which way is up, and how it turns (sensor_msgs/Imu, REP-145).

The gyroscope tells how the IMU turns, but not which way is up. The accelerometer measures what holds the IMU
against gravity, and how it is shaken. In the frame that the gyroscope carries on, gravity stands still, and
the shaking of a hand or of steps cancels over a second. So the vertical is the mean of the accelerations in
that frame over the last time: a complementary filter (Mahony, Hamel and Pflimlin, "Nonlinear complementary
filters on the special orthogonal group", 2008) that is read behind the moment that is asked for.

Assumed: no lasting acceleration, as in a car or a lift that starts; accelerations in m/s2; an error of the
gyroscope that turns its frame little within that time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import leveling, pose_from_rotation_vector, pose_from_xyz_quat, quat_xyzw_from_pose
from pc2grid.io.frames import PARAMETERS as FRAMES
from pc2grid.io.frames import PoseTrack
from pc2grid.io.messages.types import Imu


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeParameters:
    """Numbers of the filter. Chosen by hand.

    memory_s : time over which accelerations are averaged: two steps of somebody who walks.
    gravity_mps2 : standard gravity. slack : an acceleration that differs from it by more than this share says
        nothing.
    """

    memory_s: float = 1.0
    gravity_mps2: float = 9.81
    slack: float = 0.3


ATTITUDE = AttitudeParameters()


class Attitude:
    """Follows an IMU message by message. Memory is bounded.

    received : messages since the beginning.
    """

    def __init__(self, parameters: AttitudeParameters = ATTITUDE) -> None:
        self._parameters = parameters
        self.received = 0
        self._restart()

    def _restart(self) -> None:
        """Begin a new frame: how the IMU has turned is not known."""
        self._track = PoseTrack()  # T_turning_imu: the frame that the gyroscope carries on
        self._turned = np.eye(4)
        self._rate_rps = np.zeros(3)  # of the message before
        self._up = np.zeros(3)  # mean acceleration in that frame, in standard gravities
        self._counted = 0  # accelerations in it

    @property
    def newest_ns(self) -> int:
        """The stamp up to which the attitude is known; 0 if it is not."""
        return self._track.newest_ns

    def add(self, imu: Imu, stamp_ns: int) -> None:
        """Take in the next message; one that is late or repeated is ignored."""
        p, last_ns = self._parameters, self._track.newest_ns
        self.received += 1
        if stamp_ns <= last_ns:
            return
        if last_ns and stamp_ns - last_ns > FRAMES.max_gap_ns:
            self._restart()
            last_ns = 0
        seconds = (stamp_ns - last_ns) * 1e-9 if last_ns else 0.0
        if imu.acceleration_mps2 is None and imu.orientation is not None:
            self._turned = pose_from_xyz_quat((0.0, 0.0, 0.0), imu.orientation)
            self._up, self._counted = np.array([0.0, 0.0, 1.0]), 1
        elif imu.turn_rate_rps is not None:
            rate_rps = np.array(imu.turn_rate_rps)
            between = 0.5 * seconds * (self._rate_rps + rate_rps)
            self._turned, self._rate_rps = self._turned @ pose_from_rotation_vector(between), rate_rps
        x, y, z, w = quat_xyzw_from_pose(self._turned).tolist()
        self._track.add(stamp_ns, (0.0, 0.0, 0.0, x, y, z, w))
        if imu.acceleration_mps2 is None:
            return
        felt = np.array(imu.acceleration_mps2) / p.gravity_mps2
        if abs(float(np.linalg.norm(felt)) - 1.0) < p.slack:
            self._counted += 1
            gain = max(1.0 / self._counted, min(seconds / p.memory_s, 1.0))
            self._up += gain * (self._turned[:3, :3] @ felt - self._up)

    def at(self, stamp_ns: int) -> F64 | None:
        """T_level_imu (4, 4) at a time, without translation: z is up, the heading drifts; None if not
        known."""
        T_turning_imu = self._track.at(stamp_ns)
        size = float(np.linalg.norm(self._up))
        if T_turning_imu is None or not self._counted or size < 1.0 - self._parameters.slack:
            return None
        return leveling(self._up / size) @ T_turning_imu
