"""Foxglove's messages, written by its own published schemas, in protobuf and JSON."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from pc2grid.errors import PointCloudError, TopicError, UnsupportedSchema
from pc2grid.io.recording import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.foxglove_messages import IDENTITY, Content, cloud, descriptors, edge, stamped, write
from tests.helpers.recordings import STEP, T0, raw_log, read

STAMPED = b'{"timestamp": {"sec": 1, "nsec": 0}, "frame_id": "a", '
both = pytest.mark.parametrize("encoding", ["protobuf", "json"])


@both
def test_clouds_with_tf_published_once_and_odometry_in_it(tmp_path: Path, encoding: str) -> None:
    contents: list[Content] = [("/tf", "FrameTransform", T0, edge(T0, "base_link", "lidar", 0.2))]
    for i in range(50):
        stamp = T0 + i * STEP
        moved = {"transforms": [edge(stamp, "odom", "base_link", 0.1 * i)]}
        contents.append(("/poses", "FrameTransforms", stamp, moved))
        contents.append(cloud(stamp, [[1, 2, 3], [i, 0, 1]]))
    path = write(tmp_path / "a.mcap", contents, encoding)
    with open_log(path) as log:
        assert log.info.format == f"mcap/{encoding}"
        assert log.choose().base_frame == "base_link"
        scans = list(log.scans())
        assert not log.report().lossy
    assert len(scans) == 50
    for i, scan in enumerate(scans):
        np.testing.assert_allclose(scan.points_m, [[1.2, 2, 3], [i + 0.2, 0, 1]], atol=1e-6)
        assert scan.T_odom_base is not None
        assert scan.T_odom_base[0, 3] == pytest.approx(0.1 * i)


@both
def test_the_origin_of_a_cloud_moves_its_points_and_the_sensor(tmp_path: Path, encoding: str) -> None:
    half = math.sqrt(0.5)
    pose = {
        "position": {"x": 10.0, "y": 0.0, "z": 1.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": half, "w": half},
    }
    (scan,), _ = read(write(tmp_path / "a.mcap", [cloud(T0, [[1, 0, 0]], pose=pose)], encoding))
    np.testing.assert_allclose(scan.points_m, [[10, 1, 1]], atol=1e-6)
    np.testing.assert_allclose(scan.T_base_sensor[:3, 3], [10, 0, 1])


@both
@pytest.mark.parametrize(
    ("code", "dtype"),
    [(2, "<i1"), (4, "<i2"), (6, "<i4"), (7, "<f4"), (8, "<f8"), (1, "<u1"), (3, "<u2"), (5, "<u4")],
)
def test_every_numeric_type(tmp_path: Path, encoding: str, code: int, dtype: str) -> None:
    size = np.dtype(dtype).itemsize
    fields = [{"name": name, "offset": size * i, "type": code} for i, name in enumerate("xyz")]
    data = np.array([[1, 2, 3], [4, 5, 100]], dtype).tobytes()
    content = cloud(T0, [], fields=fields, data=data, point_stride=3 * size)
    (scan,), _ = read(write(tmp_path / "a.mcap", [content], encoding))
    np.testing.assert_array_equal(scan.points_m, [[1, 2, 3], [4, 5, 100]])


@both
def test_a_laser_without_returns_in_some_beams(tmp_path: Path, encoding: str) -> None:
    ranges = [1.0, math.nan, 0.0, 2.0, 3.0]
    fields = stamped(T0, frame_id="laser", pose=IDENTITY, start_angle=-1.0, end_angle=1.0, ranges=ranges)
    (scan,), _ = read(write(tmp_path / "a.mcap", [("/scan", "LaserScan", T0, fields)], encoding))
    assert scan.sensor == "laser"
    angles = np.array([-1.0, 0.5, 1.0])
    expected = np.array([1.0, 2.0, 3.0])[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
    np.testing.assert_allclose(scan.points_m[:, :2], expected, atol=1e-6)


@both
@pytest.mark.parametrize("form", ["metres", "millimetres", "png"])
def test_depth_images(tmp_path: Path, encoding: str, form: str) -> None:
    depth = np.zeros((4, 6), np.float32)
    depth[1, 2] = 2.5
    k = [100.0, 0, 1.0, 0, 100.0, 1.0, 0, 0, 1.0]
    camera = stamped(
        T0, frame_id="camera_optical", width=6, height=4, distortion_model="plumb_bob",
        D=[0.0] * 5, K=k, R=[1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], P=[*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0],
    )  # fmt: skip
    millimetres = (depth * 1000).astype("<u2")
    if form == "png":
        data = bytes(cv2.imencode(".png", millimetres)[1])
        image = (
            "/depth/image",
            "CompressedImage",
            T0,
            stamped(T0, frame_id="camera_optical", data=data, format="png"),
        )
    else:
        pixels, name = (depth, "32FC1") if form == "metres" else (millimetres, "16UC1")
        fields = stamped(
            T0, frame_id="camera_optical", width=6, height=4, encoding=name,
            step=6 * pixels.itemsize, data=pixels.tobytes(),
        )  # fmt: skip
        image = ("/depth/image", "RawImage", T0, fields)
    path = write(tmp_path / "a.mcap", [("/depth/camera", "CameraCalibration", T0, camera), image], encoding)
    (scan,), _ = read(path, ReadConfig(depth_stride=1))
    np.testing.assert_allclose(scan.points_m, [[2.5, -0.025, 0.0]], atol=1e-6)


@both
def test_a_jpeg_is_no_depth_image(tmp_path: Path, encoding: str) -> None:
    image = stamped(T0, frame_id="c", data=b"\xff\xd8\xff", format="jpeg")
    k = [100.0, 0, 0, 0, 100.0, 0, 0, 0, 1.0]
    camera = stamped(T0, frame_id="c", width=6, height=4, distortion_model="", D=[], K=k, R=[], P=[])
    contents: list[Content] = [
        ("/depth/camera", "CameraCalibration", T0, camera),
        ("/depth/image", "CompressedImage", T0, image),
    ]
    with pytest.raises(UnsupportedSchema, match="'jpeg' is not read"):
        read(write(tmp_path / "a.mcap", contents, encoding))


@both
@pytest.mark.parametrize("kind", ["PoseInFrame", "Odometry"])
def test_odometry(tmp_path: Path, encoding: str, kind: str) -> None:
    contents: list[Content] = []
    for i in range(5):
        stamp = T0 + i * STEP
        pose = {"position": {"x": 0.5 * i, "y": 0.0, "z": 0.0}, "orientation": IDENTITY["orientation"]}
        child = {"body_frame_id": "lidar"} if kind == "Odometry" else {}
        contents.append(("/odom", kind, stamp, stamped(stamp, frame_id="odom", pose=pose, **child)))
        contents.append(("/goal", "PoseInFrame", stamp, stamped(stamp, frame_id="odom", pose=IDENTITY)))
        contents.append(cloud(stamp, [[1, 2, 3]]))
    path = write(tmp_path / "a.mcap", contents, encoding)
    scans, _ = read(path)
    assert [s.T_odom_base[0, 3] for s in scans if s.T_odom_base is not None] == [0, 0.5, 1, 1.5, 2]
    goal, _ = read(path, ReadConfig(odometry="/goal"))
    assert [s.T_odom_base[0, 3] for s in goal if s.T_odom_base is not None] == [0] * 5
    with pytest.raises(TopicError, match="no odometry topic /gaol"):
        read(path, ReadConfig(odometry="/gaol"))


@pytest.mark.parametrize(
    "content",
    [
        b" ", b"{", b"[]", b"null", b"7", b"\xff\xfe", b"{}", b'{"timestamp": 3}', b"[" * 100_000,
        STAMPED + b'"point_stride": 0, "fields": [], "data": ""}',
        STAMPED + b'"point_stride": 12, "fields": [], "data": "%%"}',
        STAMPED + b'"point_stride": 12, "fields": 3, "data": ""}',
        STAMPED + b'"point_stride": 12, "fields": [{"name": "x", "offset": -4, "type": 7}], "data": ""}',
        STAMPED + b'"point_stride": 12, "fields": [{"name": "x", "offset": 0, "type": 70}], "data": ""}',
        STAMPED.replace(b"1", b"1e400") + b'"point_stride": 12, "fields": [], "data": ""}',
    ],
)  # fmt: skip
def test_json_that_is_no_cloud(tmp_path: Path, content: bytes) -> None:
    record = "/points", "foxglove.PointCloud", "jsonschema", b"{}", content
    with pytest.raises(PointCloudError, match="1 of 1 scans are unreadable"):
        read(raw_log(tmp_path / "a.mcap", [record], "json"))


@pytest.mark.parametrize("kind", ["half of it", "of another type", "nothing"])
def test_a_descriptor_that_is_broken(tmp_path: Path, kind: str) -> None:
    whole = descriptors("PointCloud")[0]
    schema = {"half of it": whole[: len(whole) // 2], "nothing": b""}.get(kind, descriptors("Pose")[0])
    path = raw_log(
        tmp_path / "a.mcap", [("/points", "foxglove.PointCloud", "protobuf", schema, b"\0")], "protobuf"
    )
    with pytest.raises(
        UnsupportedSchema, match=r"/points: the schema of foxglove\.PointCloud is not readable"
    ):
        read(path)
