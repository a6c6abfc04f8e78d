"""The tree of coordinate frames of a log (tf, REP-105), and the pose of one frame in another over time."""

from __future__ import annotations

import bisect
import difflib
import itertools
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.errors import FrameError
from pc2grid.geometry import interpolate_pose, invert_pose, pose_from_xyz_quat
from pc2grid.io.messages.types import Seven, Transform, valid_pose


@dataclass(frozen=True, slots=True)
class FrameParameters:
    """How poses over time are interpolated, and how many are kept; chosen by hand.

    max_gap_ns : two samples farther apart are not interpolated (a gap in the log).
    hold_ns : time before the first and after the last sample for which that sample is used.
    kept_samples : samples of one track; a multiple of a minute at any usual rate.
    max_frames : frames of one tree, against hostile files.
    """

    max_gap_ns: int = 2_000_000_000
    hold_ns: int = 100_000_000
    kept_samples: int = 20_000
    max_frames: int = 10_000


PARAMETERS = FrameParameters()
_SAME = 1e-3
"""Static transforms that differ by less, in metres and in parts of a rotation, are one; chosen by hand."""


class PoseTrack:
    """Poses over time, of which the recent ones are kept; interpolated on demand.

    lasting : a pose is valid until the next one, and a single pose always.
    """

    def __init__(self, *, lasting: bool = False) -> None:
        self._lasting = lasting
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

    def emptied(self) -> PoseTrack:
        """A track of the same kind without samples."""
        return PoseTrack(lasting=self._lasting)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int:
        """The stamp of the newest sample; 0 if there is none."""
        return self._stamps[-1] if self._stamps else 0

    def at(self, stamp_ns: int) -> F64 | None:
        """Pose (4, 4) at a time: between two samples, or within 0.1 s of the nearest; None elsewhere."""
        stamps = self._stamps
        after = bisect.bisect_left(stamps, stamp_ns)
        if after < len(stamps) and stamps[after] == stamp_ns:
            return self._pose(after)
        if 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= PARAMETERS.max_gap_ns:
            fraction = (stamp_ns - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
            return interpolate_pose(self._pose(after - 1), self._pose(after), fraction)
        if self._lasting and stamps and (after or len(stamps) == 1):
            return self._pose(max(after - 1, 0))
        near = [i for i in (after - 1, after) if 0 <= i < len(stamps)]
        nearest = min(near, key=lambda i: abs(stamps[i] - stamp_ns), default=None)
        if nearest is None or abs(stamps[nearest] - stamp_ns) > PARAMETERS.hold_ns:
            return None
        return self._pose(nearest)

    def longest_gap_ns(self, begin_ns: int, end_ns: int) -> int:
        """The longest time without a sample between two times."""
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
        """All known frames."""
        return sorted({*self._parent, *self._parent.values()})

    def forget_moving(self) -> None:
        """Forget the poses that depend on time: the clock was set. The tree stays."""
        for child, track in self._moving.items():
            self._moving[child] = track.emptied()

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
        if child not in self._parent and len(self._parent) >= PARAMETERS.max_frames:
            self._warn(f"the log has more than {PARAMETERS.max_frames} frames; the others are ignored")
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
        """The root of the static transforms, if these form one tree."""
        roots = {self._above(child)[-1] for child in self._static}
        return roots.pop() if len(roots) == 1 else None

    def static_root_of(self, frame: str) -> str:
        """Return the frame that static transforms lead to from this one."""
        return self._above(frame)[-1]

    def rigid(self, target: str, source: str) -> bool:
        """Return whether two frames are connected, and nothing moves between them."""
        return self.connected(target, source) and not self.moving(target, source)

    def ambiguous(self, target: str, source: str) -> bool:
        """Return whether static transforms between two connected frames put one of them in two places."""
        return not self._moved.isdisjoint(itertools.chain(*self._branches(target, source)))

    def static_leaves(self, frame: str) -> list[str]:
        """The frames that static transforms put on `frame`, and that carry no further ones."""
        parents = {self._parent[child] for child in self._static}
        return [child for child in self._static if child not in parents and frame in self._above(child)]

    def _above(self, frame: str) -> list[str]:
        """The frame, and those that static transforms lead to from it."""
        chain = self.chain(frame)
        moving = (k for k, child in enumerate(chain) if child not in self._static)
        return chain[: next(moving, len(chain)) + 1]

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root. Raises FrameError if the parents form a circle."""
        chain = {frame: None}  # a dict as an ordered set
        while (parent := self._parent.get(frame)) is not None:
            if parent in chain:
                raise FrameError(f"tf goes in a circle: {' -> '.join([*chain, parent][-20:])}")
            chain[parent] = None
            frame = parent
        return list(chain)

    def connected(self, target: str, source: str) -> bool:
        """Whether there is a path between two frames."""
        return target == source or bool(set(self.chain(target)) & set(self.chain(source)))

    def moving(self, target: str, source: str) -> bool:
        """Whether a transform between two connected frames depends on time."""
        return bool(self._moving_tracks(target, source))

    def newest_ns(self, target: str, source: str) -> int:
        """The stamp up to which the moving part of the path between two connected frames is known; 0 if it
        is not known at all, or nothing moves there."""
        return min((track.newest_ns for track in self._moving_tracks(target, source)), default=0)

    def longest_gap_ns(self, target: str, source: str, begin_ns: int, end_ns: int) -> int:
        """The longest time without a sample of a moving part of the path between two connected frames."""
        tracks = self._moving_tracks(target, source)
        return max((track.longest_gap_ns(begin_ns, end_ns) for track in tracks), default=0)

    def lookup(self, target: str, source: str, stamp_ns: int) -> F64 | None:
        """`T_target_source` (4, 4) at a time; None if a moving part of it is not known then.

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
        """The error for a frame that tf does not connect to `target`."""
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
        """Children of the edges from `source`, and from `target`, up to the frame where they meet."""
        up, down = self.chain(source), self.chain(target)
        common = next(frame for frame in up if frame in down)
        return up[: up.index(common)], down[: down.index(common)]

    def _moving_tracks(self, target: str, source: str) -> list[PoseTrack]:
        """The tracks of the moving edges between two connected frames."""
        edges = itertools.chain(*self._branches(target, source))
        return [self._moving[child] for child in edges if child not in self._static]

    def _climb(self, children: list[str], stamp_ns: int) -> F64 | None:
        """`T_top_bottom` from the first of `children` to the parent of the last."""
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
