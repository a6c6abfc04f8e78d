"""Robots that are carried away: two recordings as one, followed by `watch` in the map of a third one.

A recording that is followed as it is, too, says how it lies in the map: its surest looks agree on that. So a
place after a kidnap is judged by what the robot said there when nobody had carried it away.

A robot that is carried away: two recordings, or two parts of one, as a single recording.

The second part follows a second after the first. Its odometry goes on from where that of the first part
ended, because wheels do not turn while a robot is carried.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from pc2grid.geometry import SE2, pose_from_xyz_quat
from pc2grid.io import open_log
from pc2grid_lab.experiments.recordings.catalogue import Catalogue
from pc2grid_lab.experiments.recordings.rows import MISSING, NOT_RUN, FollowedRow
from pc2grid_lab.experiments.recordings.run import (
    Finished,
    Folder,
    RecordedDrive,
    Stored,
    Task,
    drive_of,
    grids,
    hits_at,
    kept,
    known_share,
    mcap_copy,
    pc2grid,
    plain,
    stored_messages,
)
from pc2grid_lab.experiments.trial import JUDGEMENT
from pc2grid_lab.experiments.truth import Clue, Frame, agreed_frame, is_right

KIND = "carried away"
"""How `--only` names these rows."""

NOTICED = ("lost", "recovered")
"""States that say that the robot is not where it was located last."""
_SESSION = "map"
"""The first session of a map, see `run`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """A recording that is followed in the map of another session.

    after : what the robot is carried to; if that is the same recording, from its later half to its earlier
        one. None: it is not carried away. quick : whether it belongs to the quick form.
    """

    before: str
    map: str
    after: str | None = None
    quick: bool = False

    @property
    def name(self) -> str:
        """Of the row."""
        return self.before if self.after is None else f"{self.before}, {self.after}"


def _in(map_: str, *others: str) -> Iterator[Followed]:
    """Each of the others as it is, and carried away to each of them."""
    yield from (Followed(before=name, map=map_) for name in others)
    pairs = permutations(others, 2) if len(others) > 1 else [(others[0], others[0])]
    yield from (Followed(before=before, map=map_, after=after) for before, after in pairs)


_DEC13, _DEC13_AFTER, _DEC14 = "kidnap dec13 before", "kidnap dec13 after", "kidnap dec14 before"
_MAY9, _MAY9_AFTER = "kidnap may9 before", "kidnap may9 after"
_QUICK = (
    Followed(before=_DEC13_AFTER, map=_DEC13),
    Followed(before=_DEC14, map=_DEC13),
    Followed(before=_DEC14, map=_DEC13, after=_DEC13_AFTER),
)
FOLLOWED: tuple[Followed, ...] = tuple(
    replace(one, quick=one in _QUICK)
    for one in (
        *_in(_DEC13, _DEC13_AFTER, _DEC14, _MAY9, _MAY9_AFTER),
        *_in(_MAY9, _DEC13, _DEC13_AFTER, _DEC14, _MAY9_AFTER),
        *_in("wean 1", "wean 2", "wean 3"),
        *_in("wean 2", "wean 1", "wean 3"),
        *_in("wean 3", "wean 1", "wean 2"),
        *_in("hallway", "hallway2"),
        *_in("hallway2", "hallway"),
        *_in("workshop_1", "workshop_1_changed"),
        *_in("workshop_1_changed", "workshop_1"),
    )
)
"""All rows, in the order of the page."""


def followed_in(catalogue: Catalogue, folder: Folder, only: str | None) -> tuple[Followed, ...]:
    """The rows of a run whose recordings are there. only : a pattern, see `Catalogue.of`."""

    def there(name: str | None) -> bool:
        return name is None or (
            name in catalogue.recordings and not folder.missing(catalogue.recordings[name])
        )

    return tuple(
        one
        for one in FOLLOWED
        if (one.quick or not catalogue.quick)
        and all(map(there, (one.before, one.after, one.map)))
        and (only is None or any(fnmatch(name, only) for name in _names(catalogue, one)))
    )


def _names(catalogue: Catalogue, one: Followed) -> tuple[str, ...]:
    return KIND, one.before, one.map, catalogue.recordings[one.map].building


def tasks(catalogue: Catalogue, folder: Folder, followed: Sequence[Followed]) -> tuple[set[str], list[Task]]:
    """The recordings that have to be mapped for some rows, and a task a row."""
    mapped = {name for one in followed for name in (one.before, one.map)}
    return mapped, [_watched(catalogue, folder, one) for one in followed]


def _watched(catalogue: Catalogue, folder: Folder, one: Followed) -> Task:
    """`watch` of a row, of its every scan."""

    def do() -> Finished:
        put_down_ns = shift_ns = None
        source = folder.source(catalogue.recordings[one.before])
        if one.after is not None:
            source = folder.work / "carried" / f"{plain(one.name)}.mcap"
            source.parent.mkdir(parents=True, exist_ok=True)
            joined = write_joined(*_parts(catalogue, folder, one), source)
            put_down_ns, shift_ns = joined.put_down_ns, joined.shift_ns
        done = pc2grid("-q", "watch", source, "-d", folder.map(one.map), "--json")
        looks = done.document if isinstance(done.document, list) else [done.document]
        document = {"looks": looks, "put_down_ns": put_down_ns, "shift_ns": shift_ns}
        return done if done.failed else replace(done, document=document)

    return Task(_result(folder, one), do, 0.0)


def _result(folder: Folder, one: Followed) -> Path:
    return folder.work / "followed" / f"{plain(one.name)}.in.{plain(one.map)}.json"


def _parts(catalogue: Catalogue, folder: Folder, one: Followed) -> tuple[Part, Part]:
    """What is joined: two recordings, or the halves of one, the later one first."""
    before, after = (folder.source(catalogue.recordings[name]) for name in (one.before, one.after or ""))
    if one.before != one.after:
        return Part(before), Part(after)
    with open_log(before) as log:
        half_s = (log.info.end_ns - log.info.start_ns) * 0.5e-9
    return Part(before, begin_s=half_s), Part(after, end_s=half_s)


class FollowedJudge:
    """Judges the rows of one run; how recordings lie in maps is found once."""

    def __init__(self, catalogue: Catalogue, folder: Folder) -> None:
        self._catalogue, self._folder = catalogue, folder
        self._frames: dict[tuple[str, str], Frame | None] = {}

    def row(self, one: Followed) -> FollowedRow:
        """The row; where there is no result, one that says why."""
        row = FollowedRow(
            before=one.before,
            after=one.after,
            map=one.map,
            building=self._catalogue.recordings[one.map].building,
        )
        done = kept(_result(self._folder, one))
        if done is None or done.failed:
            return replace(row, problem=NOT_RUN if done is None else done.error or MISSING)
        if one.after is not None:
            put_down_ns = done.document["put_down_ns"] - done.document["shift_ns"]
            row = replace(row, shown=self._shows(one.after, one.map, put_down_ns) is True)
        return _judged(row, self._looks(one, done))

    def _looks(self, one: Followed, done: Finished) -> list[_Look]:
        """The looks, each with whether its place is right."""
        put_down_ns, shift_ns = done.document["put_down_ns"], done.document["shift_ns"]
        looks: list[_Look] = []
        for said in done.document["looks"]:
            carried = put_down_ns is not None and said["stamp_ns"] >= put_down_ns
            name = one.after if carried and one.after is not None else one.before
            own_ns = said["stamp_ns"] - (shift_ns if carried else 0)
            right = None if said["pose"] is None else self._is_right(name, one.map, own_ns, _pose(said))
            since_s = since_m = None
            if carried:
                begin_ns = put_down_ns - shift_ns
                since_s, since_m = (own_ns - begin_ns) * 1e-9, self._travel_m(name, begin_ns, own_ns)
            given_up = said["state"] in NOTICED and _was_right(looks)
            alarm = given_up and self._shows(name, one.map, own_ns) is not False
            looks.append(_Look(said["state"], right, since_s, since_m, alarm))
        return looks

    def _shows(self, name: str, map_: str, stamp_ns: int) -> bool | None:
        """Whether the map knows what the robot sees; None if nobody knows where that is."""
        expected = self._expected(name, map_, stamp_ns)
        if expected is None:
            return None
        hits_m = hits_at(self._folder, self._catalogue.recordings[name], stamp_ns)
        grid = grids(self._folder, map_)[_SESSION]
        return known_share(grid, expected[0].apply(hits_m)) >= JUDGEMENT.mapped

    def _is_right(self, name: str, map_: str, stamp_ns: int, T_map_base: SE2) -> bool | None:
        """Whether the robot is there; None if nobody knows where it is."""
        expected = self._expected(name, map_, stamp_ns)
        return None if expected is None else is_right(T_map_base, *expected)[0]

    def _expected(self, name: str, map_: str, stamp_ns: int) -> tuple[SE2, float] | None:
        """T_map_base at a scan of a recording, and how far a right answer may be from there, metres; None if
        nobody knows how the recording lies in the map."""
        frame, own = self._frame(name, map_), self._drive(name).own_pose(stamp_ns)
        return None if frame is None or own is None else frame.place(own[1])

    def _travel_m(self, name: str, begin_ns: int, end_ns: int) -> float:
        """How far the robot has driven between two scans of a recording."""
        parts = self._drive(name).parts
        return float(sum(np.ptp(np.interp((begin_ns, end_ns), p.stamps_ns, p.path_m())) for p in parts))

    def _frame(self, name: str, map_: str) -> Frame | None:
        """How a recording lies in a map, by the looks at the recording as it is."""
        if (name, map_) not in self._frames:
            done = kept(_result(self._folder, Followed(before=name, map=map_)))
            looks = [] if done is None or done.failed else done.document["looks"]
            clues = [
                Clue(own[1], _pose(said), (name, number), said["confidence"])
                for number, said in enumerate(looks)
                if said["pose"] is not None
                and (own := self._drive(name).own_pose(said["stamp_ns"])) is not None
            ]
            self._frames[name, map_] = agreed_frame(clues) if clues else None
        return self._frames[name, map_]

    def _drive(self, name: str) -> RecordedDrive:
        return drive_of(self._catalogue.recordings[name], self._folder)


@dataclass(frozen=True, slots=True)
class _Look:
    """What `watch` said after a scan.

    right : None if no place was told, or it cannot be judged. since_s, since_m : time and travel since the
        robot was put down; None before. alarm : whether the robot is given up where it was located, though
        that was not wrong, and the map shows what it sees.
    """

    state: str
    right: bool | None
    since_s: float | None = None
    since_m: float | None = None
    alarm: bool = False

    @property
    def tells(self) -> bool:
        """Whether it tells a place."""
        return self.state in ("located", "recovered")


def _was_right(looks: Sequence[_Look]) -> bool:
    """Whether the robot was located, and the last place that was told is not known to be wrong."""
    told = [look for look in looks if look.tells]
    return bool(told) and looks[-1].state != "lost" and told[-1].right is not False


def _pose(said: dict[str, Any]) -> SE2:
    return SE2(said["pose"]["x"], said["pose"]["y"], said["pose"]["yaw"])


def _judged(row: FollowedRow, looks: Sequence[_Look]) -> FollowedRow:
    """What a row says of its looks."""
    before = [look for look in looks if look.since_s is None]
    after = looks[len(before) :]
    knew = bool(before) and before[-1].state in ("located", "recovered", "off_map", "doubtful")
    if knew:  # until it is noticed, the old place is told
        noticed = (k for k, look in enumerate(after) if look.state in NOTICED)
        after = after[next(noticed, len(after)) :]
    told = [look for look in (*before, *after) if look.tells]
    rights = [look.right for look in told]
    row = replace(
        row,
        located=len(told),
        judged=len(told) - rights.count(None),
        wrong=rights.count(False),
        alarms=sum(look.alarm for look in before),
        knew=knew,
    )
    return _with_times(row, after) if knew and after else row


def _with_times(row: FollowedRow, after: Sequence[_Look]) -> FollowedRow:
    """The row with when the robot noticed that it had been carried away, and was located again."""
    row = replace(row, noticed_s=after[0].since_s, noticed_m=after[0].since_m)
    again = next((look for look in after if look.tells and look.right is not False), None)
    return row if again is None else replace(row, again_s=again.since_s, again_m=again.since_m)


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
    wheels = [_pose_of(m) for m in first if _is_odometry(m)]
    with mcap_copy(target) as copy:
        for message in (*_static(before, first[0].log_time_ns), *first):
            copy.add(message)
        T: SE2 | None = None
        for message in second:
            if _is_odometry(message) and T is None:
                T = wheels[-1] @ _pose_of(message).inverse()
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
        place, to = T @ _pose_of(message), content.pose.pose
        to.position.x, to.position.y = place.x, place.y
        to.orientation.x, to.orientation.y = 0.0, 0.0
        to.orientation.z, to.orientation.w = math.sin(place.yaw / 2), math.cos(place.yaw / 2)
    data = bytes(_TYPES.serialize_cdr(content, message.schema.name))
    return message._replace(log_time_ns=message.log_time_ns + shift_ns, data=data)


def _decoded(message: Stored) -> Any:
    return _TYPES.deserialize_cdr(message.data, message.schema.name)


def _pose_of(odometry: Stored) -> SE2:
    pose = _decoded(odometry).pose.pose
    p, q = pose.position, pose.orientation
    return SE2.from_matrix(pose_from_xyz_quat((p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))


def _is_odometry(message: Stored) -> bool:
    return message.schema.name.endswith("/Odometry")
