"""Depth images to points in the camera's optical frame (x right, y down, z forward; REP-103).

Open3D's `create_from_depth_image` gives the same points in half the time (0.8 instead of 1.6 ms for every
second pixel of 640 x 480), but cannot undistort, so it would be a second path beside this one. The png takes
2.9 ms.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from pc2grid.errors import LimitExceeded, PointCloudError, UnsupportedSchema
from pc2grid.io.messages.types import Bytes, CameraInfo, CompressedImage, Image
from pc2grid.io.sensors.camera import pixel_rays
from pc2grid.io.sensors.png_header import MAGIC, read_header
from pc2grid.io.sensors.pointcloud2 import Points

# REP-103: body x forward, y left, z up from optical z forward, x right, y down.
T_BODY_OPTICAL: F64 = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_METRE_M, _MILLIMETRE_M = 1.0, 1e-3
_LAYOUTS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_NOT_READ = ("jpeg", "rvl")  # how image_transport compresses, too
_CONFIG_HEADER = struct.Struct("<iff")  # compressed_depth_image_transport: format, depth_param a and b


class _Depths(NamedTuple):
    """values : those of the used pixels, of which one is `unit_m` metres if nothing else is said.
    shape : rows and columns of all pixels.
    """

    values: F32
    unit_m: float
    shape: tuple[int, ...]


def decode(
    image: Image | CompressedImage,
    info: CameraInfo,
    *,
    rectified: bool = False,
    stride: int = 1,
    max_points: int = 20_000_000,
    unit_m: float | None = None,
    camera: str = "CameraInfo",
) -> Points:
    """Points of a depth image; pixels without a return (0, NaN, inf, 65535 of 16 bits) are dropped.

    rectified : the image is undistorted already, so `info.p` describes it and not `info.k` with `info.d`.
    stride : use every n-th row and column. unit_m : of a depth; None: millimetres in 16 bits, metres in
    floats (REP 118). camera : how errors name `info`.

    Raises PointCloudError if image and camera do not fit, UnsupportedSchema for another encoding.
    """
    if isinstance(image, Image):
        values, usual_m, (height, width) = _raw_depth(image, max_points, stride)
    else:
        values, usual_m, (height, width) = _compressed_depth(image, max_points, stride)
    if (info.height, info.width) not in ((height, width), (0, 0)):
        raise PointCloudError(
            f"a depth image of {width} x {height} pixels with a CameraInfo of {info.width} x {info.height}"
        )
    rays = pixel_rays(height, width, info.k, info.p, info.d, info.distortion_model, rectified, stride, camera)
    unit_m = unit_m or usual_m
    flat = values.reshape(-1) * np.float32(unit_m)
    keep = np.isfinite(flat) & (flat > 0)
    points = rays[keep] * flat[keep, None]
    return Points(points, None, len(flat) - len(points), unit_m=unit_m)


def holds_depths(image: Image | CompressedImage) -> bool:
    """Whether an image is one of depths, by its encoding or content: the name of a topic may not say so."""
    if isinstance(image, Image):
        return image.encoding in ("16UC1", "32FC1")
    if image.format.partition(";")[0].strip() in _LAYOUTS:
        return True
    try:
        header = read_header(memoryview(image.data)[_png_start(image.data) :])
    except ValueError:
        return False
    return (header.bits, header.channels) == (16, 1)


def _raw_depth(image: Image, max_points: int, stride: int) -> _Depths:
    layout = _LAYOUTS.get(image.encoding)
    if layout is None:
        raise UnsupportedSchema(
            f"an image of encoding {image.encoding!r:.40} is not a depth image",
            hint="supported: 16UC1 (millimetres) and 32FC1 (metres)",
        )
    dtype = np.dtype((">" if image.is_bigendian else "<") + layout)
    _check_size(image.height, image.width, max_points)
    step = image.step or image.width * dtype.itemsize
    needed = (image.height - 1) * step + image.width * dtype.itemsize if image.height and image.width else 0
    if step < image.width * dtype.itemsize or len(image.data) < needed:
        raise PointCloudError(
            f"{len(image.data)} bytes (rows of {step}) for {image.width} x {image.height} pixels of "
            f"{image.encoding}"
        )
    if not needed:
        return _Depths(np.empty((0, 0), np.float32), _METRE_M, (image.height, image.width))
    shape, strides = (image.height, image.width), (step, dtype.itemsize)
    values = np.ndarray(shape, dtype, buffer=image.data, strides=strides)[::stride, ::stride]
    return _Depths(_floats(values), _METRE_M if dtype.kind == "f" else _MILLIMETRE_M, shape)


def _floats(values: NDArray[Any]) -> F32:
    """Depths as float32; 65535 means "too far" for some sensors."""
    if values.dtype.kind == "u":
        values = np.where(values == 65535, 0, values)
    return values.astype(np.float32)


def _compressed_depth(image: CompressedImage, max_points: int, stride: int) -> _Depths:
    """Of image_transport's compressedDepth, or a plain png.

    The format is a text such as `16UC1; compressedDepth png`, but other writers say only `png`, or nothing:
    a png of 16 bits is what it is. Before it there may be 12 bytes: a format code and the parameters a and b
    by which 32FC1 was quantised, `depth = a / (value - b)`, zero for 16UC1.
    """
    encoding, _, transport = (part.strip() for part in image.format.partition(";"))
    data = memoryview(image.data)
    start = _png_start(data)
    readable = encoding in _LAYOUTS and not any(other in transport for other in _NOT_READ)
    if not readable and bytes(data[start : start + len(MAGIC)]) != MAGIC:
        raise UnsupportedSchema(
            f"a compressed image of format {image.format!r:.60} is not read",
            hint="read are a png of 16 bits, and compressedDepth png of 16UC1 or 32FC1; of others, "
            "`image_transport republish` makes an Image",
        )
    if len(data) < start:
        raise PointCloudError("a compressedDepth image is shorter than its header")
    a, b = _CONFIG_HEADER.unpack_from(data)[1:] if start else (0.0, 0.0)
    values = _pixels(data[start:], max_points)
    kept = values[::stride, ::stride]
    if encoding == "32FC1" or (encoding not in _LAYOUTS and a > 0):
        return _Depths(_dequantised(kept, a, b), _METRE_M, values.shape)
    return _Depths(_floats(kept), _MILLIMETRE_M, values.shape)


def _png_start(data: Bytes) -> int:
    """Where the image begins: behind the header of compressedDepth, unless the data is a plain png."""
    return 0 if bytes(data[: len(MAGIC)]) == MAGIC else _CONFIG_HEADER.size


def _pixels(data: memoryview, max_points: int) -> NDArray[np.uint16]:
    """(H, W) the values of a png of 16 bits."""
    try:
        found = read_header(data)
    except ValueError as error:
        raise PointCloudError(f"the png of a depth image is damaged: {error}") from error
    _check_size(found.height, found.width, max_points)
    if (found.bits, found.channels) != (16, 1):
        raise PointCloudError("the png of a depth image has not one channel of 16 bits")
    try:
        values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        values = None
    if values is None or values.shape != (found.height, found.width) or values.dtype != np.uint16:
        raise PointCloudError("the png of a depth image is damaged")
    return values.astype(np.uint16, copy=False)


def _dequantised(values: NDArray[np.uint16], a: float, b: float) -> F32:
    """Metres of values that image_transport made of float metres; 0 is no return."""
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.float32(a) / (values.astype(np.float32) - np.float32(b))
    return np.where(values == 0, np.float32(0), metres).astype(np.float32)


def _check_size(height: int, width: int, max_points: int) -> None:
    if height * width > max_points:
        raise LimitExceeded(
            f"a depth image of {width} x {height} pixels; the limit is {max_points} points",
            hint="--set read.max_points=N raises it",
        )
