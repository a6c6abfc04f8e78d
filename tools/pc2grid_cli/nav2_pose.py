"""The message that nav2 takes as `/initialpose`: written, and read."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.io.atomic import replace_file
from pc2grid.io.export import ros_messages as ros
from pc2grid.io.map_pose import MapPose

_MOST_BYTES = 1 << 20
"""A file above this is no single message."""

if TYPE_CHECKING:
    from pc2grid.arrays import F64
    from signature.localization.answer import Answer


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
