"""A robot that is carried away: two recordings, or two parts of one, as a single recording.

The second part follows a second after the first. Its odometry goes on from where that of the first part
ended, because wheels do not turn while a robot is carried.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from pc2grid.geometry import SE2, pose_from_xyz_quat
from pc2grid_lab.experiments.recordings.mcap_copy import Stored, mcap_copy, stored_messages

_CARRIED_NS = 1_000_000_000
"""Time without scans while the robot is carried; chosen by hand, short: a longer one is easier to notice."""
_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_STATIC = "/tf_static"


@dataclass(frozen=True, slots=True)
class Part:
    """A part of an MCAP. begin_s, end_s : seconds after its first scan; end_s None: to its last scan."""

    path: Path
    begin_s: float = 0.0
    end_s: float | None = None


@dataclass(frozen=True, slots=True)
class Joined:
    """What `write_joined` made, in nanoseconds of the recording.

    put_down_ns : the first scan after the robot was carried. shift_ns : of the second part, by how much its
    stamps are later than in its own recording.
    """

    put_down_ns: int
    shift_ns: int


def write_joined(before: Part, after: Part, target: Path) -> Joined:
    """Write the MCAP file `target`: the scans and odometry of `before`, then those of `after`.

    Moving transforms are left out, as they may hold the odometry; static ones are those of `before`.
    Raises OSError, and the errors of `mcap` and `rosbags`.
    """
    first, second = _messages(before), _messages(after)
    shift_ns = first[-1].log_time_ns + _CARRIED_NS - second[0].log_time_ns
    wheels = [_pose(m) for m in first if _is_odometry(m)]
    with mcap_copy(target) as copy:
        for message in (*_static(before, first[0].log_time_ns), *first):
            copy.add(message)
        T: SE2 | None = None
        for message in second:
            if _is_odometry(message) and T is None:
                T = wheels[-1] @ _pose(message).inverse()
            copy.add(_moved(message, shift_ns, T))
    return Joined(second[0].log_time_ns + shift_ns, shift_ns)


def _messages(part: Part) -> list[Stored]:
    """Scans and odometry of a part, from its first scan to its last one."""
    found = [m for m in stored_messages(part.path) if m.schema.name.endswith(("/LaserScan", "/Odometry"))]
    scans_ns = [m.log_time_ns for m in found if not _is_odometry(m)]
    begin_ns = scans_ns[0] + round(part.begin_s * 1e9)
    end_ns = scans_ns[-1] if part.end_s is None else scans_ns[0] + round(part.end_s * 1e9)
    wanted_ns = [time_ns for time_ns in scans_ns if begin_ns <= time_ns <= end_ns]
    return [m for m in found if wanted_ns[0] <= m.log_time_ns <= wanted_ns[-1]]


def _static(part: Part, log_time_ns: int) -> Iterator[Stored]:
    for message in stored_messages(part.path):
        if message.channel.topic == _STATIC:
            yield message._replace(log_time_ns=log_time_ns)


def _moved(message: Stored, shift_ns: int, T: SE2 | None) -> Stored:
    """A message at another time; an odometry at the pose that `T` moves it to."""
    content = _decoded(message)
    stamp = content.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamp.sec * 10**9 + stamp.nanosec + shift_ns, 10**9)
    if T is not None and _is_odometry(message):
        place, to = T @ _pose(message), content.pose.pose
        to.position.x, to.position.y = place.x, place.y
        to.orientation.x, to.orientation.y = 0.0, 0.0
        to.orientation.z, to.orientation.w = math.sin(place.yaw / 2), math.cos(place.yaw / 2)
    data = bytes(_TYPES.serialize_cdr(content, message.schema.name))
    return message._replace(log_time_ns=message.log_time_ns + shift_ns, data=data)


def _decoded(message: Stored) -> Any:
    return _TYPES.deserialize_cdr(message.data, message.schema.name)


def _pose(odometry: Stored) -> SE2:
    pose = _decoded(odometry).pose.pose
    p, q = pose.position, pose.orientation
    return SE2.from_matrix(pose_from_xyz_quat((p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))


def _is_odometry(message: Stored) -> bool:
    return message.schema.name.endswith("/Odometry")
