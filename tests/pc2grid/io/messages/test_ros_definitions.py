"""Definitions of ROS types in recordings: those that ROS publishes, and invalid ones."""

from __future__ import annotations

import time

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pc2grid.io.messages.ros_definitions import expected_layout, layout_of

TYPES = [
    "sensor_msgs/PointCloud2", "sensor_msgs/LaserScan", "sensor_msgs/Image", "sensor_msgs/CompressedImage",
    "sensor_msgs/CameraInfo", "nav_msgs/Odometry", "tf2_msgs/TFMessage",
]  # fmt: skip

LASER_OF_ROS_1 = """\
# Single scan from a planar laser range-finder
#
Header header            # timestamp in the header is the acquisition time of
                         # the first ray in the scan.
float32 angle_min        # start angle of the scan [rad]
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges         # range data [m] (Note: values < range_min or > range_max should be discarded)
float32[] intensities

================================================================================
MSG: std_msgs/Header
# sequence ID: consecutively increasing ID
uint32 seq
#Two-integer timestamp that is expressed as:
# * stamp.sec: seconds (stamp_secs) since epoch (in Python the variable is called 'secs')
time stamp
#Frame this data is associated with
string frame_id

"""

FIELD_WITH_CONSTANTS = """\
# The type of the "name" is a string.
uint8 INT8    = 1
uint8 FLOAT64=8

string<=64 name      # Name of field
uint32 offset
uint8  datatype
uint32 count"""


@pytest.mark.parametrize("release", ["ROS2_FOXY", "ROS2_HUMBLE", "ROS2_JAZZY", "ROS1_NOETIC"])
@pytest.mark.parametrize("name", TYPES)
def test_the_types_that_are_decoded_are_those_of_ros(release: str, name: str) -> None:
    store, ros1 = get_typestore(Stores[release]), release == "ROS1_NOETIC"
    if ros1:
        edges = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(edges, "tf2_msgs/msg/TFMessage"))
    text, _ = store.generate_msgdef(name.replace("/", "/msg/"), ros_version=1 if ros1 else 2)
    assert layout_of(name, "ros1msg" if ros1 else "ros2msg", text) == expected_layout(name, ros1)


def test_published_texts_with_comments_constants_and_short_names() -> None:
    laser = "sensor_msgs/LaserScan"
    assert layout_of(laser, "ros1msg", LASER_OF_ROS_1) == expected_layout(laser, True)
    field = layout_of("sensor_msgs/PointField", "ros2msg", FIELD_WITH_CONSTANTS)
    assert field == expected_layout("sensor_msgs/PointField", False)


@pytest.mark.parametrize(
    "inside", ["const long b = {};", "struct B {{ long c[{}]; }};", "@a({}) struct B {{ long c; }};"]
)
def test_nested_parentheses_in_idl_take_no_time(inside: str) -> None:
    text = "module a { " + inside.format("(" * 20_000 + "1" + ")" * 20_000) + " };"
    started = time.process_time()
    with pytest.raises(ValueError, match="definition missing"):
        layout_of("sensor_msgs/LaserScan", "ros2idl", text)
    assert time.process_time() - started < 2.0
