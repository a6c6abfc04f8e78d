"""The image of a nav2 map: grey, 8 bits, PGM, PNG or BMP."""

from __future__ import annotations

import re
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
_MAX_TEXT_CELLS = 10_000_000  # each number of a text becomes a Python object
_MAX_BYTES = 4 * MAX_CELLS + (1 << 20)
_MAX_HEADER = 1 << 16


class GreyImage(NamedTuple):
    """Pixels with the values of the file, so that cells can be looked up by value instead of computed.

    values : (H, W) 0 (black) .. top (white). alpha : (H, W) 0 .. 255, or None if it has none.
    """

    values: NDArray[np.unsignedinteger[Any]]
    top: int
    alpha: NDArray[np.uint8] | None = None


def read_image(path: Path) -> GreyImage:
    """Read an image.

    Raises MapFileError for what is not a whole image of 8 bits and grey, or is larger than MAX_CELLS.
    """
    data = _content(path)
    if data[:2] in (b"P5", b"P2"):
        return _decode_pgm(path, data)
    if data[:8] == PNG_MAGIC:
        _check_png(path, data)
    elif data[:2] == b"BM":
        _check_bmp(path, data)
    else:
        if is_lfs_pointer(data):
            raise MapFileError(f"{path}: a Git LFS pointer to an image", hint=LFS_HINT)
        raise MapFileError(f"{path}: not an image of a map", hint="nav2 maps are 8-bit pgm, png or bmp")
    return _decoded(path, data)


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


def _decoded(path: Path, data: bytes) -> GreyImage:
    """A PNG or BMP that was checked."""
    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        found = None
    if found is None or found.size == 0:
        raise MapFileError(f"{path}: a damaged image", hint="copy or save the map again")
    image = found.astype(np.uint8, copy=False)
    if image.ndim == 2:
        return GreyImage(image, 255)
    colours = image[..., : min(3, image.shape[2])]
    alpha = image[..., -1] if image.shape[2] == 4 else None
    if int((colours.max(axis=2) - colours.min(axis=2)).max()) > 2:
        raise MapFileError(f"{path}: a colour image", hint="maps are grey: 254 free, 0 occupied, 205 unknown")
    return GreyImage(colours.sum(axis=2, dtype=np.uint16), 255 * colours.shape[2], alpha)


def _check_size(path: Path, width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_CELLS:
        raise MapFileError(f"{path}: {width} x {height} pixels; the limit is {MAX_CELLS} cells")


def _check_png(path: Path, data: bytes) -> None:
    """Check what OpenCV would take memory for; damage to the rest it sees by the checksums."""
    try:
        found = read_header(data)
    except ValueError as error:
        raise MapFileError(f"{path}: a damaged PNG: {error}", hint="copy or save the map again") from error
    if found.bits > 8:
        raise MapFileError(f"{path}: {found.bits} bits per channel", hint="save the map with 8 bits")
    _check_size(path, found.width, found.height)


def _check_bmp(path: Path, data: bytes) -> None:
    """Check that the image is uncompressed and as large as its header (BITMAPINFOHEADER) says."""
    width, height = (int.from_bytes(data[at : at + 4], "little", signed=True) for at in (18, 22))
    _check_size(path, width, abs(height))
    pixels, bits, packing = (int.from_bytes(data[a:b], "little") for a, b in ((10, 14), (28, 30), (30, 34)))
    row = (width * bits + 31) // 32 * 4
    if bits not in (8, 24, 32) or packing not in (0, 3) or len(data) < pixels + row * abs(height):
        raise MapFileError(f"{path}: a damaged or compressed BMP", hint="save the map as pgm or png")


def _decode_pgm(path: Path, data: bytes) -> GreyImage:
    """Binary (P5) or text (P2) PGM."""
    number = rb"(?:\s|#[^\n]*\n)+(\d{1,9})"
    header = re.match(rb"P[25]" + number * 3 + rb"\s", data[:_MAX_HEADER])
    if header is None:
        raise MapFileError(f"{path}: the PGM header is damaged")
    width, height, top = (int(v) for v in header.groups())
    _check_size(path, width, height)
    if not 0 < top <= 255:
        raise MapFileError(f"{path}: PGM with maximum {top}", hint="save the map with 8 bits")
    if data[:2] == b"P2":
        values = _text_values(path, data[header.end() :], width * height)
    else:
        values = np.frombuffer(data, np.uint8, offset=header.end())[: width * height]
    if len(values) != width * height:
        raise MapFileError(f"{path}: {width} x {height} pixels declared, {len(values)} found")
    if int(values.max()) > top:
        raise MapFileError(f"{path}: a pixel of {values.max()} in a PGM with maximum {top}")
    return GreyImage(values.reshape(height, width), top)


def _text_values(path: Path, body: bytes, count: int) -> NDArray[np.uint8]:
    """Pixels written as decimal numbers; `#` starts a comment up to the end of the line."""
    if count > _MAX_TEXT_CELLS:
        raise MapFileError(f"{path}: {count} pixels as text", hint="save the map as binary pgm (P5)")
    words = re.sub(rb"#[^\n]*", b"", body).split(maxsplit=count)[:count]
    try:
        return np.frombuffer(bytes(map(int, words)), np.uint8)
    except ValueError as error:
        raise MapFileError(f"{path}: the PGM text is damaged") from error


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
