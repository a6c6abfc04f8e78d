"""The decoder for a topic's messages, by their encoding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pc2grid.io.messages import clouds, foxglove, ros
from pc2grid.io.source import TopicInfo


def decoder_for(channel: TopicInfo) -> Callable[[Any], Any]:
    """Return a function from a message's bytes to one of the classes of `types`.

    Raises UnsupportedSchema for a type or encoding that is not supported.
    """
    if channel.encoding in ("protobuf", "json"):
        return foxglove.decoder_for(channel)
    if channel.type.startswith("cloud/"):
        return clouds.decoder_for(channel)
    return ros.decoder_for(channel)
