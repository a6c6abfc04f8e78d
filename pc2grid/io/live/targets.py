"""What `pc2grid watch` is pointed at: a robot by its address, a recording by its path, or standard input."""

from __future__ import annotations

from pathlib import Path

from pc2grid.config import ReadConfig
from pc2grid.errors import LogNotFound
from pc2grid.io.live.feed import Feed
from pc2grid.io.live.foxglove_websocket import FoxgloveWebsocket
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.recording_feed import RecordingFeed
from pc2grid.io.live.standard_input import StandardInput
from pc2grid.io.live.zenoh_session import ZenohSession

_ADDRESSES = "ws://ROBOT:8765, zenoh://ROBOT:7447, a recording, or - for standard input"


def open_live(target: str, config: ReadConfig | None = None, *, last_s: float = 30.0) -> LiveLog:
    """Follow a running robot, or a recording that is still being written.

    target : `ws://ROBOT:8765` (foxglove_bridge), `zenoh://ROBOT:7447` (rmw_zenoh), the path of an MCAP or of
    a rosbag2 folder of MCAP files, or `-` for an MCAP on standard input. last_s : seconds before the newest
    message of a recording with which to begin.

    Raises LiveError if the robot cannot be reached, LogNotFound, NotALog, LogCorrupt, LimitExceeded.

    >>> with open_live("monday.mcap", last_s=2.0) as live:
    ...     live.choose().topic, sum(1 for scan in live.scans()) > 10
    ('/scan', True)
    """
    config = config or ReadConfig()
    return LiveLog(open_feed(target, config, last_s), config)


def open_feed(target: str, config: ReadConfig, last_s: float) -> Feed:
    """The feed of a target; see `open_live`."""
    if target == "-":
        return StandardInput(config)
    scheme, separator, _ = target.partition("://")
    if not separator:
        return _recording(Path(target), config, last_s)
    if scheme in ("ws", "wss"):
        return FoxgloveWebsocket(target, config)
    if scheme == "zenoh":
        return ZenohSession(target, config)
    raise LogNotFound(f"{target}: {scheme}:// is not known", hint=f"expected {_ADDRESSES}")


def _recording(path: Path, config: ReadConfig, last_s: float) -> Feed:
    if path.is_file() or path.is_dir():
        return RecordingFeed(path, config, last_s)
    if path.exists():
        raise LogNotFound(f"{path}: not a regular file", hint=f"of a pipe: pc2grid watch - < {path}")
    raise LogNotFound(f"{path}: no such file", hint=f"expected {_ADDRESSES}")
