#!/bin/sh
# From a nav2 map and a recording of the robot to the /initialpose that AMCL waits for.
#   examples/nav2.sh map.yaml tuesday.mcap
# Run it where the robot's ROS 2 is sourced to publish the pose; without ros2 the message is left in a file.
set -eu
map=$1
recording=$2
# Both are written here: the folder of the map or of the recording may be shared, or read-only.
database=$(basename "$map" .yaml).submaps
pose=$(basename "${recording%.*}").initialpose.json

[ -e "$database" ] || pc2grid convert "$map" -o "$database" # once a map
rm -f "$pose"
# Exit code 4, no confident single answer, ends this script: AMCL must not be told a guess.
pc2grid relocalize "$recording" --database "$database" --initialpose "$pose"
if command -v ros2 >/dev/null; then
    ros2 topic pub --once /initialpose geometry_msgs/msg/PoseWithCovarianceStamped "$(cat "$pose")"
fi
