"""What options say about the query's pose beforehand: `--near`, `--near-pose`, `--check`, `--check-topic`.

The database that a query of the command line is looked for in, and the query's path there.

The message that nav2 takes as `/initialpose`: written, and read.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.io import export as ros
from pc2grid.io.atomic import replace_file
from pc2grid.io.map_pose import MapPose
from pc2grid_cli import console
from signature.localization.posterior import Prior
from signature.sessions import open_places

if TYPE_CHECKING:
    from pc2grid.geometry import F64
    from pc2grid.io import Log
    from pc2grid.model import Trajectory
    from pc2grid.observer import TimeSpan
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer


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


@contextlib.contextmanager
def searched(
    database: str, building: str | None, floor: str | None
) -> Iterator[tuple[SubmapDatabase, list[str]]]:
    """A database, or a map as one, to look in; only the sessions of a building and floor if they are given.

    Yields it, and what is damaged in it and left out, of which the user is warned.
    """
    with open_places(database, warn=console.warn) as opened:
        if building is not None or floor is not None:
            opened.keep_only(building=building, floor=floor)
        left_out = [f"{problem.where}: {problem.what}" for problem in opened.leave_out_damaged()]
        for damage in left_out:
            console.warn(f"{opened.location}: damaged and left out: {damage}")
        yield opened, left_out


def in_map(poses: Trajectory, answer: Answer) -> Trajectory | None:
    """The query's poses in the map frame; None without an answer."""
    if answer.T_map_odom is None:
        return None
    return replace(poses, T_session_base=answer.T_map_odom.lift() @ poses.T_session_base)


_MOST_BYTES = 1 << 20
"""A file above this is no single message."""


def write_initialpose(path: Path, answer: Answer) -> None:
    """The pose as JSON that `ros2 topic pub --once /initialpose` takes. The answer must be located."""
    assert answer.T_map_base is not None
    assert answer.covariance is not None
    message = initialpose(answer.stamp_ns, answer.T_map_base, answer.covariance)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(message, indent=1) + "\n", encoding="utf-8")


def initialpose(stamp_ns: int, T_map_base: SE2, covariance: F64, frame: str = "map") -> dict[str, Any]:
    """geometry_msgs/PoseWithCovarianceStamped, plain types only.

    covariance : (3, 3) of x, y, yaw; of these the variances, see `ros_messages.initialpose`.
    """
    found = ros.initialpose(stamp_ns, T_map_base, covariance, frame)
    # What rosbags keeps beside the fields of a message are their types.
    message = dataclasses.asdict(
        found, dict_factory=lambda items: {k: v for k, v in items if k != "__msgtype__"}
    )
    message["pose"]["covariance"] = message["pose"]["covariance"].tolist()
    return message


def read_pose(path: Path) -> MapPose:
    """A pose with covariance from a file: JSON as `write_initialpose` writes it, or YAML as `ros2 topic echo`
    prints it.

    Raises ConfigError if the file cannot be read or holds no such message.
    """
    advice = "`pc2grid relocalize --initialpose OUT.json` writes one; --near X Y RADIUS needs none"
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path}: larger than one message can be", hint=advice)
        # `ros2 topic echo` ends each message with "---".
        message: Any = next(iter(yaml.safe_load_all(path.read_text(encoding="utf-8"))), None)
        stamp, whole = message["header"]["stamp"], message["pose"]
        position, q = whole["pose"]["position"], whole["pose"]["orientation"]
        yaw = math.atan2(2.0 * (q["w"] * q["z"] + q["x"] * q["y"]), 1.0 - 2.0 * (q["y"] ** 2 + q["z"] ** 2))
        covariance = np.asarray(whole["covariance"], np.float64).reshape(6, 6)
        return MapPose(
            stamp_ns=int(stamp["sec"]) * 1_000_000_000 + int(stamp["nanosec"]),
            T_map_base=SE2(float(position["x"]), float(position["y"]), yaw),
            covariance=covariance[np.ix_((0, 1, 5), (0, 1, 5))],
        )
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", hint=advice) from error
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: neither JSON nor YAML", hint=advice) from error
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ConfigError(f"{path}: not a PoseWithCovarianceStamped message", hint=advice) from error
