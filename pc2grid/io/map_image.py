"""The image of a nav2 map: PGM and its kin, PNG, BMP or JPEG, decoded by OpenCV once its size is known."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import MapFileError
from pc2grid.io.error_translation import LFS_HINT, is_lfs_pointer
from pc2grid.io.sensors.png_header import MAGIC as PNG_MAGIC
from pc2grid.io.sensors.png_header import read_header

MAX_CELLS = 100_000_000
_MAX_BYTES = 4 * MAX_CELLS + (1 << 20)
_DEEPEST = 65_535  # the largest white of a PGM
_NUMBER = rb"(?:\s|#[^\n]*\n)+(\d{1,9})"
_PNM = re.compile(rb"P([1-6])" + _NUMBER * 2 + rb"(?:" + _NUMBER + rb")?\s")  # bitmaps have no white
_PNG_KIND, _PNG_GREY, _PNG_FIRST = 25, 0, 33  # where the kind of pixels stands, and where the header ends
_JPEG_MAGIC, _JPEG_FRAMES = b"\xff\xd8\xff", {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
# A block of 8 x 8 pixels takes a bit at least.
_MOST_PIXELS_A_JPEG_BYTE = 512
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what is damaged is said by our errors


class MapImage(NamedTuple):
    """Pixels with the values of the file, so that cells can be looked up by value instead of computed.

    colours : (H, W) of unsigned integers, the sum of the colours of a pixel: 0 (black) .. white.
    alpha : (H, W) 0 .. opaque, or None if it has none. opaque : white of one channel.
    """

    colours: NDArray[np.unsignedinteger]
    white: int
    alpha: NDArray[np.unsignedinteger] | None
    opaque: int


def read_image(path: Path) -> MapImage:
    """Read an image.

    Raises MapFileError for what is not a whole image, or is larger than MAX_CELLS.
    """
    data = _content(path)
    try:
        size = _size(data)
    except (ValueError, struct.error) as error:
        if is_lfs_pointer(data):
            raise MapFileError(f"{path}: a Git LFS pointer to an image", hint=LFS_HINT) from error
        reason = "it is cut off" if isinstance(error, struct.error) else error
        raise MapFileError(
            f"{path}: not the image of a map: {reason}", hint="maps are pgm, png, bmp or jpg"
        ) from error
    if size.width < 1 or size.height < 1 or size.width * size.height > MAX_CELLS:
        raise MapFileError(f"{path}: {size.width} x {size.height} pixels; the limit is {MAX_CELLS} cells")
    return _decoded(path, data, size)


def _decoded(path: Path, data: bytes, size: _Size) -> MapImage:
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        found = None
    if found is None:
        raise MapFileError(f"{path}: a damaged image", hint="copy or save the map again")
    deep = found.dtype == np.uint16
    pixels: NDArray[Any] = np.atleast_3d(found)
    opaque = size.white or (65_535 if deep else 255)
    if size.white is not None:
        np.minimum(pixels, size.white, out=pixels)
    if size.transparent is not None and pixels.shape[2] == 1:
        alpha = np.where(pixels == size.transparent, 0, opaque).astype(pixels.dtype)
        pixels = np.concatenate((pixels, pixels, pixels, alpha), axis=2)
    if pixels.shape[2] == 1:
        return MapImage(pixels[..., 0], opaque, None, opaque)
    # With alpha, four channels of 8 bits add up in 16.
    colours = pixels[..., :3].sum(axis=2, dtype=np.uint32 if deep else np.uint16)
    return MapImage(colours, 3 * opaque, pixels[..., 3] if pixels.shape[2] == 4 else None, opaque)


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


class _Size(NamedTuple):
    """white : of a channel, where a decoded image is not scaled to all its bits.

    transparent : the grey that stands for it, of which OpenCV makes no alpha.
    """

    width: int
    height: int
    white: int | None = None
    transparent: int | None = None


def _size(data: bytes) -> _Size:
    """Return what the header claims, before OpenCV takes memory for it.

    Raises ValueError or struct.error if it is no image of a map, or too short for its claims.
    """
    most_pixels = 8 * len(data)
    if data.startswith(PNG_MAGIC):
        header = read_header(data)
        return _Size(header.width, header.height, transparent=_transparent_grey(data, header.bits))
    if data.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", data, 18)
        size = _Size(width, abs(height))
    elif found := _PNM.match(data):
        size = _size_of_pnm(found)
    elif data.startswith(_JPEG_MAGIC):
        size = _size_of_jpeg(data)
        most_pixels = _MOST_PIXELS_A_JPEG_BYTE * len(data)
    else:
        raise ValueError("of another format")
    if abs(size.width * size.height) > most_pixels:
        raise ValueError(f"{len(data)} bytes cannot hold {size.width} x {size.height} pixels")
    return size


def _transparent_grey(png: bytes, bits: int) -> int | None:
    """Return the value of the decoded pixels that the chunk tRNS of a grey PNG names, if it has one."""
    if png[_PNG_KIND] != _PNG_GREY:
        return None
    at = _PNG_FIRST
    while (name := png[at + 4 : at + 8]) not in (b"IDAT", b"tRNS", b""):
        at += 12 + int.from_bytes(png[at : at + 4], "big")
    if name != b"tRNS":
        return None
    value = int.from_bytes(png[at + 8 : at + 10], "big")
    return value * 255 // (2**bits - 1) if bits < 8 else value  # fewer bits are scaled to 8


def _size_of_pnm(header: re.Match[bytes]) -> _Size:
    kind, width, height = int(header[1]), int(header[2]), int(header[3])
    if kind in (1, 4):  # bits
        return _Size(width, height)
    white = int(header[4] or 0)
    if not 0 < white <= _DEEPEST:
        raise ValueError(f"its white is {white}")
    text = kind in (2, 3)
    return _Size(width, height, None if text and white <= 255 else white)  # OpenCV scales that text to 255


def _size_of_jpeg(data: bytes) -> _Size:
    at = 2
    while True:
        mark, kind, length = struct.unpack_from(">BBH", data, at)
        if mark != 0xFF:
            raise ValueError("its header makes no sense")
        if kind in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return _Size(width, height)
        at += 1 if kind == 0xFF else 2 + length  # bytes of 0xFF may stand before a mark


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
