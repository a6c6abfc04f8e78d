"""What options say about the query's pose beforehand: `--near`, `--near-pose`, `--check`, `--check-topic`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.errors import ConfigError
from pc2grid_cli.nav2_pose import read_pose
from signature.localization.prior import Prior

if TYPE_CHECKING:
    from pc2grid.io import Log
    from pc2grid.time_span import TimeSpan

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownPose:
    """The options as they were given.

    near : x, y, radius in metres. near_pose : a file, or a topic of the recording. check : x, y in metres and
    yaw in degrees. check_topic : a topic of the recording. session : whose map frame they are in.
    """

    near: Three | None = None
    near_pose: str | None = None
    check: Three | None = None
    check_topic: str | None = None
    session: str | None = None

    @property
    def is_check(self) -> bool:
        """Whether a pose is to be checked, and none to be found."""
        return self.check is not None or self.check_topic is not None

    def validate(self, *, is_map: bool) -> None:
        """Raises ConfigError for options that do not go together. is_map : the query is a map."""
        given = {
            "--near": self.near,
            "--near-pose": self.near_pose,
            "--check": self.check,
            "--check-topic": self.check_topic,
        }
        names = [name for name, value in given.items() if value is not None]
        if len(names) > 1:
            raise ConfigError(f"{' and '.join(names)} do not go together", hint="give one of them")
        if names and is_map:
            raise ConfigError(f"{names[0]}: there is no robot in a map", hint="give a recording")
        if self.session is not None and not names:
            raise ConfigError(
                "--session: says whose map frame a known pose is in, but none is given",
                hint="add --near X Y RADIUS or --check X Y YAW_DEG",
            )
        if self.check is not None and not all(map(math.isfinite, self.check)):
            raise ConfigError("--check: expected x and y in metres and the heading in degrees")

    def region(self) -> Prior | None:
        """The region of `--near`; None if none is given. Raises ConfigError."""
        self.validate(is_map=False)
        if self.near is None:
            return None
        x_m, y_m, radius_m = self.near
        return Prior.around(x_m, y_m, radius_m, session=self.session)

    def at_start(self) -> Prior | None:
        """The region of `--near` as one in which the first scan was taken."""
        region = self.region()
        return None if region is None else replace(region, stamp_ns=0)

    def prior(self, log: Log, span: TimeSpan) -> Prior | None:
        """The region that the pose is in at a part of a recording; None if none is given.

        Raises ConfigError, or what `Log.map_pose` raises.
        """
        if self.near_pose is None:
            return self.region()
        is_topic = self.near_pose.startswith("/") and not Path(self.near_pose).exists()
        pose = log.map_pose(self.near_pose, end_s(span)) if is_topic else read_pose(Path(self.near_pose))
        if pose.covariance is None:
            raise ConfigError(
                f"--near-pose: poses of {self.near_pose} have no covariance",
                hint="--near X Y RADIUS names a region",
            )
        # A stamp of 0 is the newest scan, as AMCL takes it.
        stamp_ns = pose.stamp_ns or None
        return Prior.of_pose(pose.T_map_base, pose.covariance, stamp_ns=stamp_ns, session=self.session)


def end_s(span: TimeSpan) -> float | None:
    """The end of a part of a recording, seconds after the recording's start; None: its own end."""
    return None if span.duration_s is None else span.start_s + span.duration_s
