"""Files in and out: recordings, maps, trajectories. Nothing here knows what a submap is.

`open_log` is the way in for recordings; the rest is imported by module.

Containers, each a `source.Source` of bytes, told apart by `containers`:
    mcap_log (mcap_records, mcap_summary, mcap_survey), bag_log (bag_salvage), db3_log,
    rosbag2_folder (split_log), cloud_folder
Encodings, each to the classes of `messages`, told apart by `decoders`:
    ros_messages (ros_definitions), foxglove, cloud_files (lzf)
Sensors, each to points, told apart by `scan_decoder`:
    pointcloud2, laserscan, depth
From messages to scans: choose and plan, frames, stream, log.
Out: mcap_out (cdr), nav2_map (map_image), trajectory, all through atomic.
"""

from __future__ import annotations

from pc2grid.io.log import Log, open_log
from pc2grid.io.source import Choice, LogInfo, TopicInfo

__all__ = ["Choice", "Log", "LogInfo", "TopicInfo", "open_log"]
