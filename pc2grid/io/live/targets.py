"""What can be followed while it runs: a robot by its address, a recording that is replayed."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from pc2grid import extras
from pc2grid.config import ReadConfig
from pc2grid.errors import LogError, LogNotFound
from pc2grid.io.live.feed import Arrived, Feed
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.recording import Log, open_log
from pc2grid.io.scan_stream import Part

_HINT = (
    "ws://ROBOT:8765 follows a robot that runs foxglove_bridge, whatever its middleware; "
    "a recording is followed when it is finished, by its path"
)


def open_live(target: str, config: ReadConfig | None = None) -> LiveLog:
    """Follow a running robot, or a recording at its own pace as if it were one.

    target : `ws://ROBOT:8765` (foxglove_bridge), or the path of a recording.

    Raises LiveError if the robot cannot be reached, LogNotFound and what `open_log` raises.

    >>> with open_live("monday.mcap") as live:
    ...     live.choose().topic, sum(1 for scan in live.scans()) > 10
    ('/scan', True)
    """
    config = config or ReadConfig()
    if is_robot(target):
        extras.require({"live": "ws://"})
        from pc2grid.io.live.foxglove_websocket import FoxgloveWebsocket

        return LiveLog(FoxgloveWebsocket(target, config), config)
    return LiveLog(Replay(Path(target), config), config)


def is_robot(target: str) -> bool:
    """Whether a target is the address of a robot. Raises LogNotFound for what cannot be followed.

    >>> is_robot("ws://robot:8765"), is_robot("monday.mcap")
    (True, False)
    """
    scheme, separator, _ = target.partition("://")
    if separator and scheme not in ("ws", "wss"):
        raise LogNotFound(f"{target}: {scheme}:// cannot be followed", hint=_HINT)
    if target == "-":
        raise LogNotFound("-: standard input cannot be followed", hint=_HINT)
    return bool(separator)


class Replay(Feed):
    """The messages of a recording, each as long after its first scan as it was recorded."""

    def __init__(self, path: Path, config: ReadConfig) -> None:
        """Raises what `open_log` does."""
        super().__init__(str(path), config)
        self._log = open_log(path, config)
        self._error: LogError | None = None
        self._stop = threading.Event()
        for topic in self._log.info.topics:
            self._offer((topic.topic, topic.type), topic)
        self._refresh()
        self._thread = threading.Thread(target=self._play, args=(self._log,), name="replay", daemon=True)
        self._thread.start()

    def receive(self, timeout_s: float) -> Arrived | None:
        """See Feed. Raises LogError where the recording is damaged."""
        arrived = super().receive(timeout_s)
        if arrived is None and self._error is not None:
            raise self._error
        return arrived

    def close(self) -> None:
        """Stop, and close the recording."""
        super().close()
        self._stop.set()
        self._thread.join()
        self._log.close()

    def _play(self, log: Log) -> None:
        try:
            self._send(log)
        except LogError as error:
            self._error = error
        self._over = True
        self._inbox.wake()

    def _send(self, log: Log) -> None:
        """Send the messages in their time; those before the first scan at once."""
        begin_s, begin_ns = time.monotonic(), log.info.start_ns
        _, end_ns = Part(end_ns=log.info.end_ns).with_margin()
        for message in log.messages({topic.topic for topic in log.info.topics}):
            wait_s = (message.log_time_ns - begin_ns) * 1e-9 - (time.monotonic() - begin_s)
            if (end_ns is not None and message.log_time_ns > end_ns) or self._stop.wait(max(wait_s, 0.0)):
                return
            if (message.channel.topic, message.channel.type) in self._subscriptions:
                self._inbox.put(message)
