"""Depth images of every encoding, through a whole log: units, returns, cameras that do not fit."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pc2grid.config import ReadConfig
from pc2grid.errors import NoScans, PointCloudError, UnsupportedSchema
from tests.helpers.recordings import T0, Message, raw_log, read, ros, write_mcap

INFO = "/camera/depth/camera_info"
TOPIC = "/camera/depth/image_raw"
EVERY_PIXEL = ReadConfig(depth_stride=1)
# Pixel (row 1, column 2) at 2.5 m with focal length 100 and axis at (0, 0), in body axes: x forward.
DEPTH_M = np.zeros((4, 6), np.float32)
DEPTH_M[1, 2] = 2.5
DEPTH_M[3, 0] = 1.25
EXPECTED = np.float32([[2.5, -2.5 * 2 / 100, -2.5 * 1 / 100], [1.25, 0, -1.25 * 3 / 100]])


def png(values: np.ndarray) -> bytes:
    done, data = cv2.imencode(".png", values)
    assert done
    return bytes(data)


def with_camera(path: Path, *images: Message, width: int = 6, height: int = 4) -> Path:
    return write_mcap(path, [ros().camera(INFO, T0, width, height, 100.0), *images])


def quantised(a: float, b: float) -> bytes:
    """32FC1 as compressedDepth does it: 16-bit a / depth + b behind a header of 12 bytes."""
    values = np.zeros(DEPTH_M.shape, np.uint16)
    there = DEPTH_M > 0
    values[there] = np.round(a / DEPTH_M[there] + b)
    return struct.pack("<iff", 0, a, b) + png(values)


MILLIMETRES = np.round(DEPTH_M * 1000).astype(np.uint16)
WITH_NAN = np.where(DEPTH_M == 0, np.nan, DEPTH_M).astype(np.float32)
RAW = {
    "millimetres": (MILLIMETRES, "16UC1"),
    "millimetres, mono16": (MILLIMETRES, "mono16"),
    "millimetres, big-endian": (MILLIMETRES.astype(">u2"), "16UC1"),
    "metres": (DEPTH_M, "32FC1"),
    "metres, NaN where nothing is": (WITH_NAN, "32FC1"),
    "metres, inf where nothing is": (np.where(DEPTH_M == 0, np.inf, DEPTH_M).astype(np.float32), "32FC1"),
    "too far is 65535": (np.where(MILLIMETRES == 0, 65535, MILLIMETRES).astype(np.uint16), "16UC1"),
}
COMPRESSED = {
    "compressedDepth": (bytes(12) + png(MILLIMETRES), "16UC1; compressedDepth png"),
    "compressedDepth of old": (bytes(12) + png(MILLIMETRES), "16UC1; compressedDepth"),
    "plain png": (png(MILLIMETRES), "16UC1; png compressed "),
    "quantised": (quantised(100.0, 7.0), "32FC1; compressedDepth png"),
}


@pytest.mark.parametrize("case", RAW)
def test_raw_images(tmp_path: Path, case: str) -> None:
    path = with_camera(tmp_path / "a.mcap", ros().image(TOPIC, T0, *RAW[case]))
    (scan,), _ = read(path, EVERY_PIXEL)
    np.testing.assert_allclose(scan.points_m, EXPECTED, atol=1e-6)
    assert scan.sensor == "depth"
    assert scan.dropped == 22


@pytest.mark.parametrize("case", COMPRESSED)
def test_compressed_images(tmp_path: Path, case: str) -> None:
    topic = TOPIC + "/compressedDepth"
    path = with_camera(tmp_path / "a.mcap", ros().compressed(topic, T0, *COMPRESSED[case]))
    (scan,), _ = read(path, EVERY_PIXEL)
    np.testing.assert_allclose(scan.points_m, EXPECTED, atol=1e-5)


def test_a_quantised_image_is_as_exact_as_its_quantisation(tmp_path: Path) -> None:
    # 1.7 m does not fall on a step: a / 1.7 + b = 65.8 is rounded to 66, which is a / (66 - 7) = 1.6949.
    values = np.full((4, 6), round(100.0 / 1.7 + 7.0), np.uint16)
    data = struct.pack("<iff", 0, 100.0, 7.0) + png(values)
    topic = TOPIC + "/compressedDepth"
    image = ros().compressed(topic, T0, data, "32FC1; compressedDepth png")
    (scan,), _ = read(with_camera(tmp_path / "a.mcap", image), EVERY_PIXEL)
    np.testing.assert_allclose(scan.points_m[:, 0], 100.0 / 59, rtol=1e-6)


def test_zeros_are_no_returns_and_the_scan_is_kept(tmp_path: Path) -> None:
    nothing = np.zeros((4, 6), np.uint16)
    path = with_camera(tmp_path / "a.mcap", ros().image(TOPIC, T0, nothing, "16UC1"))
    (scan,), report = read(path, EVERY_PIXEL)
    assert len(scan.points_m) == 0
    assert scan.dropped == 24
    assert any("no returns at all" in w for w in report.warnings)


def test_stride_takes_every_other_row_and_column(tmp_path: Path) -> None:
    path = with_camera(tmp_path / "a.mcap", ros().image(TOPIC, T0, np.full((4, 6), 1000, np.uint16), "16UC1"))
    (scan,), _ = read(path, ReadConfig(depth_stride=2))
    np.testing.assert_allclose(scan.points_m[:, 1:] * -100, [[u, v] for v in (0, 2) for u in (0, 2, 4)])


def test_a_tf_is_taken_instead_of_the_rule_for_optical_frames(tmp_path: Path) -> None:
    to = ros()
    path = with_camera(
        tmp_path / "a.mcap",
        to.tf(T0, "base_link", "camera_optical", 0.5, topic="/tf_static"),
        to.image(TOPIC, T0, DEPTH_M, "32FC1"),
    )
    (scan,), _ = read(path, EVERY_PIXEL)
    np.testing.assert_allclose(scan.points_m[0], [0.5 + 0.05, 0.025, 2.5], atol=1e-6)


def test_no_camera_info(tmp_path: Path) -> None:
    image = ros().image(TOPIC, T0, DEPTH_M, "32FC1")
    bare = write_mcap(tmp_path / "bare.mcap", [image])
    for config in (ReadConfig(), ReadConfig(topic=TOPIC)):
        with pytest.raises(NoScans, match=f"{TOPIC}: a depth image without a CameraInfo topic"):
            read(bare, config)
    schema = ros().schema("sensor_msgs/CameraInfo")
    silent = raw_log(
        tmp_path / "silent.mcap",
        [
            (INFO, "sensor_msgs/msg/CameraInfo", "ros2msg", schema, b""),
            (TOPIC, "sensor_msgs/msg/Image", "ros2msg", ros().schema("sensor_msgs/Image"), image.data),
        ],
    )
    with pytest.raises(NoScans, match=f"{INFO}: no message"):
        read(silent)


@pytest.mark.parametrize(
    ("image", "error", "words"),
    [
        (ros().image(TOPIC, T0, np.ones((5, 6), np.float32), "32FC1"), PointCloudError, "6 x 5 .* of 6 x 4"),
        (ros().image(TOPIC, T0, np.ones((4, 6), np.uint8), "16UC1"), PointCloudError, "24 bytes .rows of 6."),
        (ros().image(TOPIC, T0, np.ones((4, 6), np.uint8), "rgb8"), UnsupportedSchema, "'rgb8' is not"),
        (ros().compressed(TOPIC, T0, b"\0" * 40, "16UC1; compressedDepth png"), PointCloudError, "not a PNG"),
        (ros().compressed(TOPIC, T0, b"\0" * 4, "16UC1; compressedDepth png"), PointCloudError, "its header"),
        (ros().compressed(TOPIC, T0, bytes(12) + png(MILLIMETRES)[:60], "16UC1; compressedDepth png"),
         PointCloudError, "png of a depth image is damaged"),
        (ros().compressed(TOPIC, T0, png(np.ones((4, 6), "u1")), "16UC1; png"), PointCloudError, "16 bit"),
        (ros().compressed(TOPIC, T0, b"", "16UC1; compressedDepth rvl"), UnsupportedSchema, "rvl"),
        (ros().compressed(TOPIC, T0, b"", "bgr8; jpeg compressed bgr8"), UnsupportedSchema, "jpeg"),
    ],
)  # fmt: skip
def test_images_that_do_not_fit(tmp_path: Path, image: Message, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        read(with_camera(tmp_path / "a.mcap", image), EVERY_PIXEL)


def test_a_camera_without_focal_length(tmp_path: Path) -> None:
    to = ros()
    path = write_mcap(
        tmp_path / "a.mcap", [to.camera(INFO, T0, 6, 4, 0.0), to.image(TOPIC, T0, DEPTH_M, "32FC1")]
    )
    with pytest.raises(PointCloudError, match="without focal length"):
        read(path)
