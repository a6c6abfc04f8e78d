"""An answer as files for others: MCAP for Foxglove, and the message nav2 wants as `/initialpose`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pc2grid.geometry import F64, SE2
    from pc2grid.model import OccupancyGrid, Trajectory
    from signature.database import SubmapDatabase
    from signature.relocalize import Answer


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


def write_mcap(
    path: Path, database: SubmapDatabase, answer: Answer, located: Trajectory, force: bool
) -> None:
    """What Foxglove's 3D panel shows at once: map, path, pose and map -> odom -> base_link."""
    from pc2grid.io.mcap_out import LogWriter

    assert answer.session is not None
    assert answer.T_map_base is not None
    assert answer.T_map_odom is not None
    assert answer.covariance is not None
    first, last = int(located.stamps_ns[0]), int(located.stamps_ns[-1])
    with LogWriter(path, force=force) as writer:
        writer.occupancy_grid("/map", first, database.grid(answer.session))
        writer.tf(first, "map", "odom", answer.T_map_odom.lift())
        writer.path("/path", located)
        T_odom_map = answer.T_map_odom.inverse().lift()
        for stamp_ns, T_map_base in zip(located.stamps_ns, located.T_map_base, strict=True):
            writer.tf(int(stamp_ns), "odom", "base_link", T_odom_map @ T_map_base)
        writer.pose_with_covariance("/pose", last, answer.T_map_base, answer.covariance)
        writer.pose_with_covariance("/initialpose", last, answer.T_map_base, answer.covariance)


def write_map_mcap(
    path: Path, database: SubmapDatabase, answer: Answer, query: OccupancyGrid, force: bool
) -> None:
    """A map that was located in another one: both grids, and map -> query_map between them."""
    from pc2grid.io.mcap_out import LogWriter

    assert answer.session is not None
    assert answer.T_map_odom is not None
    assert answer.covariance is not None
    with LogWriter(path, force=force) as writer:
        writer.occupancy_grid("/map", 0, database.grid(answer.session))
        writer.occupancy_grid("/query_map", 0, query, frame="query_map")
        writer.tf_static(0, "map", "query_map", answer.T_map_odom.lift())
        writer.pose_with_covariance("/pose", 0, answer.T_map_odom, answer.covariance)
