"""What LogWriter writes is read back by the reference MCAP and ROS 2 decoders, field by field."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore

from pc2grid.errors import OutputError
from pc2grid.geometry import SE2, pose_from_rotation_vector, pose_from_xyz_quat
from pc2grid.io.export import LogWriter, Marker, occupancy_grid, pose_with_covariance
from pc2grid.model import OccupancyGrid, Trajectory

STAMP = 1_700_000_000_123_456_789


def decoded(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return {channel.topic: message for _, channel, _, message in reader.iter_decoded_messages()}


def test_every_message_survives_the_reference_decoder(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    points = np.arange(15, dtype=np.float32).reshape(5, 3)
    pose = pose_from_rotation_vector((0.1, -0.2, 0.3), (1.0, 2.0, 3.0))
    grid = OccupancyGrid(cells=np.array([[0, 100, -1]]), resolution_m=0.05, origin_m=(-1.0, 2.0))
    trajectory = Trajectory(
        stamps_ns=np.array([STAMP, STAMP + 1]), T_session_base=np.stack((np.eye(4), pose))
    )
    with LogWriter.to(path) as out:
        out.point_cloud("/points", STAMP, "lidar", points, np.linspace(0, 0.1, 5))
        out.laser_scan("/scan", STAMP, "laser", [1.0, np.inf, 2.5], -0.5, 0.5, 0.1, 30.0, 0.001)
        out.depth_image("/depth", STAMP, "camera", [[1.2345, 0.0], [np.nan, 2.0]])
        out.camera_info("/info", STAMP, "camera", [[100, 0, 1], [0, 101, 2], [0, 0, 1]], 2, 2)
        out.odometry("/odom", STAMP, pose)
        out.tf(STAMP, "odom", "base_link", pose)
        out.tf_static(STAMP, "base_link", "lidar", np.eye(4))
        out.path("/path", trajectory)
        out.write("/pose", STAMP, pose_with_covariance(STAMP, SE2(1, 2, 0.5), np.diag([1.0, 2.0, 3.0])))
        out.write("/map", STAMP, occupancy_grid(STAMP, grid))
        marks = np.arange(12.0).reshape(4, 3)
        out.markers(
            "/marks",
            STAMP,
            [
                Marker(name="none", kind="spheres", points_m=np.empty((0, 3)), size_m=1, color=(1, 0, 0, 1)),
                Marker(name="four", kind="lines", points_m=marks, size_m=0.25, color=(0, 0.5, 1, 0.25)),
            ],
        )
        out.metadata("pc2grid", {"config": "{}"})
    got = decoded(path)
    cloud = got["/points"]
    assert (cloud.header.stamp.sec, cloud.header.stamp.nanosec) == divmod(STAMP, 10**9)
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "time"]
    assert [(f.offset, f.datatype, f.count) for f in cloud.fields] == [(4 * i, 7, 1) for i in range(4)]
    rows = np.frombuffer(cloud.data, np.float32).reshape(5, 4)
    np.testing.assert_array_equal(rows[:, :3], points)
    assert (cloud.width, cloud.height, cloud.point_step, cloud.row_step) == (5, 1, 16, 80)
    assert got["/scan"].ranges == [1.0, np.inf, 2.5]
    assert got["/scan"].angle_max == pytest.approx(0.5)
    assert np.frombuffer(got["/depth"].data, np.uint16).tolist() == [1234, 0, 0, 2000]
    assert list(got["/info"].k) == [100, 0, 1, 0, 101, 2, 0, 0, 1]
    for message in (got["/odom"].pose.pose, got["/tf"].transforms[0].transform):
        xyz = getattr(message, "position", None) or message.translation
        quat = getattr(message, "orientation", None) or message.rotation
        back = pose_from_xyz_quat((xyz.x, xyz.y, xyz.z), (quat.x, quat.y, quat.z, quat.w))
        np.testing.assert_allclose(back, pose, atol=1e-12)
    assert got["/tf_static"].transforms[0].child_frame_id == "lidar"
    assert len(got["/path"].poses) == 2
    assert got["/pose"].pose.covariance[35] == 3.0
    none, four = got["/marks"].markers
    assert (none.ns, none.id, none.type, none.points) == ("none", 0, 7, [])
    assert [(p.x, p.y, p.z) for p in four.points] == [tuple(row) for row in marks]
    assert (four.ns, four.id, four.type, four.action, four.scale.x) == ("four", 1, 5, 0, 0.25)
    assert (four.color.g, four.color.a, four.pose.orientation.w, four.mesh_file.filename) == (
        0.5,
        0.25,
        1,
        "",
    )
    assert list(got["/map"].data) == [0, 100, -1]
    assert (got["/map"].info.width, got["/map"].info.height) == (3, 1)
    assert got["/map"].info.origin.position.y == 2.0


def test_markers_are_read_by_another_decoder_too(tmp_path: Path) -> None:
    """rosbags has its own definitions: those of ROS 2 Humble, not ours."""
    path = tmp_path / "out.mcap"
    marker = Marker(name="m", kind="lines", points_m=np.eye(3)[:2], size_m=0.5, color=(1, 0.5, 0, 1))
    with LogWriter.to(path) as out:
        out.markers("/marks", STAMP, [marker, marker])
    with path.open("rb") as stream:
        ((_, _, message),) = make_reader(stream).iter_messages()
    name = "visualization_msgs/msg/MarkerArray"
    got = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(message.data, name)
    assert [(m.ns, m.id, len(m.points), m.color.g) for m in got.markers] == [
        ("m", 0, 2, 0.5),
        ("m", 1, 2, 0.5),
    ]
    assert got.markers[1].points[1].y == 1.0
    assert (got.markers[1].text, got.markers[1].mesh_use_embedded_materials) == ("", False)


def test_the_same_calls_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        with LogWriter.to(tmp_path / name) as out:
            out.point_cloud("/points", STAMP, "lidar", np.ones((10, 3), np.float32))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_an_existing_file_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match=r"exists already.*overwrite=True"), LogWriter.to(path):
        pass
    assert path.read_bytes() == b"precious"


def test_an_exception_leaves_the_old_file_and_no_temporary(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(ZeroDivisionError), LogWriter.to(path, overwrite=True) as out:
        out.tf_static(STAMP, "a", "b", np.eye(4))
        _ = 1 / 0
    assert path.read_bytes() == b"precious"
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"), LogWriter.to(tmp_path / "no" / "out.mcap"):
        pass
