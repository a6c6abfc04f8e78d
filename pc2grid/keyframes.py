"""The sweeps of a session that its map is made of; those of a long session wait in a file."""

from __future__ import annotations

import struct
import tempfile
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.model import F32
from pc2grid.sweep import Sweep

IN_MEMORY_BYTES = 32 << 20
# index, stamp, restart; T_map_base; origin of the sensor; hits, bearings and glimpses
_HEADER = struct.Struct("<qqq 3d 2d 3q")


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A sweep worth keeping: the robot had moved since the one before.

    index : number of its scan in the session. T_map_base : as tracked, before loops are closed.
    restart : the first after a lost stretch: its place relative to those before is a guess.
    glimpses_m : (N, 2) in its frame, what was seen up to the next keyframe and by neither.
    """

    index: int
    sweep: Sweep
    T_map_base: SE2
    restart: bool = False
    glimpses_m: F32 = field(default_factory=lambda: np.empty((0, 2), np.float32))


class Keyframes:
    """A sequence that only grows. What exceeds `in_memory_bytes` goes to a temporary file without a name,
    so that an hour's drive needs no more memory than a minute's, and a killed process leaves nothing."""

    def __init__(self, in_memory_bytes: int = IN_MEMORY_BYTES) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=in_memory_bytes)  # noqa: SIM115
        self._starts = array("q", [0])

    def __len__(self) -> int:
        return len(self._starts) - 1

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, number: int) -> Keyframe:
        start, end = self._starts[number], self._starts[number + 1]
        self._file.seek(start)
        data = self._file.read(end - start)
        index, stamp_ns, restart, x, y, yaw, origin_x, origin_y, hits, bearings, glimpses = (
            _HEADER.unpack_from(data)
        )
        values = np.frombuffer(data, np.float32, offset=_HEADER.size)
        hits_m, free_m, glimpses_m = np.split(values, (2 * hits, 2 * hits + bearings))
        return Keyframe(
            index,
            Sweep(
                stamp_ns=stamp_ns,
                hits_m=hits_m.reshape(-1, 2),
                origin_m=np.array([origin_x, origin_y]),
                free_m=free_m,
            ),
            SE2(x, y, yaw),
            bool(restart),
            glimpses_m.reshape(glimpses, 2),
        )

    def append(self, keyframe: Keyframe) -> None:
        """Keep one more. Raises OutputError if the disk is full."""
        sweep, pose = keyframe.sweep, keyframe.T_map_base
        header = _HEADER.pack(
            keyframe.index,
            sweep.stamp_ns,
            keyframe.restart,
            *(pose.x, pose.y, pose.yaw),
            *sweep.origin_m,
            *(len(sweep.hits_m), len(sweep.free_m), len(keyframe.glimpses_m)),
        )
        arrays = (sweep.hits_m, sweep.free_m, keyframe.glimpses_m)
        data = header + b"".join(np.ascontiguousarray(a, np.float32).tobytes() for a in arrays)
        try:
            self._file.seek(self._starts[-1])
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise OutputError(
                f"{tempfile.gettempdir()}: no room for the scans of the map: {error.strerror}",
                hint="set TMPDIR to a folder on a larger disk",
            ) from error
        self._starts.append(self._starts[-1] + len(data))

    def close(self) -> None:
        """Give the file back."""
        self._file.close()
