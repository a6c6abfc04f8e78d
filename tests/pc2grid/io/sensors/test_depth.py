"""Depth images of every encoding, through a whole log: units, returns, cameras that do not fit."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from pc2grid.errors import NoScans, PointCloudError, UnsupportedSchema
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import T0, Message, raw_log, read, ros, write_mcap

INFO = "/camera/depth/camera_info"
TOPIC = "/camera/depth/image_raw"
EVERY_PIXEL = ReadConfig(depth_stride=1)
# Pixel (row 1, column 2) at 2.5 m with focal length 100 and axis at (1, 1), in body axes: x forward.
DEPTH_M = np.zeros((4, 6), np.float32)
DEPTH_M[1, 2] = 2.5
DEPTH_M[3, 0] = 1.25
EXPECTED = np.float32([[2.5, -2.5 * 1 / 100, 0], [1.25, 1.25 * 1 / 100, -1.25 * 2 / 100]])


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
    "named png": (png(MILLIMETRES), "png"),
    "without a format": (png(MILLIMETRES), ""),
    "compressedDepth without a format": (bytes(12) + png(MILLIMETRES), ""),
    "quantised without a format": (quantised(100.0, 7.0), "png"),
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
    images = [ros().image(TOPIC, T0 + i, p, "16UC1") for i, p in enumerate((nothing, MILLIMETRES))]
    (scan, _), report = read(with_camera(tmp_path / "a.mcap", *images), EVERY_PIXEL)
    assert len(scan.points_m) == 0
    assert scan.dropped == 24
    assert any("no returns at all" in w for w in report.warnings)


def test_stride_takes_every_other_row_and_column(tmp_path: Path) -> None:
    path = with_camera(tmp_path / "a.mcap", ros().image(TOPIC, T0, np.full((4, 6), 1000, np.uint16), "16UC1"))
    (scan,), _ = read(path, ReadConfig(depth_stride=2))
    np.testing.assert_allclose(scan.points_m[:, 1:] * -100, [[u, v] for v in (-1, 1) for u in (-1, 1, 3)])


def test_a_tf_is_taken_instead_of_the_rule_for_optical_frames(tmp_path: Path) -> None:
    to = ros()
    path = with_camera(
        tmp_path / "a.mcap",
        to.tf(T0, "base_link", "camera_optical", 0.5, topic="/tf_static"),
        to.image(TOPIC, T0, DEPTH_M, "32FC1"),
    )
    (scan,), _ = read(path, EVERY_PIXEL)
    np.testing.assert_allclose(scan.points_m[0], [0.5 + 0.025, 0.0, 2.5], atol=1e-6)


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
        (ros().compressed(TOPIC, T0, b"\0" * 50, "16UC1; compressedDepth png"), PointCloudError, "not a PNG"),
        (ros().compressed(TOPIC, T0, b"\0" * 4, "16UC1; compressedDepth png"), PointCloudError, "its header"),
        (ros().compressed(TOPIC, T0, bytes(12) + png(MILLIMETRES)[:60], "16UC1; compressedDepth png"),
         PointCloudError, "png of a depth image is damaged"),
        (ros().compressed(TOPIC, T0, png(np.ones((4, 6), "u1")), "16UC1; png"), PointCloudError, "16 bit"),
        (ros().compressed(TOPIC, T0, b"", "bgr8; jpeg compressed bgr8"), UnsupportedSchema, "jpeg"),
        (ros().compressed(TOPIC, T0, png(np.ones((4, 6), "u1")), "png"), PointCloudError, "16 bit"),
        (ros().compressed(TOPIC, T0, bytes(60), ""), UnsupportedSchema, "format '' is not read"),
        (ros().compressed(TOPIC, T0, bytes(60), "16UC1; compressedDepth rvl"), UnsupportedSchema, "republ"),
    ],
)  # fmt: skip
def test_images_that_do_not_fit(tmp_path: Path, image: Message, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        read(with_camera(tmp_path / "a.mcap", image), EVERY_PIXEL)


NO_CAMERA = {
    "no finite focal length": ({"k": [np.nan, 0, 3, 0, 5, 2, 0, 0, 1]}, "a camera without focal length"),
    "a negative one": ({"k": [-5, 0, 3, 0, -5, 2, 0, 0, 1]}, "a camera without focal length"),
    "no focal length": ({"k": np.zeros(9), "p": np.zeros(12)}, "a camera without focal length"),
    "fy of 1": ({"k": [80, 0, 0, 0, 1, 0, 0, 0, 0]}, "fx 80 and fy 1 are of no camera"),
    "no centre": ({"k": [5, 0, 0, 0, 5, 0, 0, 0, 1]}, r"the centre \(0, 0\) lies outside the image of 6 x 4"),
    "transposed": ({"k": [5, 0, 0, 0, 5, 0, 3, 2, 1]}, "the centre"),
    "of another size": ({"k": [50, 0, 30, 0, 50, 20, 0, 0, 1]}, r"the centre \(30, 20\)"),
    "not in pixels": ({"k": [0.4, 0, 0.5, 0, 0.6, 0.5, 0, 0, 1]}, "fx 0.4 is of no camera with 6 columns"),
    "six coefficients": ({"d": np.full(6, 1e-3)}, "6 coefficients of distortion; plumb_bob has 5"),
    "two of a fisheye": ({"d": [0.1, 0.1], "model": "equidistant"}, "2 coefficients .* equidistant has 4"),
    "not finite": ({"d": [0.1, np.nan, 0, 0, 0]}, "a coefficient of distortion is not finite"),
}


@pytest.mark.parametrize("case", NO_CAMERA)
def test_a_camera_info_of_no_camera_is_named(tmp_path: Path, case: str) -> None:
    changes, words = NO_CAMERA[case]
    camera = ros().camera(INFO, T0, 6, 4, 100.0, **changes)
    path = write_mcap(tmp_path / "a.mcap", [camera, ros().image(TOPIC, T0, DEPTH_M, "32FC1")])
    with pytest.raises(PointCloudError, match=f"{INFO}: {words}") as caught:
        read(path)
    assert "calibrate the camera" in str(caught.value.hint)


def test_a_k_of_zeros_beside_a_p(tmp_path: Path) -> None:
    camera = ros().camera(INFO, T0, 6, 4, 100.0, k=np.zeros(9))
    path = write_mcap(tmp_path / "a.mcap", [camera, ros().image(TOPIC, T0, DEPTH_M, "32FC1")])
    np.testing.assert_allclose(read(path, EVERY_PIXEL)[0][0].points_m, EXPECTED, atol=1e-6)


def test_depths_in_millimetres_where_metres_are_expected(tmp_path: Path) -> None:
    image = ros().image(TOPIC, T0, (1000 * DEPTH_M).astype(np.float32), "32FC1")
    path = with_camera(tmp_path / "a.mcap", image)
    with pytest.raises(PointCloudError, match="metres") as caught:
        read(path, EVERY_PIXEL)
    assert "read.depth_unit_m=0.001" in str(caught.value.hint)
    (scan,), _ = read(path, EVERY_PIXEL.model_copy(update={"depth_unit_m": 0.001}))
    np.testing.assert_allclose(scan.points_m, EXPECTED, atol=1e-6)


def floor_ahead(unit_m: float, height_m: float = 0.5) -> list[Message]:
    """Six images of a level floor, 1 m to 10 m ahead of a camera that tf puts at a height."""
    to, focal, below = ros(), 40.0, np.arange(30) - 0.001
    depth_m = np.repeat(0.5 * focal / np.where(below > 0, below, 1e-3)[:, None], 20, axis=1)
    values = np.where(depth_m < 10, depth_m / unit_m, 0).astype(np.uint16)
    messages = [
        to.tf(T0, "base_link", "camera", 0.0, z_m=height_m, quaternion=OPTICAL, topic="/tf_static"),
        to.camera(INFO, T0, 20, 30, focal, k=[focal, 0, 10, 0, focal, 0.001, 0, 0, 1]),
    ]
    return messages + [to.image(TOPIC, T0 + i, values, "16UC1", frame="camera") for i in range(6)]


OPTICAL = (-0.5, 0.5, -0.5, 0.5)


def test_a_floor_that_lies_too_deep_tells_of_the_unit(tmp_path: Path) -> None:
    """A camera of 0.2 mm, read in millimetres, sees the floor five times as far below."""
    path = write_mcap(tmp_path / "a.mcap", floor_ahead(0.0002))
    (warning,) = [w for w in read(path)[1].warnings if "depth_unit_m" in w]
    assert "5.0 times as far under the camera as tf says (0.50 m)" in warning
    assert "--set read.depth_unit_m=0.0002" in warning
    scans, report = read(path, ReadConfig(depth_unit_m=0.0002))
    assert not report.warnings
    np.testing.assert_allclose(scans[0].points_m[:, 2], 0.0, atol=0.02)
    for messages in (floor_ahead(0.001), floor_ahead(0.0002, height_m=0.0)):
        assert not read(write_mcap(tmp_path / "b.mcap", messages))[1].warnings


@pytest.mark.parametrize("name", ["Depth Units", "Depth_Units"])
def test_the_unit_that_a_realsense_bag_names(tmp_path: Path, name: str) -> None:
    to = ros()
    unit = to.message(f"/device_0/sensor_0/option/{name}/value", T0, to.make("std_msgs/Float32", 0.0002))
    image = to.image(TOPIC, T0, np.round(DEPTH_M / 0.0002).astype(np.uint16), "mono16")
    (scan,), report = read(with_camera(tmp_path / "a.mcap", unit, image), EVERY_PIXEL)
    np.testing.assert_allclose(scan.points_m, EXPECTED, atol=1e-5)
    assert any("units of 0.0002 m" in w for w in report.warnings)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, 1e300])
@pytest.mark.parametrize("place", range(5))
def test_cameras_with_absurd_distortion(tmp_path: Path, value: float, place: int) -> None:
    """Refused, or points that are possible: never NaN."""
    camera = ros().camera(INFO, T0, 6, 4, 100.0)
    at = camera.data.index(struct.pack("<d", 100.0)) - 40 + 8 * place  # d stands right before k
    assert camera.data[at : at + 8] == bytes(8)
    camera = camera._replace(data=camera.data[:at] + struct.pack("<d", value) + camera.data[at + 8 :])
    image = ros().image(TOPIC, T0, np.full((4, 6), 1000, np.uint16), "16UC1")
    try:
        (scan,), _ = read(write_mcap(tmp_path / "a.mcap", [camera, image]))
    except PointCloudError as error:
        assert INFO in error.message
    else:
        assert np.isfinite(scan.points_m).all()


def camera(model: str, d: list[float]) -> Message:
    """A CameraInfo of 64 x 48 pixels, its axis in the middle."""
    k, p = [40.0, 0, 32, 0, 40, 24, 0, 0, 1], [40.0, 0, 32, 0, 0, 40, 24, 0, 0, 0, 1, 0]
    return ros().camera(INFO, T0, 64, 48, 40.0, d=np.array(d), k=np.array(k), p=np.array(p), model=model)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_distorted_image_projects_back_onto_its_pixels(tmp_path: Path, model: str) -> None:
    """By OpenCV's projection, the inverse of what is used for reading."""
    d = [-0.1, 0.02, 0.001, -0.001, 0.0] if model == "plumb_bob" else [0.01, -0.004, 0.002, 0.0]
    image = ros().image(TOPIC, T0, np.full((48, 64), 2000, np.uint16), "16UC1")
    path = write_mcap(tmp_path / "a.mcap", [camera(model, d), image])
    (scan,), _ = read(path, ReadConfig(depth_stride=1))
    optical = np.column_stack((-scan.points_m[:, 1], -scan.points_m[:, 2], scan.points_m[:, 0]))
    k = np.array([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    pixels = project(optical.astype(float)[:, None], np.zeros(3), np.zeros(3), k, np.array(d))[0][:, 0]
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(pixels, np.column_stack((u.ravel(), v.ravel())), atol=0.05)
    rectified = write_mcap(
        tmp_path / "b.mcap", [camera(model, d), image._replace(topic="/camera/depth/image_rect")]
    )
    (plain,), _ = read(rectified, ReadConfig(depth_stride=1))
    np.testing.assert_allclose(plain.points_m[:, 1], -(u.ravel() - 32) / 40 * 2, atol=1e-5)


def test_an_image_without_pixels_is_an_empty_scan(tmp_path: Path) -> None:
    to = ros()
    images = [to.image(TOPIC, T0 + i, np.ones((i, i), np.uint16), "16UC1") for i in (0, 2)]
    (scan, _), _ = read(write_mcap(tmp_path / "a.mcap", [to.camera(INFO, T0, 0, 0, 40.0), *images]))
    assert scan.points_m.shape == (0, 3)
