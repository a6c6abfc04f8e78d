"""Where `--rerun` streams to: a viewer here or elsewhere, or a `.rrd` file."""

from __future__ import annotations

import os
import re
import socket
import sys
from typing import Any
from urllib.parse import urlsplit

from pc2grid import extras
from pc2grid.errors import OutputError

VIEWER = "viewer"
"""In place of an address or a file: the viewer of this machine, which is started if necessary."""
_PORT = 9876  # the default of the viewer


def require_rerun() -> Any:
    """The rerun module. Raises ConfigError if it is not installed."""
    extras.require({"viz": "--rerun"})
    import rerun

    return rerun


def names_target(word: str) -> bool:
    """Whether a word behind `--rerun` is its value: OUT.rrd, HOST:PORT, or the URL of a viewer."""
    return word.endswith(".rrd") or url_of(word) is not None


def url_of(target: str) -> str | None:
    """The viewer's URL; None if the target is a file."""
    if re.match(r"rerun(\+https?)?://", target):
        return target
    if re.fullmatch(r"[\w.-]+:\d+", target):
        return f"rerun+http://{target}/proxy"
    return f"rerun+http://127.0.0.1:{_PORT}/proxy" if target == VIEWER else None


def require_target(target: str, force: bool) -> None:
    """Refuse a target that cannot be streamed to, before any work is done.

    Raises ConfigError without rerun; OutputError if the file exists, nobody answers, or there is no display.
    """
    from pc2grid.io.atomic import require_writable

    require_rerun()
    url = url_of(target)
    if url is None:
        require_writable(target, force)
        return
    place = urlsplit(url)
    try:
        socket.create_connection((place.hostname or "", place.port or _PORT), timeout=3.0).close()
    except OSError as error:
        if target != VIEWER:
            raise OutputError(
                f"{target}: no rerun viewer answers: {error.strerror or error}",
                hint="start one there with `rerun`, or write a file: --rerun OUT.rrd",
            ) from None
        if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise OutputError(
                "there is no display here to open the rerun viewer on",
                hint="name a viewer elsewhere, --rerun HOST:PORT, or write a file: --rerun OUT.rrd",
            ) from None
