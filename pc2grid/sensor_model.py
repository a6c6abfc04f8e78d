"""What sets the kinds of sensors apart, in one place: `SENSOR_MODELS[scan.sensor]`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pc2grid.model import SensorKind


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModel:
    """A kind of sensor.

    planar : it measures in one plane, so it shows no floor, no slope, and no points in space.
    image : its scans are images in optical axes (REP-103), with a CameraInfo, of one moment; others sweep.
    narrow : it looks ahead only, and there densely: the floor ahead is seen, and its walls hold a pose in
    fewer directions than those all around.
    noise_per_m2 : standard deviation of a range over its square; 0: the noise does not grow with the range.
    """

    planar: bool = False
    image: bool = False
    narrow: bool = False
    noise_per_m2: float = 0.0

    def range_of_noise_m(self, sigma_m: float) -> float:
        """The range at which the noise has this standard deviation; infinite if it does not grow."""
        return math.sqrt(sigma_m / self.noise_per_m2) if self.noise_per_m2 else math.inf


SENSOR_MODELS: dict[SensorKind, SensorModel] = {
    "lidar": SensorModel(),
    "laser": SensorModel(planar=True),
    # Of stereo and structured light; Khoshelham and Elberink (2012) give 0.0014 for the Kinect.
    "depth": SensorModel(image=True, narrow=True, noise_per_m2=0.0015),
}
