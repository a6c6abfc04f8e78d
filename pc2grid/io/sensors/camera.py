"""The rays of a camera's pixels, by its CameraInfo, which is checked: a wrong one draws a wrong map."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.errors import PointCloudError, UnsupportedSchema

_STEEPEST = 1e3  # largest x / z and y / z of a ray: 0.06 degrees from the image plane
# What no camera has, chosen by hand: pixels so much longer than wide, and an image so many focal lengths wide
# (half a degree and 160 degrees).
_MOST_OBLONG = 3.0
_NARROWEST, _WIDEST = 0.01, 12.0
_FISHEYE = ("equidistant", "fisheye")
_OF_OPENCV = (4, 5, 8, 12, 14)
# Names of sensor_msgs/distortion_models.hpp: the number of coefficients there, and those that OpenCV reads.
_COEFFICIENTS: dict[str, tuple[int, tuple[int, ...]]] = {
    "": (5, _OF_OPENCV),
    "plumb_bob": (5, _OF_OPENCV),
    "rational_polynomial": (8, _OF_OPENCV),
    **dict.fromkeys(_FISHEYE, (4, (4,))),
}
_CALIBRATE = (
    "record the CameraInfo that the camera's driver publishes, or calibrate the camera; its K is "
    "fx 0 cx, 0 fy cy, 0 0 1, in pixels"
)


@functools.lru_cache(maxsize=2)
def pixel_rays(
    height: int,
    width: int,
    k: tuple[float, ...],
    p: tuple[float, ...],
    d: tuple[float, ...],
    distortion_model: str,
    rectified: bool,
    stride: int,
    camera: str,
) -> F32:
    """(n, 3) directions of the used pixels, row-major, scaled to z = 1; computed once for a camera.

    rectified : the image is undistorted already, so `p` describes it and not `k` with `d`.
    stride : every n-th row and column is used. camera : how errors name the CameraInfo.

    Raises PointCloudError for numbers that no camera has, UnsupportedSchema for another distortion model.
    """
    # K of zeros with a P is what some drivers publish.
    if (rectified or not (k[0] or any(d))) and p[0] > 0 and p[5] > 0:
        fx, cx, fy, cy = p[0], p[2], p[5], p[6]
        d = ()
    else:
        fx, cx, fy, cy = k[0], k[2], k[4], k[5]
    if why := _impossible(width, height, fx, fy, cx, cy):
        raise PointCloudError(f"{camera}: {why}", hint=_CALIBRATE)
    u, v = np.arange(0, width, stride, dtype=float), np.arange(0, height, stride, dtype=float)
    x, y = (u - cx) / fx, ((v - cy) / fy)[:, None]
    if any(d):
        _check_distortion(distortion_model, d, camera)
        columns, rows = np.meshgrid(u, v)
        x, y = _undistorted(columns, rows, np.reshape(k, (3, 3)), np.asarray(d), distortion_model)
    if not max(np.abs(x).max(initial=0.0), np.abs(y).max(initial=0.0)) < _STEEPEST:
        raise PointCloudError(f"{camera}: its distortion makes rays sideways or backwards", hint=_CALIBRATE)
    rays = np.ones((len(v), len(u), 3), np.float32)
    rays[..., 0], rays[..., 1] = x, y
    return rays.reshape(-1, 3)


def _impossible(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> str | None:
    """Why no camera has this matrix; None if one may."""
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        return f"a camera without focal length (fx {fx:g}, fy {fy:g})"
    if not 1 / _MOST_OBLONG <= fx / fy <= _MOST_OBLONG:
        return f"fx {fx:g} and fy {fy:g} are of no camera: its pixels are about square"
    if width and height and not (0 < cx < width and 0 < cy < height):
        return f"the centre ({cx:g}, {cy:g}) lies outside the image of {width} x {height} pixels"
    if width and not _NARROWEST <= width / fx <= _WIDEST:
        return f"fx {fx:g} is of no camera with {width} columns: it is measured in pixels"
    return None


def _check_distortion(model: str, d: tuple[float, ...], camera: str) -> None:
    """Raise UnsupportedSchema for an unknown model, PointCloudError for coefficients that are none of it."""
    if model not in _COEFFICIENTS:
        raise UnsupportedSchema(
            f"{camera}: the distortion model {model!r:.40} is not read",
            hint=f"supported: {', '.join(filter(None, _COEFFICIENTS))}",
        )
    usual, allowed = _COEFFICIENTS[model]
    if len(d) not in allowed:
        raise PointCloudError(
            f"{camera}: {len(d)} coefficients of distortion; {model or 'plumb_bob'} has {usual}",
            hint=_CALIBRATE,
        )
    if not np.isfinite(d).all():
        raise PointCloudError(f"{camera}: a coefficient of distortion is not finite", hint=_CALIBRATE)


def _undistorted(u: F64, v: F64, k: F64, d: F64, model: str) -> tuple[F64, F64]:
    pixels = np.stack((u.reshape(-1), v.reshape(-1)), axis=1)[:, None, :]
    undistort = cv2.fisheye.undistortPoints if model in _FISHEYE else cv2.undistortPoints
    rays = undistort(pixels, k, d)
    x, y = (rays[:, 0, axis].astype(np.float64).reshape(u.shape) for axis in (0, 1))
    return x, y
