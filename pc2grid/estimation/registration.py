"""KISS-ICP (Vizzo et al. 2023) per scan. The only file of the library that imports kiss_icp.

`KissRegistration` is composed of the public parts of kiss_icp, in the order of `KissICP.register_frame`.
Three things differ. The initial guess comes from outside (the prediction of the smoother). A scan is added to
the local map by a call of its own, once its pose is final. And on wheels, the floor is removed
before: the rings of a lidar on the floor move with the sensor and pull point-to-point ICP towards standing
still.
"""

from __future__ import annotations

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
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        kiss = KISSConfig()
        kiss.data.max_range = config.max_range_m or max_range_m or kiss.data.max_range
        kiss.mapping.voxel_size = config.voxel_m or voxel_m or 0.01 * kiss.data.max_range  # its default
        kiss.registration.max_num_threads = 1
        self._is_control = config.icp == "none"
        self._kiss = KissICP(kiss)

    def register(self, points_m: NDArray[np.floating], guess: F64) -> F64:
        """Align one scan to the local map.

        points_m : (N, 3) deskewed, in the base frame. guess : (4, 4) initial T_session_base.

        Returns T_session_base (4, 4); the guess if there is no map yet, or if the points do not determine a
        pose. The scan becomes part of the local map only by `add`.
        """
        guess = _proper(guess)
        if self._kiss.local_map.empty() or not len(points_m) or self._is_control:
            return guess
        sigma = self._kiss.adaptive_threshold.get_threshold()
        source, frame = self._voxelized(points_m)
        pose: F64 = self._kiss.registration.align_points_to_map(
            points=frame if len(frame) <= _FEW else source,
            voxel_map=self._kiss.local_map,
            initial_guess=guess,
            max_correspondance_distance=3.0 * sigma,
            kernel=sigma,
        )
        if not np.isfinite(pose).all():
            return guess
        self._kiss.adaptive_threshold.update_model_deviation(np.linalg.inv(guess) @ pose)
        return pose

    def add(self, points_m: NDArray[np.floating], T_session_base: F64) -> None:
        """Add the points (N, 3) of a scan to the local map, at its final pose (4, 4)."""
        if len(points_m):
            self._kiss.local_map.update(self._voxelized(points_m)[1], _proper(T_session_base))

    def _voxelized(self, points_m: NDArray[np.floating]) -> tuple[F64, F64]:
        """Return the points (N, 3) within range, thinned to be registered, and less for the local map."""
        points = np.ascontiguousarray(points_m, dtype=np.float64)
        near = np.einsum("ij,ij->i", points, points) < self._kiss.config.data.max_range**2
        source, frame = self._kiss.voxelize(points[near])
        return source, frame


def _proper(pose: F64) -> F64:
    """Return the pose (4, 4) with an exact rotation: KISS-ICP ends the whole process for any other matrix."""
    R = pose[:3, :3]
    off = np.abs(R @ R.T - np.eye(3)).max()
    if off < _EXACT or not np.isfinite(pose).all():
        return pose
    return pose_from_rotation_vector(rotation_vector(pose), pose[:3, 3])
