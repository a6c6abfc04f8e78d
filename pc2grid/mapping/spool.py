"""Records that wait in a temporary file, so that memory does not grow with the length of a session."""

from __future__ import annotations

import tempfile
from array import array

from pc2grid.errors import OutputError

IN_MEMORY_BYTES = 32 << 20  # chosen by hand: about an hour of the keyframes of a 2D laser


class Spool:
    """Byte strings in the order in which they were appended, read in any order.

    More than `IN_MEMORY_BYTES` of them are written to a temporary file without a name: a killed process
    leaves no file behind.

    what : they are, for the user.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY_BYTES)  # noqa: SIM115
        self._ends = array("q", [0])

    def append(self, record: bytes) -> None:
        """Add one. Raises OutputError if the disk is full."""
        try:
            self._file.seek(self._ends[-1])
            self._file.write(record)
            self._file.flush()
        except OSError as error:
            raise OutputError(
                f"{tempfile.gettempdir()}: no room for the {self._what} of the map: {error.strerror}",
                hint="set TMPDIR to a folder on a larger disk",
            ) from error
        self._ends.append(self._ends[-1] + len(record))

    def __getitem__(self, number: int) -> bytes:
        begin, end = self._ends[number], self._ends[number + 1]
        self._file.seek(begin)
        return self._file.read(end - begin)

    def close(self) -> None:
        """Delete the file."""
        self._file.close()
