"""Images of nav2 maps as nav2 reads them, against its rules by hand."""

from __future__ import annotations

import io
import math
import struct
import tempfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from pc2grid.errors import MapFileError
from pc2grid.io.nav2_map import load_map

KEYS: dict[str, Any] = {
    "resolution": 0.05,
    "origin": [0, 0, 0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
GREYS = np.array([[254, 0, 205], [0, 254, 0]], np.uint8)
CELLS = [[100, 0, 100], [0, 100, -1]]


def map_of(folder: Path, image: bytes, name: str = "m.png", **keys: object) -> Path:
    (folder / name).write_bytes(image)
    path = folder / "m.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in {"image": name, **KEYS, **keys}.items()))
    return path


def png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])


def png_of(width: int, bits: int, kind: int, row: bytes, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of one row, by its standard: no library writes some of them."""
    header = struct.pack(">IIBBBBB", width, 1, bits, kind, 0, 0, 0)
    parts = [(b"IHDR", header), *chunks, (b"IDAT", zlib.compress(b"\0" + row)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in parts
    )


def by_pillow(image: Image.Image, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def by_nav2(pixel: list[int], white: int, keys: dict[str, Any]) -> int:
    """nav2_map_server of Humble, map_io.cpp, `loadMapFromFile`: the cell of a pixel's channels."""
    colours, alpha = (pixel[:3], pixel[3]) if len(pixel) == 4 else (pixel, None)
    counted = [*colours, alpha] if alpha is not None and keys["mode"] == "trinary" else colours
    shade = sum(counted) / (len(counted) * white)
    if keys["mode"] == "raw":
        percent = math.floor(shade * 255 + 0.5)
        return percent if percent <= 100 else -1
    if keys["mode"] == "scale" and alpha is not None and alpha < white:
        return -1
    occupied = shade if keys["negate"] else 1 - shade
    if occupied > keys["occupied_thresh"]:
        return 100
    if occupied < keys["free_thresh"]:
        return 0
    if keys["mode"] == "trinary":
        return -1
    return round((occupied - keys["free_thresh"]) / (keys["occupied_thresh"] - keys["free_thresh"]) * 100)


@settings(max_examples=150, deadline=None)
@given(data=st.data(), mode=st.sampled_from(["trinary", "scale", "raw"]), negate=st.booleans())
def test_depths_colours_and_alpha_are_read_as_by_nav2(data: st.DataObject, mode: str, negate: bool) -> None:
    kind = data.draw(st.sampled_from([np.uint8, np.uint16]))
    channels = data.draw(st.sampled_from([1, 3, 4]))
    white = np.iinfo(kind).max
    values = st.one_of(st.integers(0, white), st.sampled_from([0, white, white * 205 // 255]))
    pixels = data.draw(hnp.arrays(kind, (2, 3, channels), elements=values))
    keys = {**KEYS, "mode": mode, "negate": int(negate), "occupied_thresh": 0.6543, "free_thresh": 0.1234}
    with tempfile.TemporaryDirectory() as folder:
        cells = load_map(map_of(Path(folder), png(pixels), **keys), lambda sentence: None).cells
    expected = [[by_nav2(pixel, white, keys) for pixel in row] for row in pixels.tolist()]
    assert cells[::-1].tolist() == expected


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("text.pgm", b"P2\n3 2\n255\n254 0 205\n0 254 0\n"),
        ("deep text.pgm", b"P2 3 2 65535 65278 0 52685 0 65278 0\n"),
        ("deep.pgm", b"P5 # made\n3 2\n65535\n" + (GREYS.astype(">u2") * 257).tobytes()),
        ("12 bits.pgm", b"P5 3 2 4095\n" + (GREYS * (4095 / 255)).astype(">u2").tobytes()),
        ("white 100.pgm", b"P5 3 2 100\n" + bytes([100, 0, 80, 0, 99, 0])),
        ("white 10.pgm", b"P2 3 2 10\n10 0 8 0 10 0\n"),
        ("colour.ppm", b"P6 3 2 255\n" + np.repeat(GREYS, 3).tobytes()),
        ("deep.png", png(GREYS.astype(np.uint16) * 257)),
        ("deep colour.png", png(np.dstack([GREYS.astype(np.uint16) * 257] * 3))),
        ("palette.png", by_pillow(Image.fromarray(GREYS).quantize(4), "PNG", bits=2)),
        ("palette.bmp", by_pillow(Image.fromarray(GREYS), "BMP")),
        ("32 bits.bmp", by_pillow(Image.fromarray(GREYS).convert("RGB"), "BMP")),
    ],
)  # fmt: skip
def test_formats_that_say_the_same(tmp_path: Path, name: str, image: bytes) -> None:
    said: list[str] = []
    grid = load_map(map_of(tmp_path, image, name), said.append)
    assert grid.cells.tolist() == CELLS and not said


@pytest.mark.parametrize(
    ("name", "image", "cells"),
    [
        ("bits.pbm", b"P4 # made\n9 1\n\xa0\x80", [100, 0, 100, 0, 0, 0, 0, 0, 100]),
        ("text.pbm", b"P1 4 1\n1 0\n1 0\n", [100, 0, 100, 0]),
        ("1 bit.png", png_of(4, 1, 0, b"\x50"), [100, 0, 100, 0]),
        ("2 bits.png", png_of(4, 2, 0, b"\x1b"), [100, 100, -1, 0]),
        # Of a pixel with alpha, shades are means of four: black is .25 if opaque, white .75 if not.
        ("grey alpha.png", png_of(4, 8, 4, b"\0\xff\xff\xff\xff\0\xcd\0"), [100, 0, -1, -1]),
        ("deep grey alpha.png", png_of(2, 16, 4, b"\0\0\xff\xff\xff\xff\0\0"), [100, -1]),
        (
            "palette alpha.png",
            png_of(
                4, 2, 3, b"\x1b",
                (b"PLTE", bytes([0] * 3 + [254] * 3 + [205] * 6)), (b"tRNS", b"\xff\xff\xff\0"),
            ),
            [100, 0, 0, -1],
        ),
        ("transparent.png", by_pillow(Image.fromarray(GREYS[:1]), "PNG", transparency=254), [-1, 100, 0]),
        ("1 bit is transparent.png", png_of(4, 1, 0, b"\x50", (b"tRNS", b"\0\1")), [100, -1, 100, -1]),
        ("deep transparent.png", png_of(2, 16, 0, b"\xff\xff\0\0", (b"tRNS", b"\xff\xff")), [-1, 100]),
        # A mark in red, by its mean a third of white, one in yellow, two thirds.
        ("mark.png", png(np.array([[[0, 0, 255], [0, 255, 255], [254] * 3]], np.uint8)), [100, -1, 0]),
    ],
)  # fmt: skip
def test_formats_by_hand(tmp_path: Path, name: str, image: bytes, cells: list[int]) -> None:
    assert load_map(map_of(tmp_path, image, name)).cells.tolist() == [cells]


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
@pytest.mark.parametrize("progressive", [False, True])
def test_photos(tmp_path: Path, mode: str, progressive: bool) -> None:
    greys = np.kron(GREYS, np.ones((16, 16), np.uint8))
    photo = by_pillow(Image.fromarray(greys).convert(mode), "JPEG", quality=100, progressive=progressive)
    cells = load_map(map_of(tmp_path, photo, "m.jpg")).cells
    assert cells[8::16, 8::16].tolist() == CELLS
    with pytest.raises(MapFileError, match=r"m\.jpg: not the image of a map"):
        load_map(map_of(tmp_path, photo[:40], "m.jpg"))


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (b"\xff\xd8\xff\xc0\x00\x11\x08\x23\x28\x23\x28\x03" + bytes(90), "cannot hold 9000 x 9000"),
        (b"\xff\xd8\xff\xff\xff\xff\xe0\x00\x02\xff\xc0\x00\x11\x08\0\0\0\x05", "5 x 0 pixels"),
        (b"\xff\xd8\xff\xe0\x00\x02\x00\xc0\x00\x11\x08\0\x01\0\x05", "its header makes no sense"),
        (b"\xff\xd8\xff\xe0\x00\x02", "it is cut off"),
        (b"P5 2 2 65536\n" + bytes(8), "its white is 65536"),
        (b"P5 2 2\n" + bytes(8), "its white is 0"),
        (b"P6 9000 9000 255\n" + bytes(99), "cannot hold"),
        (b"P4 9000 9000\n" + bytes(99), "cannot hold"),
    ],
)
def test_headers_that_lie(tmp_path: Path, image: bytes, words: str) -> None:
    with pytest.raises(MapFileError, match=words):
        load_map(map_of(tmp_path, image))


@pytest.mark.parametrize(
    ("mode", "cells"), [("Trinary", [100, 0, -1]), ("SCALE", [100, 0, 0]), ("Raw", [0, -1, -1])]
)
def test_modes_are_read_in_any_case(tmp_path: Path, mode: str, cells: list[int]) -> None:
    path = map_of(tmp_path, png(np.array([[0, 254, 205]], np.uint8)), mode=mode)
    assert load_map(path).cells.tolist() == [cells]


def test_a_yaw_that_is_no_number_is_named(tmp_path: Path) -> None:
    for nan in ("nan", ".nan"):
        with pytest.raises(MapFileError, match=r"m\.yaml: origin: input should be a finite number"):
            load_map(map_of(tmp_path, png(GREYS), origin=f"[0, 0, {nan}]"))
