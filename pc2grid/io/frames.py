"""Coordinate frames over time: the tf of a log (REP-105) as a tree, and the attitude of an IMU (REP-145).

`Attitude` follows sensor_msgs/Imu messages. The gyroscope measures the rotation of the IMU, but not the
vertical. The accelerometer measures the force against gravity, and the shaking. In the frame that the
gyroscope integrates, gravity is constant, and the shaking of a hand or of steps cancels over a second. So the
vertical is the mean of the accelerations in that frame over the last time: a complementary filter (Mahony,
Hamel and Pflimlin, "Nonlinear complementary filters on the special orthogonal group", 2008) that is read with
a delay. Assumed: no lasting acceleration, as in a car or a lift that starts; accelerations in m/s2; a small
drift of the gyroscope within that time.
"""

from __future__ import annotations

import bisect
import difflib
import itertools
from dataclasses import dataclass

import numpy as np

from pc2grid.errors import FrameError
from pc2grid.geometry import (
    F64,
    interpolate_pose,
    invert_pose,
    leveling,
    pose_from_rotation_vector,
    pose_from_xyz_quat,
    quat_xyzw_from_pose,
)
from pc2grid.io.messages.types import MOST_PARTS, Imu, Seven, Transform, valid_pose
from pc2grid.io.source import LIDAR_PERIOD_NS


@dataclass(frozen=True, slots=True)
class FrameParameters:
    """How poses over time are interpolated, and how many are kept; chosen by hand.

    max_gap_ns : two samples farther apart are not interpolated (a gap in the log).
    hold_ns : time before the first and after the last sample for which that sample is used,
        the time between two scans.
    kept_samples : samples of one track; a multiple of a minute at any usual rate.
    """

    max_gap_ns: int = 2_000_000_000
    hold_ns: int = LIDAR_PERIOD_NS
    kept_samples: int = 20_000


PARAMETERS = FrameParameters()
_SAME = 1e-3
"""Static transforms that differ by less, in metres and in parts of a rotation, are one; chosen by hand."""


class PoseTrack:
    """Poses over time, of which the recent ones are kept; interpolated on demand.

    lasting : a pose is valid until the next one, and a single pose always.
    """

    def __init__(self, *, lasting: bool = False) -> None:
        self.lasting = lasting
        self._stamps: list[int] = []
        self._poses: list[Seven] = []

    def add(self, stamp_ns: int, pose: Seven) -> bool:
        """Insert a sample by its stamp, unless there is one with this stamp; returns whether it is valid."""
        if not valid_pose(pose):
            return False
        at = len(self._stamps)
        if at and stamp_ns <= self._stamps[-1]:
            at = bisect.bisect_left(self._stamps, stamp_ns)
            if self._stamps[at] == stamp_ns:
                return True
        self._stamps.insert(at, stamp_ns)
        self._poses.insert(at, pose)
        if len(self._stamps) > 2 * PARAMETERS.kept_samples:
            oldest = slice(PARAMETERS.kept_samples)
            del self._stamps[oldest], self._poses[oldest]
        return True

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int:
        """Return the stamp of the newest sample; 0 if there is none."""
        return self._stamps[-1] if self._stamps else 0

    def at(self, stamp_ns: int) -> F64 | None:
        """Return the pose (4, 4) at a time: between two samples, or within 0.1 s of the nearest; None
        elsewhere."""
        stamps = self._stamps
        after = bisect.bisect_left(stamps, stamp_ns)
        if after < len(stamps) and stamps[after] == stamp_ns:
            return self._pose(after)
        if 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= PARAMETERS.max_gap_ns:
            fraction = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
            return interpolate_pose(self._pose(after - 1), self._pose(after), fraction)
        if self.lasting and stamps and (after or len(stamps) == 1):
            return self._pose(max(after - 1, 0))
        near = [i for i in (after - 1, after) if 0 <= i < len(stamps)]
        nearest = min(near, key=lambda i: abs(stamps[i] - stamp_ns), default=None)
        if nearest is None or abs(stamps[nearest] - stamp_ns) > PARAMETERS.hold_ns:
            return None
        return self._pose(nearest)

    def longest_gap_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return the longest time without a sample between two times."""
        inside = self._stamps[
            bisect.bisect_right(self._stamps, begin_ns) : bisect.bisect_left(self._stamps, end_ns)
        ]
        return max(b - a for a, b in itertools.pairwise((begin_ns, *inside, end_ns)))

    def _pose(self, index: int) -> F64:
        values = self._poses[index]
        return pose_from_xyz_quat(values[:3], values[3:])


class FrameTree:
    """Frames and their parents; edges are static or sampled over time."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}
        self._static: dict[str, F64] = {}
        self._moving: dict[str, PoseTrack] = {}
        self._moved: set[str] = set()  # those whose static transforms differ
        self.warnings: list[str] = []
        self._cache: dict[tuple[str, str], F64] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._parent or frame in self._parent.values()

    @property
    def frames(self) -> list[str]:
        """Return all known frames."""
        return sorted({*self._parent, *self._parent.values()})

    def forget_moving(self) -> None:
        """Forget the poses that depend on time: the clock was set. The tree stays."""
        for child, track in self._moving.items():
            self._moving[child] = PoseTrack(lasting=track.lasting)

    def add_all(
        self, edges: tuple[Transform, ...] | None, *, static: bool = False, log_time_ns: int = 0
    ) -> None:
        """Add the transforms of one message; None stands for a message that could not be decoded."""
        if edges is None:
            self._warn("some tf messages are unreadable and were ignored")
        for edge in edges or ():
            self.add(edge, static=static, log_time_ns=log_time_ns)

    def add(self, edge: Transform, *, static: bool, log_time_ns: int = 0) -> None:
        """Add one transform; as in tf2, a frame's parent is the one that was named last."""
        parent, child = edge.header.frame, edge.child
        if not parent or not child or parent == child or not valid_pose(edge.pose):
            self._warn(
                f"a transform {parent or '?'} -> {child or '?'} of the log makes no sense and is ignored"
            )
            return
        if child not in self._parent and len(self._parent) >= MOST_PARTS:
            self._warn(f"the log has more than {MOST_PARTS} frames; the others are ignored")
            return
        before = self._static.get(child)
        self._set_parent(child, parent)
        if static:
            self._static[child] = pose_from_xyz_quat(edge.pose[:3], edge.pose[3:])
            self._cache.clear()
            if before is not None and not np.allclose(before, self._static[child], atol=_SAME):
                self._moved.add(child)
        elif child not in self._static:
            track = self._moving.setdefault(child, PoseTrack(lasting=edge.lasting))
            track.add(edge.header.stamp_ns or log_time_ns, edge.pose)

    def _set_parent(self, child: str, parent: str) -> None:
        known = self._parent.get(child)
        if known == parent:
            return
        if known is not None:
            self._warn(f"frame {child} has two parents, {known} and {parent}: the latest counts")
            self._moving.pop(child, None)
            self._static.pop(child, None)
        self._cache.clear()
        self._parent[child] = parent

    def static_root(self) -> str | None:
        """Return the root of the static transforms, if these form one tree."""
        roots = {self._above(child)[-1] for child in self._static}
        return roots.pop() if len(roots) == 1 else None

    def static_root_of(self, frame: str) -> str:
        """Return the root that is reached from this frame by static transforms."""
        return self._above(frame)[-1]

    def rigid(self, target: str, source: str) -> bool:
        """Return whether two frames are connected, and nothing moves between them."""
        return self.connected(target, source) and not self.moving(target, source)

    def ambiguous(self, target: str, source: str) -> bool:
        """Return whether the static transforms between two connected frames give one of them two places."""
        return not self._moved.isdisjoint(itertools.chain(*self._branches(target, source)))

    def static_leaves(self, frame: str) -> list[str]:
        """Return the leaves of the static transforms below `frame`."""
        parents = {self._parent[child] for child in self._static}
        return [child for child in self._static if child not in parents and frame in self._above(child)]

    def _above(self, frame: str) -> list[str]:
        """Return the frame, and those above it that static transforms reach."""
        chain = self.chain(frame)
        moving = (k for k, child in enumerate(chain) if child not in self._static)
        return chain[: next(moving, len(chain)) + 1]

    def chain(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on to the root. Raises FrameError if the parents form a
        circle."""
        chain = {frame: None}  # a dict as an ordered set
        while (parent := self._parent.get(frame)) is not None:
            if parent in chain:
                raise FrameError(f"tf goes in a circle: {' -> '.join([*chain, parent][-20:])}")
            chain[parent] = None
            frame = parent
        return list(chain)

    def connected(self, target: str, source: str) -> bool:
        """Return whether there is a path between two frames."""
        return target == source or bool(set(self.chain(target)) & set(self.chain(source)))

    def moving(self, target: str, source: str) -> bool:
        """Return whether a transform between two connected frames depends on time."""
        return bool(self._moving_tracks(target, source))

    def newest_ns(self, target: str, source: str) -> int:
        """Return the stamp up to which the moving part of the path between two connected frames is known.

        It is 0 if that is not known at all, or nothing moves there.
        """
        return min((track.newest_ns for track in self._moving_tracks(target, source)), default=0)

    def longest_gap_ns(self, target: str, source: str, begin_ns: int, end_ns: int) -> int:
        """Return the longest time without a sample of a moving part of the path between two connected
        frames."""
        tracks = self._moving_tracks(target, source)
        return max((track.longest_gap_ns(begin_ns, end_ns) for track in tracks), default=0)

    def lookup(self, target: str, source: str, stamp_ns: int) -> F64 | None:
        """Return `T_target_source` (4, 4) at a time; None if a moving part of it is not known then.

        Raises FrameError if the frames are not connected.
        """
        if target == source:
            return np.eye(4)
        cached = self._cache.get((target, source))
        if cached is not None:
            return cached
        if not self.connected(target, source):
            raise self.missing(source, target)
        up, down = self._branches(target, source)
        T_common_source, T_common_target = self._climb(up, stamp_ns), self._climb(down, stamp_ns)
        if T_common_source is None or T_common_target is None:
            return None
        result = invert_pose(T_common_target) @ T_common_source
        if not self.moving(target, source):
            self._cache[target, source] = result
        return result

    def missing(self, frame: str, target: str) -> FrameError:
        """Return the error for a frame that tf does not connect to `target`."""
        known = self.frames
        close = difflib.get_close_matches(frame, known, n=1)
        guess = f"; did the driver mean {close[0]}?" if close and close[0] != frame else ""
        listed = ", ".join(known[:12]) + (" ..." if len(known) > 12 else "") if known else "none"
        why = "".join(f"; {warning}" for warning in self.warnings[:1])
        return FrameError(
            f"tf does not connect frame {frame or '(empty)'} to {target}{guess}; "
            f"frames in the log: {listed}{why}",
            hint="--set read.assume_identity=true takes the sensor for the base, "
            "--set read.base_frame=NAME chooses another base",
        )

    def _branches(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the children of the edges from `source`, and from `target`, up to the frame where they
        meet."""
        up, down = self.chain(source), self.chain(target)
        common = next(frame for frame in up if frame in down)
        return up[: up.index(common)], down[: down.index(common)]

    def _moving_tracks(self, target: str, source: str) -> list[PoseTrack]:
        """Return the tracks of the moving edges between two connected frames."""
        edges = itertools.chain(*self._branches(target, source))
        return [self._moving[child] for child in edges if child not in self._static]

    def _climb(self, children: list[str], stamp_ns: int) -> F64 | None:
        """Return `T_top_bottom` from the first of `children` to the parent of the last."""
        pose = np.eye(4)
        for child in children:
            edge = self._static.get(child)
            if edge is None:
                edge = self._moving[child].at(stamp_ns)
            if edge is None:
                return None
            pose = edge @ pose
        return pose

    def _warn(self, sentence: str) -> None:
        if sentence not in self.warnings:
            self.warnings.append(sentence)


# --- the attitude of an IMU ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeParameters:
    """Numbers of the filter. Chosen by hand.

    memory_s : time over which accelerations are averaged: two steps of somebody who walks.
    gravity_mps2 : standard gravity. slack : an acceleration that differs from it by more than this share is
        left out.
    """

    memory_s: float = 1.0
    gravity_mps2: float = 9.81
    slack: float = 0.3


ATTITUDE = AttitudeParameters()


class Attitude:
    """Estimates the attitude of an IMU message by message. Memory is bounded.

    received : messages since the beginning.
    """

    def __init__(self, parameters: AttitudeParameters = ATTITUDE) -> None:
        self._parameters = parameters
        self.received = 0
        self._restart()

    def _restart(self) -> None:
        """Begin a new frame, after a gap in the rotation of the IMU."""
        self._track = PoseTrack()  # T_turning_imu: the frame that the gyroscope carries on
        self._turned = np.eye(4)
        self._rate_rps = np.zeros(3)  # of the message before
        self._up = np.zeros(3)  # mean acceleration in that frame, in standard gravities
        self._counted = 0  # accelerations in it

    @property
    def newest_ns(self) -> int:
        """Return the stamp up to which the attitude is known; 0 if it is not."""
        return self._track.newest_ns

    def add(self, imu: Imu, stamp_ns: int) -> None:
        """Update with the next message; one that is late or repeated is ignored."""
        p, last_ns = self._parameters, self._track.newest_ns
        self.received += 1
        if stamp_ns <= last_ns:
            return
        if last_ns and stamp_ns - last_ns > PARAMETERS.max_gap_ns:
            self._restart()
            last_ns = 0
        seconds = (stamp_ns - last_ns) * 1e-9 if last_ns else 0.0
        if imu.acceleration_mps2 is None and imu.orientation is not None:
            self._turned = pose_from_xyz_quat((0.0, 0.0, 0.0), imu.orientation)
            self._up, self._counted = np.array([0.0, 0.0, 1.0]), 1
        elif imu.turn_rate_rps is not None:
            rate_rps = np.array(imu.turn_rate_rps)
            between = 0.5 * seconds * (self._rate_rps + rate_rps)
            self._turned, self._rate_rps = self._turned @ pose_from_rotation_vector(between), rate_rps
        x, y, z, w = quat_xyzw_from_pose(self._turned).tolist()
        self._track.add(stamp_ns, (0.0, 0.0, 0.0, x, y, z, w))
        if imu.acceleration_mps2 is None:
            return
        felt = np.array(imu.acceleration_mps2) / p.gravity_mps2
        if abs(float(np.linalg.norm(felt)) - 1.0) < p.slack:
            self._counted += 1
            gain = max(1.0 / self._counted, min(seconds / p.memory_s, 1.0))
            self._up += gain * (self._turned[:3, :3] @ felt - self._up)

    def at(self, stamp_ns: int) -> F64 | None:
        """Return T_level_imu (4, 4) at a time, without translation: z is up, the heading drifts; None if not
        known."""
        T_turning_imu = self._track.at(stamp_ns)
        size = float(np.linalg.norm(self._up))
        if T_turning_imu is None or not self._counted or size < 1.0 - self._parameters.slack:
            return None
        return leveling(self._up / size) @ T_turning_imu
