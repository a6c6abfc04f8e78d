"""KISS-ICP per scan. The only file that imports kiss_icp.

KISS-ICP's defaults are for cars, so voxel and range are chosen from the first scans; floor and ceiling
are not given to it: rings on the floor move with the sensor and pull point-to-point ICP towards standing
still. The predicted motion (odometry where the log has it) is set before each frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.config import RegistrationConfig
from pc2grid.geometry import F64
from pc2grid.model import Scan

_BRISK_MPS = 1.0  # how fast a robot or a person may move


class KissRegistration:
    """KissICP.register_frame with a prior, single-threaded, hence repeatable.

    carried : the sensor is in somebody's hands: six degrees of freedom, and nothing but ICP to find them.

    The voxel and the range come from the first frame with returns and the time to the next, unless
    `config` fixes them: in the hand the range of a room wants 0.1 m voxels, that of a hall, or two scans a
    second, more; on wheels, where a refinement follows, voxels are coarse and iterations few.
    """

    def __init__(self, config: RegistrationConfig, *, carried: bool = False) -> None:
        self._config = config
        self._carried = carried
        self._kiss: Any = None
        self._first: tuple[NDArray[np.float64], F64] | None = None
        self._pending: NDArray[np.float64] | None = None

    def register(
        self, points_m: NDArray[np.floating], T_map_last: F64, predicted_motion: F64, period_s: float
    ) -> F64:
        """Align one frame.

        points_m : (N, 3) deskewed, without floor and ceiling, in the base frame.
        T_map_last : (4, 4) the pose that was settled on for the frame before.
        predicted_motion : (4, 4) T_last_now. period_s : time since that frame.

        Returns T_map_base (4, 4). Frames without enough points return the prediction. The frame becomes
        part of KISS-ICP's map only by `integrate`.
        """
        self._pending = None
        predicted: F64 = T_map_last @ predicted_motion
        if len(points_m) < 10:
            return predicted
        if self._first is None:
            self._first = np.ascontiguousarray(points_m, dtype=np.float64), predicted
            return predicted
        kiss = self._kiss or self._start(period_s)
        kiss.last_pose = T_map_last
        kiss.last_delta = predicted_motion
        kiss.register_frame(np.ascontiguousarray(points_m, dtype=np.float64), np.empty(0))
        pose = np.asarray(kiss.last_pose, dtype=np.float64)
        return pose if np.isfinite(pose).all() else predicted

    def integrate(self, T_map_base: F64) -> None:
        """Add the frame registered last to the map, at the pose (4, 4) that was settled on."""
        if self._pending is not None:
            self._kiss.local_map.inner.update(self._pending, T_map_base)
            self._pending = None

    def _start(self, period_s: float) -> Any:
        assert self._first is not None
        points, pose = self._first
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        ranges = np.linalg.norm(points, axis=1)
        config = KISSConfig()
        config.data.deskew = False
        config.data.min_range = 0.0  # applied before, to all that a scan is used for
        config.data.max_range = self._config.max_range_m or float(
            np.clip(1.5 * np.percentile(ranges, 98), 10.0, 100.0)
        )
        # ICP finds partners no farther than a voxel away, so it must span the motion between two frames.
        finest = max(float(np.percentile(ranges, 75)) / 40.0, min(_BRISK_MPS * period_s, 0.5))
        config.mapping.voxel_size = self._config.voxel_m or float(
            np.clip(finest, 0.05 if self._carried else 0.3, 1.0)
        )
        config.registration.max_num_threads = 1
        if not self._carried:
            # ICP need only come near: what is left, the refinement in the plane does better and in a tenth
            # of the time.
            config.mapping.max_points_per_voxel = 10
            config.registration.max_num_iterations = 10
            config.registration.convergence_criterion = 1e-2
            config.adaptive_threshold.initial_threshold = 1.0
        kiss = KissICP(config)
        kiss.local_map.update(kiss.voxelize(points)[1], pose)
        kiss.local_map = _DeferredMap(kiss.local_map, self)
        self._kiss = kiss
        return kiss


class BareKissIcp:
    """KISS-ICP as it comes: its own defaults, all points of each scan, nothing else. To compare with."""

    def __init__(self) -> None:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.registration.max_num_threads = 1
        self._kiss: Any = KissICP(config)

    def register(self, scan: Scan) -> F64:
        """T_start_base (4, 4) at the end of a scan: KISS-ICP deskews to where its last point was taken."""
        times = np.empty(0) if scan.offsets_s is None else scan.offsets_s.astype(np.float64)
        if len(scan.points_m):
            self._kiss.register_frame(scan.points_m.astype(np.float64), times)
        return np.array(self._kiss.last_pose, dtype=np.float64)


class _DeferredMap:
    """KISS-ICP's voxel map, except that a frame waits until its pose is settled.

    register_frame adds each frame where ICP put it, which spoils the map when the refinement or the
    odometry knows better, and thickens it a thousand times while the robot stands still.
    """

    def __init__(self, inner: Any, owner: KissRegistration) -> None:
        self.inner = inner
        self._owner = owner

    @property
    def _internal_map(self) -> Any:
        return self.inner._internal_map

    def update(self, points: NDArray[np.float64], pose: F64) -> None:
        self._owner._pending = points


def thin(points: NDArray[np.generic], count: int) -> NDArray[np.intp]:
    """Indices of at most `count` of the points (N, ...), random but always the same, in order.

    Random, because a camera's regular pixel grid pulls ICP towards standing still as a lidar's rings do.
    """
    if len(points) <= count:
        return np.arange(len(points))
    return np.sort(
        np.random.default_rng(len(points)).choice(len(points), count, replace=False, shuffle=False)
    )
