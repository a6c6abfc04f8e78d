"""Images of nav2 maps as nav2 reads them, against its rules by hand; and maps that cannot be meant."""

from __future__ import annotations

import io
import math
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from pc2grid.errors import MapFileError
from pc2grid.io.maps import load_map, save_map
from pc2grid.simulate import office_floorplan
from tests.helpers.field import DATA

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


def test_alpha_is_said_where_versions_of_nav2_differ(tmp_path: Path) -> None:
    said: list[str] = []
    opaque = np.full_like(GREYS, 255)
    load_map(map_of(tmp_path, png(np.dstack([GREYS] * 3 + [opaque]))), said.append)
    assert len(said) == 1 and "reads 1 of 6 cells otherwise: save the image without alpha" in said[0]
    black_and_white = np.where(GREYS > 0, 255, 0).astype(np.uint8)
    load_map(map_of(tmp_path, png(np.dstack([black_and_white] * 3 + [opaque]))), said.append)
    assert len(said) == 1


# --- maps that cannot be meant ------------------------------------------------------------------------


def rooms() -> np.ndarray:
    """(140, 200) the greys of a floor of 9 x 6 m, rooms along a corridor, walls of .1 m, unknown outside."""
    greys = np.full((140, 200), 205, np.uint8)
    greys[10:130, 10:190] = 0
    for top, low in ((12, 55), (57, 83), (85, 128)):
        for left in (12, 72, 132) if top != 57 else (12,):
            greys[top:low, left : left + (56 if top != 57 else 176)] = 254
    for door in (30, 90, 150):
        greys[54:58, door : door + 18] = greys[82:86, door : door + 18] = 254
    return greys


def solid() -> np.ndarray:
    """The same in black and white, all solid around the floor."""
    return np.where(rooms() == 254, 255, 0).astype(np.uint8)


def lines() -> np.ndarray:
    """The same as black lines on white."""
    return np.where(rooms() == 0, 0, 255).astype(np.uint8)


def percents() -> np.ndarray:
    """The same with the values of a raw map."""
    return np.select([rooms() == 254, rooms() == 0], [np.uint8(0), np.uint8(100)], np.uint8(255))


def doubts(path: Path) -> list[str]:
    said: list[str] = []
    load_map(path, said.append)
    return said


EXCHANGED = "walls and floor look exchanged: "


@pytest.mark.parametrize(
    ("image", "keys", "words"),
    [
        (lambda: 255 - rooms(), {}, EXCHANGED + "negate: 1 takes dark for free"),
        (lambda: 255 - solid(), {}, EXCHANGED + "negate: 1"),
        (lambda: 255 - lines(), {"mode": "scale"}, EXCHANGED + "negate: 1"),
        (lambda: 255 - np.dstack([rooms()] * 3), {}, EXCHANGED + "negate: 1"),
        (lambda: (255 - rooms()).astype(np.uint16) * 257, {}, EXCHANGED + "negate: 1"),
        (rooms, {"negate": 1}, EXCHANGED + "negate: 0 takes light for free"),
        (solid, {"negate": "true"}, EXCHANGED + "negate: 0"),
        (percents, {}, EXCHANGED + "the image has the values of a raw map, 0 to 100 and 255: mode: raw"),
        (lambda: percents()[10:130, 10:190], {}, EXCHANGED + "the image has the values of a raw map"),
        (lambda: np.where(percents() == 100, 82, percents()), {}, EXCHANGED + "the image has the values of"),
        (rooms, {"mode": "raw"}, "no cell is occupied, .*: mode: raw takes values of 0 to 100 for percent"),
        (lambda: percents().astype(np.uint16), {"mode": "raw"}, "no cell is occupied"),
        (lambda: np.maximum(rooms(), 100), {}, "no cell is occupied.* by 0.61, occupied_thresh is 0.65: lo"),
        (lambda: 255 - np.maximum(rooms(), 100), {"negate": 1}, "lightest pixel is occupied by 0.61"),
        (lambda: np.full_like(rooms(), 254), {}, "no cell is occupied"),
        (lambda: np.dstack([rooms()] * 3 + [np.zeros_like(rooms())]), {"mode": "scale"}, "transparent"),
        (
            lambda: np.dstack([solid()] * 3 + [np.full_like(solid(), 255)]),
            {"occupied_thresh": 0.9},
            "no cell is occupied.* by 0.75, occupied_thresh is 0.9: save the image without alpha, or lower",
        ),
    ],
)  # fmt: skip
def test_maps_that_cannot_be_meant_are_said(
    tmp_path: Path, image: Callable[[], np.ndarray], keys: dict[str, Any], words: str
) -> None:
    said = doubts(map_of(tmp_path, png(image()), **keys))
    assert re.search(rf"m\.yaml: .*{words}", said[-1])
    assert sum("no cell is occupied" in sentence or EXCHANGED in sentence for sentence in said) == 1


def scattered() -> np.ndarray:
    """Solid blocks, as of a town, in a free field."""
    greys = np.full((300, 300), 254, np.uint8)
    for at in (30, 120, 210):
        greys[at : at + 60, 40:90] = greys[at : at + 40, 150:260] = 0
    return greys


@pytest.mark.parametrize(
    ("image", "keys"),
    [
        (rooms, {}),
        (lambda: 255 - rooms(), {"negate": 1}),
        (solid, {}),
        (lambda: 255 - solid(), {"negate": "true"}),
        (lines, {}),
        (rooms, {"mode": "scale"}),
        (percents, {"mode": "raw"}),
        (scattered, {}),
        (rooms, {"resolution": 0.2}),
        (rooms, {"resolution": 0.01}),
        (lambda: np.kron(rooms(), np.ones((6, 6), np.uint8)), {"resolution": 0.05 / 6}),
    ],
)
def test_maps_that_can_be_meant_are_not_doubted(
    tmp_path: Path, image: Callable[[], np.ndarray], keys: dict[str, Any]
) -> None:
    assert not doubts(map_of(tmp_path, png(image()), **keys))


def test_plans_of_the_simulator_are_not_doubted(tmp_path: Path) -> None:
    for seed in range(6):
        path, _ = save_map(office_floorplan(seed=seed), tmp_path / "plan")
        assert not doubts(path)


REAL = sorted((*DATA.glob("maps/*.yaml"), *DATA.glob("laser/*/*.yaml")))


@pytest.mark.skipif(not REAL, reason="PC2GRID_DATA has no maps")
def test_real_maps_are_doubted_only_where_they_are_negated(tmp_path: Path) -> None:
    for path in REAL:
        assert not doubts(path), path
        keys = yaml.safe_load(path.read_text())
        image = cv2.imread(str(path.parent / keys.pop("image")), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        said = doubts(map_of(tmp_path, png(255 - image), **keys))
        assert [EXCHANGED in sentence for sentence in said] == [True], path
