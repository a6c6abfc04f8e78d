"""The image of a nav2 map: grey, 8 bits, PGM, PNG or BMP, decoded by OpenCV once its size is known."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import MapFileError
from pc2grid.io.error_translation import LFS_HINT, is_lfs_pointer
from pc2grid.io.sensors.png_header import MAGIC as PNG_MAGIC
from pc2grid.io.sensors.png_header import read_header

MAX_CELLS = 100_000_000
_MAX_BYTES = 4 * MAX_CELLS + (1 << 20)
_MOST_COLOUR = 2  # between the channels of a pixel that is grey but for its rounding
_PGM = re.compile(rb"P[25]" + rb"(?:\s|#[^\n]*\n)+(\d{1,9})" * 3 + rb"\s")
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what is damaged is said by our errors


class GreyImage(NamedTuple):
    """Pixels with the values of the file, so that cells can be looked up by value instead of computed.

    values : (H, W) 0 (black) .. 255. alpha : (H, W) 0 .. 255, or None if it has none.
    """

    values: NDArray[np.uint8]
    alpha: NDArray[np.uint8] | None = None


def read_image(path: Path) -> GreyImage:
    """Read an image.

    Raises MapFileError for what is not a whole image of 8 bits and grey, or is larger than MAX_CELLS.
    """
    data = _content(path)
    try:
        width, height = _size(data)
    except (ValueError, struct.error) as error:
        if is_lfs_pointer(data):
            raise MapFileError(f"{path}: a Git LFS pointer to an image", hint=LFS_HINT) from error
        raise MapFileError(
            f"{path}: not the image of a map: {error}", hint="nav2 maps are 8-bit pgm, png or bmp"
        ) from error
    if width < 1 or height < 1 or width * height > MAX_CELLS:
        raise MapFileError(f"{path}: {width} x {height} pixels; the limit is {MAX_CELLS} cells")
    return _decoded(path, data)


def _decoded(path: Path, data: bytes) -> GreyImage:
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        found = None
    if found is None:
        raise MapFileError(f"{path}: a damaged image", hint="copy or save the map again")
    if found.dtype != np.uint8:
        raise MapFileError(f"{path}: pixels of {8 * found.itemsize} bits", hint="save the map with 8 bits")
    image = np.atleast_3d(found).astype(np.uint8, copy=False)
    colours = image[..., :3]
    if int((colours.max(axis=2) - colours.min(axis=2)).max()) > _MOST_COLOUR:
        raise MapFileError(f"{path}: a colour image", hint="maps are grey: 254 free, 0 occupied, 205 unknown")
    return GreyImage(image[..., 0], image[..., 3] if image.shape[2] == 4 else None)


def _content(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():  # reading a device or a pipe might not end
            raise MapFileError(f"{path}: the map's image is not a regular file")
        if path.stat().st_size > _MAX_BYTES:
            raise MapFileError(f"{path}: larger than {_MAX_BYTES} bytes: not the image of a map")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or error
        raise MapFileError(
            f"{path.absolute()}: cannot read the map's image: {what}",
            hint="the key `image` of the .yaml names it: copy it to that place, or correct the name",
        ) from error


def _size(data: bytes) -> tuple[int, int]:
    """The width and height that the header claims, before OpenCV takes memory for them.

    Raises ValueError or struct.error if it is no image of a map, or too short for its claims.
    """
    if data.startswith(PNG_MAGIC):
        header = read_header(data)
        return header.width, header.height
    if data.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", data, 18)
    elif found := _PGM.match(data):
        width, height, top = map(int, found.groups())
        if top != 255:
            raise ValueError(f"a PGM whose white is {top}, not 255")
    else:
        raise ValueError("of another format")
    if abs(width * height) > 8 * len(data):
        raise ValueError(f"{len(data)} bytes cannot hold {width} x {abs(height)} pixels")
    return width, abs(height)


def encode_image(pixels: NDArray[np.uint8], suffix: str, resolution_m: float) -> bytes:
    """Pixels (H, W) as `pgm` or `png`; a pgm carries the resolution in a comment."""
    if suffix == "pgm":
        height, width = pixels.shape
        header = f"P5\n# CREATOR: pc2grid {resolution_m:.3f} m/pix\n{width} {height}\n255\n"
        return header.encode("ascii") + pixels.tobytes()
    done, encoded = cv2.imencode(".png", pixels)
    if not done:
        raise MapFileError(f"cannot encode a map image as {suffix}")
    return bytes(encoded.tobytes())
