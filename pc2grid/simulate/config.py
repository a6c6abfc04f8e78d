"""The settings of a simulated session: the building, the drive, the sensors and the odometry.

Defaults are chosen by hand, near to the data sheets of common devices (VLP-16, RealSense D400, 270 degree
scanners) and to the odometry of a differential drive. They are fitted to no recording.
"""

from __future__ import annotations

from pydantic import Field

from pc2grid.settings import Section


class DriveConfig(Section):
    """How the robot moves."""

    clearance_m: float = Field(default=0.35, ge=0.1, le=2.0, description="least distance to anything solid")
    speed_mps: float = Field(default=0.6, gt=0.05, le=0.8, description="cruising speed")
    yaw_rate_rps: float = Field(default=0.8, gt=0.05, le=1.0, description="fastest turn")
    acceleration_mps2: float = Field(default=0.5, gt=0, description="speeding up and braking")
    yaw_acceleration_rps2: float = Field(default=1.5, gt=0, description="of turns in place")
    pause_every_m: float = Field(default=15.0, gt=0, description="mean distance between short stops")


class OdometryConfig(Section):
    """Wheel odometry: relative errors correlated in time (slip), and a bias constant in a session."""

    enabled: bool = Field(default=True, description="false: the log has no odometry topic and no odom frame")
    rate_hz: float = Field(default=50.0, ge=5, le=200)
    distance_error: float = Field(default=0.02, ge=0, description="standard deviation, share of the distance")
    rotation_error: float = Field(default=0.03, ge=0, description="standard deviation, share of the rotation")
    slip_s: float = Field(default=0.5, gt=0, description="correlation time of the slip")
    distance_bias: float = Field(default=0.005, ge=0, description="the same, constant in a session")
    rotation_bias: float = Field(default=0.005, ge=0, description="the same, constant in a session")
    veer_rpm: float = Field(default=0.001, ge=0, description="standard deviation, radians per metre")


class LidarConfig(Section):
    """A spinning lidar like a VLP-16."""

    beams: int = Field(default=16, ge=1, le=256)
    elevation_deg: float = Field(
        default=15.0, gt=0, lt=90, description="beams fan out from minus to plus this"
    )
    columns: int = Field(default=900, ge=8, le=4096, description="firings in one turn")
    rate_hz: float = Field(default=10.0, gt=0, le=40)
    noise_m: float = Field(default=0.02, ge=0, description="standard deviation of a range")
    min_range_m: float = Field(default=0.4, ge=0)
    max_range_m: float = Field(default=60.0, gt=0)
    dropout: float = Field(default=0.01, ge=0, le=1, description="share of the returns that are lost")
    mount_m: tuple[float, float, float] = Field(default=(0.0, 0.0, 0.7), description="x, y, z on the base")


class DepthConfig(Section):
    """A depth camera; noise grows with the square of the depth, as in stereo."""

    width: int = Field(default=160, ge=8, le=2048, description="pixels")
    height: int = Field(default=120, ge=8, le=2048, description="pixels")
    horizontal_deg: float = Field(default=90.0, gt=1, lt=170, description="field of view")
    vertical_deg: float = Field(default=60.0, gt=1, lt=170, description="field of view")
    rate_hz: float = Field(default=10.0, gt=0, le=60)
    noise_m: float = Field(default=0.001, ge=0, description="standard deviation at depth zero")
    noise_per_m: float = Field(
        default=0.0015, ge=0, description="standard deviation per square metre of depth"
    )
    min_range_m: float = Field(default=0.3, ge=0)
    max_range_m: float = Field(default=6.0, gt=0)
    dropout: float = Field(default=0.01, ge=0, le=1, description="share of the pixels that are lost")
    edge_dropout: float = Field(default=0.3, ge=0, le=1, description="the same at jumps in depth")
    mount_m: tuple[float, float, float] = Field(default=(0.2, 0.0, 0.6), description="x, y, z on the base")


class LaserConfig(Section):
    """A 2D laser close to the floor."""

    field_deg: float = Field(default=270.0, gt=1, le=360, description="field of view")
    step_deg: float = Field(default=0.5, gt=0.01, le=10)
    rate_hz: float = Field(default=10.0, gt=0, le=50)
    noise_m: float = Field(default=0.02, ge=0, description="standard deviation of a range")
    min_range_m: float = Field(default=0.1, ge=0)
    max_range_m: float = Field(default=25.0, gt=0)
    dropout: float = Field(default=0.005, ge=0, le=1, description="share of the returns that are lost")
    mount_m: tuple[float, float, float] = Field(default=(0.15, 0.0, 0.28), description="x, y, z on the base")


class SimulationConfig(Section):
    """One session. The same configuration gives the same bytes."""

    length_m: float = Field(default=40.0, gt=0, le=20_000, description="distance to drive")
    seed: int = Field(default=0, ge=0, description="route, clutter, noise and odometry")
    clutter: int = Field(default=30, ge=0, le=10_000, description="movable objects, placed by the seed")
    start_m: tuple[float, float] | None = Field(default=None, description="x, y in the map; null: anywhere")
    building_seed: int = Field(default=0, ge=0, description="the procedural office, when no map is given")
    wall_height_m: float = Field(default=2.5, gt=0.5, le=20)
    drive: DriveConfig = DriveConfig()
    odometry: OdometryConfig = OdometryConfig()
    lidar: LidarConfig = LidarConfig()
    depth: DepthConfig = DepthConfig()
    laser: LaserConfig = LaserConfig()
