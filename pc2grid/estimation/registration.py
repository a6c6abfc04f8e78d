"""KISS-ICP (Vizzo et al. 2023) per scan. The only file of the library that imports kiss_icp.

`KissRegistration` is composed of the public parts of kiss_icp, in the order of `KissICP.register_frame`.
Three things differ. The initial guess comes from outside (the prediction of the smoother). A scan is added to
the local map by a call of its own, once its pose is final. And on wheels, the floor is removed
before: the rings of a lidar on the floor move with the sensor and pull point-to-point ICP towards standing
still.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, pose_from_rotation_vector, rotation_vector
from pc2grid.settings import RegistrationConfig

_EXACT = 1e-12
"""A rotation matrix times its transpose differs from 1 by less; products of a few of them do, too."""

_FEW = 50
"""A scan with no more points is not thinned a second time: too little of it would be left."""


class KissRegistration:
    """KISS-ICP with a given initial guess, in one thread and hence repeatable.

    voxel_m, max_range_m : defaults for those that `config` leaves out; None: those of KISS-ICP. A refinement
    follows, so coarse voxels are enough.
    """

    def __init__(
        self, config: RegistrationConfig, voxel_m: float | None = None, max_range_m: float | None = None
    ) -> None:
        self._config = config
        self._voxel_m, self._max_range_m = config.voxel_m or voxel_m, config.max_range_m or max_range_m
        self._kiss_config: Any = None
        self._registration: Any = None
        self._threshold: Any = None
        self._map: Any = None

    def register(self, points_m: NDArray[np.floating], guess: F64) -> F64:
        """Align one scan to the local map.

        points_m : (N, 3) deskewed, in the base frame. guess : (4, 4) initial T_session_base.

        Returns T_session_base (4, 4); the guess if there is no map yet, or if the points do not determine a
        pose. The scan becomes part of the local map only by `add`.
        """
        guess = _proper(guess)
        if self._map is None or not len(points_m) or self._config.icp == "none":
            return guess
        sigma = self._threshold.get_threshold()
        frame = self._frame(points_m)
        pose: F64 = self._registration.align_points_to_map(
            points=frame if len(frame) <= _FEW else self._downsample(frame, 1.5),
            voxel_map=self._map,
            initial_guess=guess,
            max_correspondance_distance=3.0 * sigma,
            kernel=sigma,
        )
        if not np.isfinite(pose).all():
            return guess
        self._threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        return pose

    def add(self, points_m: NDArray[np.floating], T_session_base: F64) -> None:
        """Add the points (N, 3) of a scan to the local map, at its final pose (4, 4)."""
        if self._map is None:
            self._start()
        if len(points_m):
            self._map.update(self._frame(points_m), _proper(T_session_base))

    def _frame(self, points_m: NDArray[np.floating]) -> F64:
        """Return the points (N, 3) within range, downsampled for the local map."""
        points = np.ascontiguousarray(points_m, dtype=np.float64)
        near = np.einsum("ij,ij->i", points, points) < self._kiss_config.data.max_range**2
        return self._downsample(points[near], 0.5)

    def _downsample(self, points: F64, voxels: float) -> F64:
        """Return one point for each cube with an edge of so many voxels of the local map."""
        from kiss_icp.voxelization import voxel_down_sample

        sampled: F64 = voxel_down_sample(points, voxels * self._kiss_config.mapping.voxel_size)
        return sampled

    def _start(self) -> None:
        """Begin the local map."""
        from kiss_icp.config import KISSConfig
        from kiss_icp.mapping import get_voxel_hash_map
        from kiss_icp.registration import get_registration
        from kiss_icp.threshold import get_threshold_estimator

        config = KISSConfig()
        config.data.max_range = self._max_range_m or config.data.max_range
        config.mapping.voxel_size = self._voxel_m or 0.01 * config.data.max_range  # its default
        config.registration.max_num_threads = 1
        self._kiss_config = config
        self._registration = get_registration(config)
        self._threshold = get_threshold_estimator(config)
        self._map = get_voxel_hash_map(config)


def _proper(pose: F64) -> F64:
    """Return the pose (4, 4) with an exact rotation: KISS-ICP ends the whole process for any other matrix."""
    R = pose[:3, :3]
    off = np.abs(R @ R.T - np.eye(3)).max()
    if off < _EXACT or not np.isfinite(pose).all():
        return pose
    return pose_from_rotation_vector(rotation_vector(pose), pose[:3, 3])
