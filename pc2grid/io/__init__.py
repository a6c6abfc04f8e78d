"""Files in and out: recordings, maps, trajectories. Nothing here knows what a submap is.

`open_log` is the way in for recordings of any container; the rest is imported by module.
"""

from __future__ import annotations

from pc2grid.io.log import Log, open_log
from pc2grid.io.source import Choice, LogInfo, TopicInfo

__all__ = ["Choice", "Log", "LogInfo", "TopicInfo", "open_log"]
