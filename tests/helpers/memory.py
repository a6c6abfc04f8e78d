"""Measuring and bounding the memory that a piece of work takes."""

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path

_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


class Peak:
    """The highest resident size since the beginning, of the whole process."""

    def __init__(self) -> None:
        # 5 sets the highest size back to the present one (proc(5)); older marks would hide this one.
        with contextlib.suppress(OSError):
            _CLEAR.write_text("5")
        self._before = _status("VmRSS")

    def grown_bytes(self) -> int:
        """How far it rose above the size at the beginning."""
        return _status("VmHWM") - self._before


@contextlib.contextmanager
def peak_memory() -> Iterator[Peak]:
    """Watch the body."""
    yield Peak()


@contextlib.contextmanager
def bounded_memory(most_bytes: int) -> Iterator[None]:
    """Allocating more than `most_bytes` in addition to the present memory raises MemoryError, even if unused.

    The limit is on private writable pages (RLIMIT_DATA, getrlimit(2)): the heap, and what is mapped for it.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (_status("VmData") + most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _status(key: str) -> int:
    line = next(line for line in _STATUS.read_text().splitlines() if line.startswith(key))
    return int(line.split()[1]) << 10
