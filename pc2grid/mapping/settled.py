"""Poses after loop closure: of the keyframes, and from these of every scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.geometry import wrap_angle
from pc2grid.model import Loop


@dataclass(frozen=True, slots=True)
class SettledKeyframes:
    """The poses of a session's keyframes after loop closure.

    scans : (K,) number of each keyframe's scan. poses : (K, 3) x, y, yaw of each in the session's frame.
    loops : between the scans at the anchors of local maps that overlap.
    segments : (K,) number of the segment of each; a new one begins where the pose relative to the keyframe
        before is unknown. parts : (K,) number of the part of each: segments that loops join. Poses of
        different parts have nothing to do with each other; see `pc2grid.mapping.parts`.
    anchors : (N,) numbers, in `scans`, of the keyframes at the anchors of the local maps.
    sigma_m : (N,) standard deviation of the position of each of these within its part, in the least certain
        direction; see `pc2grid.mapping.precision`.
    """

    scans: I64
    poses: F64
    loops: tuple[Loop, ...]
    segments: I64
    parts: I64
    anchors: I64
    sigma_m: F64

    @classmethod
    def empty(cls) -> SettledKeyframes:
        """Those of a session without keyframes."""
        none = np.empty(0, np.int64)
        return cls(none, np.empty((0, 3)), (), segments=none, parts=none, anchors=none, sigma_m=np.empty(0))

    def undivided(self) -> SettledKeyframes:
        """The same, as if nothing in it were unknown."""
        together = np.zeros(len(self.scans), np.int64)
        return replace(self, segments=together, parts=together)


def interpolate_corrections(tracked: F64, known: Sequence[int] | I64, corrected: F64) -> F64:
    """Poses (N, 3) of all scans, from the corrected poses (K, 3) of those of them that are `known`.

    Between two of these the correction passes linearly from one to the other, so the motion that was
    tracked between them stays smooth.
    """
    index = np.asarray(known)
    scans = np.arange(len(tracked))
    left = np.clip(np.searchsorted(index, scans, side="right") - 1, 0, len(index) - 1)
    right = np.minimum(left + 1, len(index) - 1)
    a, b = _moved(tracked, index, corrected, left), _moved(tracked, index, corrected, right)
    span = np.maximum(index[right] - index[left], 1)
    share = np.clip((scans - index[left]) / span, 0.0, 1.0)[:, None]
    mixed: F64 = a + share * np.column_stack((b[:, :2] - a[:, :2], wrap_angle(b[:, 2] - a[:, 2])))
    mixed[:, 2] = wrap_angle(mixed[:, 2])
    return mixed


def _moved(tracked: F64, index: NDArray[np.integer], corrected: F64, which: NDArray[np.integer]) -> F64:
    """Every scan as if rigidly attached to the known scan number `which` (N,)."""
    old, new = tracked[index[which]], corrected[which]
    turn = new[:, 2] - old[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    d = tracked[:, :2] - old[:, :2]
    moved: F64 = np.column_stack(
        (new[:, 0] + c * d[:, 0] - s * d[:, 1], new[:, 1] + s * d[:, 0] + c * d[:, 1], tracked[:, 2] + turn)
    )
    return moved
