"""Definitions of ROS types in recordings: those that ROS publishes, and invalid ones."""

import struct

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pc2grid.errors import PointCloudError, UnsupportedSchema
from pc2grid.io.messages.ros import store_of
from pc2grid.io.messages.types import Header, StampedPose
from pc2grid.io.source import TopicInfo
from pc2grid.io.topics import decoder_for

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
    encoding, schema_encoding = ("ros1", "ros1msg") if ros1 else ("cdr", "ros2msg")
    for schema in (text.encode(), b""):
        described = {"schema_encoding": schema_encoding, "schema": schema}
        decoder_for(TopicInfo(topic="/t", type=name, encoding=encoding, **described))


def test_published_texts_with_comments_constants_and_short_names() -> None:
    for name, encoding, text in (
        ("sensor_msgs/LaserScan", "ros1msg", LASER_OF_ROS_1),
        ("sensor_msgs/PointField", "ros2msg", FIELD_WITH_CONSTANTS),
    ):
        found, of_ros = (
            store_of(name, encoding, t).fielddefs[name.replace("/", "/msg/")][1] for t in (text, "")
        )
        assert [field for field, _ in found] == [field for field, _ in of_ros]


ODOMETRY = """\
std_msgs/Header header
string<=8[] wheels
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
===
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
===
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
===
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
===
MSG: geometry_msgs/Quaternion
float64 w
float64 x
float64 y
float64 z
===
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Point linear
geometry_msgs/Point angular
float64[36] covariance
"""


def odometry_of(definition: str) -> TopicInfo:
    return TopicInfo(
        topic="/odom",
        type="nav_msgs/Odometry",
        encoding="cdr",
        schema_encoding="ros2msg",
        schema=definition.encode(),
    )


def test_odometry_with_a_field_and_an_order_of_its_own() -> None:
    """As a fork of ROS may define it: the recording says where everything is."""
    data = b"\0\1\0\0" + struct.pack("<iI", 3, 5)
    data += struct.pack("<I5sxxx", 5, b"odom\0") + struct.pack("<II3sx", 1, 3, b"FL\0")
    data += struct.pack("<I10sxx", 10, b"base_link\0")
    data += bytes(-(len(data) - 4) % 8) + struct.pack("<7d", 1, 2, 3, 1, 0, 0, 0) + bytes(8 * (36 + 6 + 36))
    found = decoder_for(odometry_of(ODOMETRY))(data)
    assert found == StampedPose(Header(3_000_000_005, "odom"), (1, 2, 3, 0, 0, 0, 1), "base_link")
    with pytest.raises(PointCloudError, match="no whole nav_msgs/Odometry"):
        decoder_for(odometry_of(ODOMETRY))(data[:-20])


@pytest.mark.fault(19)
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("string child_frame_id", "string child", "differently from ROS: without child_frame_id"),
        ("string<=8[] wheels", "std_msgs/Header[2000000000] wheels", "not readable"),
    ],
)
def test_odometry_that_is_refused(old: str, new: str, words: str) -> None:
    with pytest.raises(UnsupportedSchema, match=words):
        decoder_for(odometry_of(ODOMETRY.replace(old, new)))


@pytest.mark.parametrize("name", ["import", "x\nimport os", "__class__", "a-b"])
def test_no_name_in_a_definition_becomes_code(name: str) -> None:
    text = f"float64 {name}\n" + FIELD_WITH_CONSTANTS
    with pytest.raises((UnsupportedSchema, ValueError)):
        store_of("sensor_msgs/PointField", "ros2msg", text)
