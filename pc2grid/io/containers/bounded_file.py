"""A file that refuses to read more at once than is allowed, or than there is.

The readers of `mcap` and `rosbags` read as many bytes as a record says it has, and Python sets the memory
aside before it reads: a damaged length of 4 GB costs 4 GB. `mcap` takes fewer bytes than it asked for.
"""

from __future__ import annotations

import io
import os

from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated


class BoundedFile(io.BufferedReader):
    """A file, open for reading.

    most_bytes : how many bytes one call may ask for.
    """

    def __init__(self, raw: io.FileIO, most_bytes: int) -> None:
        super().__init__(raw)
        self._most_bytes = most_bytes
        self._size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """See io.BufferedReader.

        Raises LogTruncated if fewer bytes are left, LogCorrupt if `size` is negative (a length was smaller
        than what it counts), LimitExceeded if it is above the limit.
        """
        if size is None or size < 0:
            raise LogCorrupt(f"a length of {size} bytes where a record should begin")
        if size > self._size - self.tell():
            raise LogTruncated(f"the file ends within {size} bytes of a record")
        if size > self._most_bytes:
            raise LimitExceeded(
                f"a record has {size} bytes; the limit is {self._most_bytes}",
                hint="--set read.max_record_bytes=N raises it",
            )
        return super().read(size)
