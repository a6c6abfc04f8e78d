"""How much memory a piece of work takes at most."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


class Peak:
    """The highest resident size since the beginning, of the whole process."""

    def __init__(self) -> None:
        # 5 sets the highest size back to the present one (proc(5)); older marks would hide this one.
        with contextlib.suppress(OSError):
            _CLEAR.write_text("5")
        self._before = _resident("VmRSS")

    def grown_bytes(self) -> int:
        """How far it rose above what was there."""
        return _resident("VmHWM") - self._before


@contextlib.contextmanager
def peak_memory() -> Iterator[Peak]:
    """Watch the body."""
    yield Peak()


def _resident(key: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key))
    return int(line.split()[1]) << 10
