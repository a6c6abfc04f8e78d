"""CDR, the serialisation of ROS 2, as far as it is written here."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, quat_xyzw_from_pose


class Cdr:
    """Little-endian XCDR1 encoder: primitives aligned to their size, counted from behind the 4-byte head."""

    def __init__(self) -> None:
        self._parts = bytearray(b"\x00\x01\x00\x00")

    def __bytes__(self) -> bytes:
        return bytes(self._parts)

    def put(self, code: str, *values: Any) -> Cdr:
        """Append values of one struct format character each ("I", "d", ...)."""
        for value in values:
            self._align(struct.calcsize(code))
            self._parts += struct.pack("<" + code, value)
        return self

    def text(self, value: str) -> Cdr:
        """Append a string with its length in front and a zero behind."""
        raw = value.encode() + b"\0"
        self.put("I", len(raw))
        self._parts += raw
        return self

    def array(self, values: NDArray[Any], *, counted: bool = True) -> Cdr:
        """Append a sequence (counted) or a fixed array of a numpy dtype."""
        if counted:
            self.put("I", values.size)
        if values.size:
            self._align(values.dtype.itemsize)
            self._parts += np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
        return self

    def header(self, stamp_ns: int, frame: str) -> Cdr:
        """Append a std_msgs/Header."""
        seconds, rest = divmod(int(stamp_ns), 1_000_000_000)
        return self.put("i", seconds).put("I", rest).text(frame)

    def pose(self, T: F64) -> Cdr:
        """Append a geometry_msgs/Pose or Transform: translation, then quaternion (xyzw)."""
        return self.put("d", *(float(v) for v in T[:3, 3]), *(float(v) for v in quat_xyzw_from_pose(T)))

    def _align(self, size: int) -> None:
        self._parts += bytes(-(len(self._parts) - 4) % size)
