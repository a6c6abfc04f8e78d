"""What can be followed while it runs: a robot by its address, a recording that is replayed."""

from __future__ import annotations

from pathlib import Path

from pc2grid import extras
from pc2grid.config import ReadConfig
from pc2grid.errors import LogNotFound
from pc2grid.io.live.live_log import LiveLog
from pc2grid.io.live.replay import Replay

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
