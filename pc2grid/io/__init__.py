"""Files in and out: recordings, maps, trajectories. Nothing here knows what a submap is.

`open_log` is the way in for recordings; the rest is imported by module.

A recording passes through the folders in this order:

    containers/  files and folders -> timed messages of bytes (message_source.MessageSource)
    messages/    bytes of a ROS or Foxglove message -> one of our few message types
    sensors/     a message of a lidar, laser or camera -> points

`recording` puts them together. `read_plan` decides by the first messages what to read: `found_sensors` finds
the topics of scans (by `topics`) and the frames on them that are sensors, `robots` says which other topics
are of the same robot, `transforms` reads its tf into `frames`, `base_frame` finds the base, and `motion` the
odometry and the IMU. `scan_stream` gives the scans in order. Results are written by export/, nav2_map and
trajectory, all through atomic.
"""

from __future__ import annotations

from pc2grid.io.recording import Log, open_log
from pc2grid.io.source import Choice, LogInfo, TopicInfo

__all__ = ["Choice", "Log", "LogInfo", "TopicInfo", "open_log"]
