"""MCAP recordings that are still being written, and finished ones from their last seconds on, as a feed."""

from __future__ import annotations

import time
from pathlib import Path

from pc2grid.config import ReadConfig
from pc2grid.errors import LogError, LogNotFound, NotALog
from pc2grid.io.containers import rosbag2_folder
from pc2grid.io.containers.cloud_folder import natural
from pc2grid.io.containers.detect import first_bytes
from pc2grid.io.containers.mcap_records import MAGIC
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.inbox import Arrived, InboxParameters
from pc2grid.io.live.mcap_tail import McapTail

_POLL_S = 0.05
"""How often a file is looked at; chosen by hand: half the time between two scans of a lidar."""
_LOOK_S = 0.5
"""How often a file is read although messages of it still wait; chosen by hand: a tenth of the lag allowed."""
_SETTLED_S = 1.0
"""A recording with a metadata.yaml that has not grown for so long is finished; chosen by hand."""
_QUIET_S = 5.0
"""After so long without growth the user is told; chosen by hand."""
_MOST_LAG_S = 10.0
"""Log time by which the scans used may be behind the newest one in the file. Recorders write blocks of
several seconds, so less would drop scans of a block that has just arrived. Chosen by hand."""


class RecordingFeed(Feed):
    """An MCAP, or those of a rosbag2 folder one after another; a next file may appear at any time."""

    def __init__(self, path: Path, config: ReadConfig, last_s: float) -> None:
        """last_s : seconds before the newest message with which to begin.

        Raises LogNotFound, NotALog, LogCorrupt, LimitExceeded.
        """
        super().__init__(str(path), config, InboxParameters(most_lag_s=_MOST_LAG_S), by_log_time=True)
        self._config = config
        self._folder = path if path.is_dir() else None
        self._files = _files_of(self._folder) if self._folder else [path]
        if not self._files:
            raise LogNotFound(f"{path}: a folder without a recording", hint="it holds no .mcap")
        self._number = 0
        self._since_ns = self._begin_ns(last_s)
        self._tail = self._open()
        self._grew_s = time.monotonic()
        self._before = (-1, -1)
        self._looked_s: float | None = None

    def keep_up(self) -> None:
        """See Feed."""
        super().keep_up()
        self._looked_s = self._looked_s or 0.0

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed."""
        end_s = time.monotonic() + timeout_s
        if self._looked_s is not None and time.monotonic() - self._looked_s > _LOOK_S:
            self._looked_s = time.monotonic()
            while self._read():
                pass
        while True:
            found = super().receive(0.0)
            if found is not None or self._over:
                return found
            if not self._read() and not self._over:
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    return None
                time.sleep(min(_POLL_S, left_s))

    def close(self) -> None:
        """See Feed."""
        super().close()
        self._tail.close()

    # --- files ----------------------------------------------------------------------------------------

    def _begin_ns(self, last_s: float) -> int:
        """The log time with which to begin: so long before the newest message of the last file with any."""
        for path in reversed(self._files):
            tail = _tail(path, self._config)
            newest_ns = tail.newest_ns()
            tail.close()
            if newest_ns is not None:
                return newest_ns - round(last_s * 1e9)
        return 0

    def _open(self) -> McapTail:
        """The file whose turn it is, from the time on with which to begin.

        Damaged ones are left out as long as others follow.
        """
        while True:
            try:
                tail = _tail(self._files[self._number], self._config)
                tail.skip_to(self._since_ns)
                return tail
            except LogError as error:
                self._leave_out(error)

    def _leave_out(self, error: LogError) -> None:
        """Go on to the next file because this one is damaged; there must be one."""
        if self._number + 1 == len(self._files):
            raise error
        self.news.tell(f"{error.message}: left out")
        self._number += 1

    def _next_file(self) -> bool:
        """Go on to the next file. Returns whether there is one."""
        if self._folder is None:
            return False
        self._files += [path for path in _files_of(self._folder) if path not in self._files]
        if self._number + 1 == len(self._files):
            return False
        self._number += 1
        self._tail.close()
        self._tail = self._open()
        return True

    # --- reading --------------------------------------------------------------------------------------

    def _read(self) -> bool:
        """Read on. Returns whether there was anything, be it messages or only bytes."""
        before = self._tail.size, self._tail.position
        try:
            self._take()
        except LogError as error:
            self._leave_out(error)
            self._tail.close()
            self._tail = self._open()
            return True
        if before != self._before or self._tail.position != before[1]:
            self._before, self._grew_s = before, time.monotonic()
            return True
        still_s = time.monotonic() - self._grew_s
        if (self._tail.ended or still_s > _SETTLED_S) and self._next_file():
            return True
        if self._is_finished(still_s):
            self._over = True
        elif still_s > _QUIET_S:
            self.news.tell(f"{self._files[self._number]}: does not grow; is it still being recorded?")
        return False

    def _take(self) -> None:
        for message in self._tail.read():
            known = self._known(message.channel)
            if self._wanted is None or known.topic in self._wanted:
                self._inbox.put(message._replace(channel=known))
        for topic in self._tail.topics():
            self._known(topic)

    def _is_finished(self, still_s: float) -> bool:
        if self._folder is None:
            return self._tail.ended
        closed = (self._folder / rosbag2_folder.METADATA).is_file()
        return closed and (self._tail.ended or still_s > _SETTLED_S)


def _files_of(folder: Path) -> list[Path]:
    """The files of a folder in the order of their numbers."""
    return sorted((p for p in folder.iterdir() if p.suffix == ".mcap"), key=lambda p: natural(p.name))


def _tail(path: Path, config: ReadConfig) -> McapTail:
    """One file by its first bytes; an empty one by its name. Raises NotALog."""
    head = first_bytes(path)
    if MAGIC.startswith(head[: len(MAGIC)]) and (head or path.suffix == ".mcap"):
        return McapTail.of_file(path, config)
    raise NotALog(
        f"{path}: not a recording that can be followed",
        hint="an MCAP, or a rosbag2 folder of MCAP files, can; `pc2grid relocalize` reads the others",
    )
