"""A part of a recording, by time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimeSpan:
    """A part of a recording.

    start_s : its begin, in seconds after the begin of the recording.
    duration_s : its length; None: to the end of the recording.

    >>> TimeSpan(10.0).share_done(40_000_000_000, start_ns=0, end_ns=70_000_000_000)
    0.5
    """

    start_s: float = 0.0
    duration_s: float | None = None

    def length_ns(self, start_ns: int, end_ns: int) -> int:
        """Length of this part of a recording from `start_ns` to `end_ns`; at least 1."""
        if self.duration_s is not None:
            return max(int(self.duration_s * 1e9), 1)
        return max(end_ns - start_ns - int(self.start_s * 1e9), 1)

    def share_done(self, stamp_ns: int, start_ns: int, end_ns: int) -> float:
        """How much of this part, 0..1, lies before `stamp_ns`."""
        elapsed_ns = stamp_ns - start_ns - int(self.start_s * 1e9)
        return min(max(elapsed_ns / self.length_ns(start_ns, end_ns), 0.0), 1.0)
