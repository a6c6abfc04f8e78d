"""The message that nav2 takes as `/initialpose`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pc2grid.arrays import F64
    from pc2grid.geometry import SE2
    from signature.relocalization.answer import Answer


def write_initialpose(path: Path, answer: Answer) -> None:
    """The pose as JSON that `ros2 topic pub --once /initialpose` takes. The answer must be located."""
    from pc2grid.io.atomic import replace_file

    assert answer.T_map_base is not None
    assert answer.covariance is not None
    message = initialpose(answer.stamp_ns, answer.T_map_base, answer.covariance)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(message, indent=1) + "\n", encoding="utf-8")


def initialpose(stamp_ns: int, T_map_base: SE2, covariance: F64, frame: str = "map") -> dict[str, Any]:
    """geometry_msgs/PoseWithCovarianceStamped, plain types only.

    covariance : (3, 3) of x, y, yaw; becomes 36 numbers, row-major over x, y, z, roll, pitch, yaw.
    """
    import numpy as np

    from pc2grid.geometry import quat_xyzw_from_pose

    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    orientation = quat_xyzw_from_pose(T_map_base.lift()).tolist()
    return {
        "header": {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame},
        "pose": {
            "pose": {
                "position": {"x": float(T_map_base.x), "y": float(T_map_base.y), "z": 0.0},
                "orientation": dict(zip("xyzw", orientation, strict=True)),
            },
            "covariance": full.reshape(-1).tolist(),
        },
    }
