"""The image of a nav2 map: grey, 8 bits, PGM or PNG."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import MapFileError

MAX_CELLS = 100_000_000


def read_image(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Grey and alpha of an image, each (H, W) in 0..1; alpha None if it has none.

    Raises MapFileError for what is not an image of 8 bits and grey, or is larger than MAX_CELLS.
    """
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        raise MapFileError(f"{path}: cannot read the map's image: {error}") from error
    if data[:2] in (b"P5", b"P2"):
        return _decode_pgm(path, data), None
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        _check_size(path, int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise MapFileError(f"{path}: not an image (or a damaged one)", hint="nav2 maps are 8-bit pgm or png")
    if image.dtype != np.uint8:
        raise MapFileError(f"{path}: {8 * image.itemsize} bits per channel", hint="save the map with 8 bits")
    _check_size(path, image.shape[1], image.shape[0])
    if image.ndim == 2:
        return np.asarray(image, dtype=np.float64) / 255.0, None
    alpha = np.asarray(image[..., -1], dtype=np.float64) / 255.0 if image.shape[2] in (2, 4) else None
    colours = image[..., : min(3, image.shape[2])].astype(np.int16)
    if image.shape[2] >= 3 and int(np.ptp(colours, axis=2).max()) > 2:
        raise MapFileError(f"{path}: a colour image", hint="maps are grey: 254 free, 0 occupied, 205 unknown")
    grey = image[..., 0] if image.shape[2] == 2 else colours.mean(axis=2)
    return np.asarray(grey, dtype=np.float64) / 255.0, alpha


def _check_size(path: Path, width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_CELLS:
        raise MapFileError(f"{path}: {width} x {height} pixels; the limit is {MAX_CELLS} cells")


def _decode_pgm(path: Path, data: bytes) -> NDArray[np.float64]:
    """Binary (P5) or text (P2) PGM to (H, W) in 0..1."""
    number = rb"(?:\s|#[^\n]*\n)+(\d{1,9})"
    header = re.match(rb"P[25]" + number * 3 + rb"\s", data)
    if header is None:
        raise MapFileError(f"{path}: the PGM header is damaged")
    width, height, top = (int(v) for v in header.groups())
    _check_size(path, width, height)
    if not 0 < top <= 255:
        raise MapFileError(f"{path}: PGM with maximum {top}", hint="save the map with 8 bits")
    body = data[header.end() :]
    if data[:2] == b"P2":
        try:
            values = np.array(re.sub(rb"#[^\n]*", b"", body).split(), dtype=np.int64)
        except (ValueError, OverflowError) as error:
            raise MapFileError(f"{path}: the PGM text is damaged") from error
    else:
        values = np.frombuffer(body, dtype=np.uint8)[: width * height].astype(np.int64)
    if len(values) != width * height or (
        values.size and not 0 <= int(values.min()) <= int(values.max()) <= top
    ):
        raise MapFileError(f"{path}: {width} x {height} pixels declared, {len(values)} usable found")
    return values.reshape(height, width) / float(top)


def encode_image(pixels: NDArray[np.uint8], suffix: str, resolution_m: float) -> bytes:
    """Pixels (H, W) as `pgm` or `png`; the resolution goes into a comment where there is one."""
    if suffix == "pgm":
        height, width = pixels.shape
        header = f"P5\n# CREATOR: pc2grid {resolution_m:.3f} m/pix\n{width} {height}\n255\n"
        return header.encode("ascii") + pixels.tobytes()
    import cv2

    done, encoded = cv2.imencode(".png", pixels)
    if not done:
        raise MapFileError(f"cannot encode a map image as {suffix}")
    return bytes(encoded.tobytes())
