"""The decoder for a topic's messages, by their encoding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pc2grid.io import cloud_folder, ros_messages
from pc2grid.io.source import TopicInfo


def decoder_for(channel: TopicInfo) -> Callable[[Any], Any]:
    """A function from a message's bytes to one of the classes of `messages`.

    Raises UnsupportedSchema if the type or encoding is not one that pc2grid reads.
    """
    if channel.encoding in ("protobuf", "json"):
        from pc2grid.io import foxglove

        return foxglove.decoder_for(channel)
    if channel.type.startswith("cloud/"):
        return cloud_folder.decoder_for(channel)
    return ros_messages.decoder_for(channel)
