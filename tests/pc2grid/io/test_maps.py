"""Maps against a second, independent reading of nav2's rules; trajectories there and back."""

import io
import logging
import math
import re
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from pc2grid.errors import MapFileError, TrajectoryFileError
from pc2grid.io.maps import is_map_file, load_map, save_map
from pc2grid.io.sensors.depth import MAGIC
from pc2grid.io.trajectory import read_tum, stamp_ns_from_text, stamp_text, write_tum
from pc2grid.model import THING, OccupancyGrid, Trajectory
from pc2grid.simulate import office_floorplan
from tests.helpers.field import DATA
from tests.helpers.memory import peak_memory
from tests.helpers.nav2_map import KEYS, by_nav2, map_of, nav2_map, png_chunk

GREYS = np.array([[254, 0, 205], [0, 254, 0]], np.uint8)
CELLS = [[100, 0, 100], [0, 100, -1]]


def grey_map(folder: Path, pixels: bytes, /, **keys: object) -> Path:
    """A map of 3 x 2 grey pixels."""
    return map_of(folder, b"P5\n# made\n3 2\n255\n" + pixels, "m.pgm", **keys)


def png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])


@pytest.mark.parametrize("mode", ["trinary", "Scale", "RAW"])
@pytest.mark.parametrize("negate", [0, 1])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_depths_colours_and_alpha_are_read_as_by_nav2(
    tmp_path: Path, kind: type, channels: int, negate: int, mode: str
) -> None:
    white, rng = np.iinfo(kind).max, np.random.default_rng(channels)
    pixels = rng.integers(0, white, (32, 32, channels), kind, endpoint=True)
    pixels[0] = (np.arange(32) * white // 31)[:, None]  # greys, opaque where they are white
    pixels[1] = rng.choice(np.array([0, white, white * 205 // 255], kind), (32, channels))
    keys = {"mode": mode, "negate": negate, "occupied_thresh": 0.6543, "free_thresh": 0.1234}
    cells = load_map(map_of(tmp_path, png(pixels), **keys), lambda sentence: None).cells
    keys["mode"] = mode.lower()
    assert cells[::-1].tolist() == [[by_nav2(pixel, white, keys) for pixel in row] for row in pixels.tolist()]


@pytest.mark.parametrize("image_format", ["pgm", "png"])
@pytest.mark.parametrize("mode", ["trinary", "raw"])
@settings(max_examples=40, deadline=None)
@given(
    cells=hnp.arrays(np.int8, st.tuples(st.integers(1, 6), st.integers(1, 6)), elements=st.integers(-1, 100)),
    resolution=st.floats(1e-3, 10),
    x=st.floats(-1e6, 1e6),
)
def test_maps_survive_saving(mode: Any, image_format: Any, cells: Any, resolution: float, x: float) -> None:
    if mode == "trinary":
        cells = np.select([cells < 0, cells < 20, cells >= 65], [-1, 0, 100], -1)
    grid = OccupancyGrid(cells=cells, resolution_m=resolution, origin_m=(x, -x))
    with tempfile.TemporaryDirectory() as folder:
        path, _ = save_map(grid, Path(folder) / "a b", mode=mode, image_format=image_format)
        found = load_map(path)
    np.testing.assert_array_equal(found.cells, grid.cells)
    # As exact as a product of floats: what is off a short number by its rounding is written as that number.
    read, wanted = (found.resolution_m, *found.origin_m), (resolution, x, -x)
    assert all(map(partial(math.isclose, rel_tol=5e-16), read, wanted))


def test_an_origin_is_written_as_a_person_would(tmp_path: Path) -> None:
    cells = np.zeros((2, 2), np.int8)
    for origin_m, text in (
        ((-478 * 0.05, 3 * 0.1), "[-23.9, 0.3, 0]"),
        ((1e-05, -0.0), "[1.0e-05, -0.0, 0]"),
        ((math.pi, 1 / 3), "[3.141592653589793, 0.3333333333333333, 0]"),
    ):
        path, _ = save_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=origin_m), tmp_path / "m")
        assert f"origin: {text}\n" in path.read_text()
        assert np.abs(np.subtract(load_map(path).origin_m, origin_m)).max() < 1e-14


def test_a_comment_changes_nothing_that_is_read(tmp_path: Path) -> None:
    grid = OccupancyGrid(cells=np.array([[0, 60, 100]]), resolution_m=0.05, origin_m=(1.5, 2.0))
    plain, _ = save_map(grid, tmp_path / "a")
    told, _ = save_map(grid, tmp_path / "b", comment="image: no.pgm\n--- 1.8 m: \u2028resolution: 7")
    assert told.read_text().startswith("# image: no.pgm\n# --- 1.8 m: \n# resolution: 7\nimage: b.pgm\n")
    assert np.array_equal(load_map(told).cells, load_map(plain).cells)
    assert load_map(told).resolution_m == 0.05


@pytest.mark.parametrize("key", ["image", *KEYS])
def test_missing_keys_are_named(tmp_path: Path, key: str) -> None:
    with pytest.raises(MapFileError, match=f"{key}: field required"):
        load_map(grey_map(tmp_path, bytes(6), **{key: None}))


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("resolution", ["1e-3", 100.0], [0.9e-3, 101, 0, ".nan", "[1]"]),
        ("origin", [[1e8, -1e8, 0], [0, 0, 3.14]], [[1.1e8, 0, 0], [0, 0], [0] * 4, "a"]),
        ("origin: input should be a finite number", [], [f"[0, 0, {no}]" for no in (".inf", ".nan", "nan")]),
        ("occupied_thresh", [0.196, 1.0], [0.19, 1.01]),
        ("free_thresh", [0.0, 0.65], [-0.01, 0.66]),
        ("negate", [0, 1, "0", "1", True, "false"], [2, -1, "", [0], 0.5, 10**30, "maybe"]),
        ("mode", ["scale"], ["odd"]),
    ],
)
def test_values_up_to_their_limits(tmp_path: Path, key: str, good: list[object], bad: list[object]) -> None:
    """key : of the YAML, and what is said of bad values behind it."""
    name = key.partition(":")[0]
    for value in good:
        load_map(grey_map(tmp_path, bytes(6), **{name: value}))
    for value in bad:
        with pytest.raises(MapFileError, match=r"m\.yaml: .*" + key):
            load_map(grey_map(tmp_path, bytes(6), **{name: value}))


def test_a_shade_at_a_threshold_is_neither(tmp_path: Path) -> None:
    keys = {"negate": 1, "occupied_thresh": 0.2, "free_thresh": 0.2}  # 0.2 is shade 51
    path = grey_map(tmp_path, bytes([50, 51, 52, 0, 255, 51]), **keys)
    assert load_map(path).cells.tolist() == [[0, 100, -1], [0, -1, 100]]


def test_grey_205_stays_unknown_whatever_the_threshold(tmp_path: Path) -> None:
    """Map savers write it for unknown, and some of them a free_thresh of 0.25 beside it."""
    said: list[str] = []
    pixels = bytes([205, 254, 0, 204, 206, 254])
    grid = load_map(grey_map(tmp_path, pixels, free_thresh=0.25), said.append)
    assert grid.cells.tolist() == [[0, 0, 0], [-1, 0, 100]]
    assert "free_thresh 0.25 would make grey 205 free" in said[0]
    assert load_map(grey_map(tmp_path, pixels), said.append).cells[1, 0] == -1
    darker = load_map(grey_map(tmp_path, bytes([205] * 5 + [0]), free_thresh=0.25), said.append)
    assert (darker.cells == 0).sum() == 5, "without a lighter grey, 205 is what is free"
    assert len(said) == 1


@pytest.mark.parametrize("yaw_rad", [math.pi, -math.pi / 2, 3.14, 0.7])
def test_a_rotated_map_is_turned_about_its_origin(tmp_path: Path, yaw_rad: float) -> None:
    """Every cell of the image lies where the yaml says, and walls stay closed."""
    cells = np.zeros((30, 50), np.int8)
    cells[:, 20] = cells[12, 20:] = 100
    saved, _ = save_map(OccupancyGrid(cells=cells, resolution_m=0.1, origin_m=(2.0, -1.0)), tmp_path / "m")
    saved.write_text(saved.read_text().replace("-1.0, 0]", f"-1.0, {yaw_rad}]"))
    said: list[str] = []
    grid = load_map(saved, said.append)
    assert f"rotated by {yaw_rad:g} rad" in said[0]
    rows, columns = np.indices(cells.shape)
    across, up = 0.1 * (columns + 0.5), 0.1 * (rows + 0.5)
    x = 2.0 + math.cos(yaw_rad) * across - math.sin(yaw_rad) * up
    y = -1.0 + math.sin(yaw_rad) * across + math.cos(yaw_rad) * up
    at = np.floor((np.stack((y, x), -1) - grid.origin_m[::-1]) / 0.1).astype(int)
    found = grid.cells[at[..., 0], at[..., 1]]
    assert (found[cells == 100] == 100).all()
    assert (found == cells).mean() > 0.95
    assert (grid.cells == 0).sum() == pytest.approx((cells == 0).sum(), rel=0.03)


def test_what_is_a_map_and_what_is_a_recording(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    names = {"a.yaml": True, "a.yml": True, "a.mcap": False, "metadata.yaml": False, "folder.yaml": False}
    assert {name: is_map_file(tmp_path / name) for name in names} == names


@pytest.mark.parametrize("image_format", ["pgm", "png"])
def test_things_are_obstacles_unless_walls_alone_are_wanted(tmp_path: Path, image_format: Any) -> None:
    """By the reader of another: black, white, and grey 205 for nav2's map server."""
    grid = OccupancyGrid(
        cells=np.array([[-1, 0, 19, 20], [50, THING, 65, 99]]), resolution_m=0.05, origin_m=(0.0, 0.0)
    )
    wanted = {"everything": [-1, 100, 100, 100], "walls": [-1, -1, 100, 100]}
    for of, upper in wanted.items():
        path, _ = save_map(grid, tmp_path / "m", image_format=image_format, of=of)  # type: ignore[arg-type]
        assert nav2_map(path)[0].tolist() == [[-1, 0, 0, -1], upper]
        assert load_map(path).cells.tolist() == [[-1, 0, 0, -1], upper]


@given(st.integers(-(2**63), 2**63 - 1))
def test_stamps_survive_exactly(stamp_ns: int) -> None:
    assert stamp_ns_from_text(stamp_text(stamp_ns)) == stamp_ns


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e4, 1e4), min_size=6, max_size=6))
def test_tum_survives(values: list[float]) -> None:
    from pc2grid.geometry import pose_from_rotation_vector

    pose = pose_from_rotation_vector(np.array(values[:3]) / 1e4, values[3:])
    before = Trajectory(stamps_ns=np.array([1, 10**18]), T_session_base=np.stack((np.eye(4), pose)))
    with tempfile.TemporaryDirectory() as folder:
        write_tum(Path(folder) / "t.tum", before)
        after = read_tum(Path(folder) / "t.tum")
    np.testing.assert_array_equal(after.stamps_ns, before.stamps_ns)
    np.testing.assert_allclose(after.T_session_base, before.T_session_base, atol=5e-9)


@pytest.mark.parametrize("line", ["1 2 3", "x 0 0 0 0 0 0 1", "1 0 0 nan 0 0 0 1", "1 0 0 0 0 0 0 0"])
def test_bad_lines_are_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"# made\n{line}\n")
    with pytest.raises(TrajectoryFileError, match="line 2"):
        read_tum(path)


# --- Images of nav2 maps as nav2 reads them, against its rules by hand; and maps that cannot be meant ---


def png_of(width: int, bits: int, kind: int, row: bytes, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG of one row, by its standard: no library writes some of them."""
    header = struct.pack(">IIBBBBB", width, 1, bits, kind, 0, 0, 0)
    parts = [(b"IHDR", header), *chunks, (b"IDAT", zlib.compress(b"\0" + row)), (b"IEND", b"")]
    return MAGIC + b"".join(png_chunk(*part) for part in parts)


def by_pillow(image: Image.Image, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


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
        ("grey.png", png(GREYS)),
        ("colour.png", png(np.dstack([GREYS] * 3))),
        ("24 bits.bmp", bytes(cv2.imencode(".bmp", np.dstack([GREYS] * 3))[1])),
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


# --- damage, and what would take much memory ---


RANDOM_CELLS = np.random.default_rng(1).choice(np.array([-1, 0, 100], np.int8), (9, 13))
GRID = OccupancyGrid(cells=RANDOM_CELLS, resolution_m=0.05, origin_m=(-1.0, 2.0))
MIB = 1 << 20


def test_a_flipped_bit_anywhere_in_a_png_changes_no_pixel(tmp_path: Path) -> None:
    """It is seen by the checksums, but for those of parts without pixels."""
    yaml_path, image_path = save_map(GRID, tmp_path / "m", image_format="png")
    whole = image_path.read_bytes()
    for at in range(len(whole)):
        image_path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        try:
            read = load_map(yaml_path)
        except MapFileError as error:
            assert "m.png: " in error.message
        else:
            np.testing.assert_array_equal(read.cells, RANDOM_CELLS)
            assert at >= len(whole) - 12
    for at in range(len(whole) - 12):
        image_path.write_bytes(whole[:at])
        with pytest.raises(MapFileError, match=r"m\.png: "):
            load_map(yaml_path)
    image_path.write_bytes(whole + b"more")
    np.testing.assert_array_equal(load_map(yaml_path).cells, RANDOM_CELLS)


def test_what_a_decoder_would_unpack_besides_the_pixels_is_left_out(tmp_path: Path) -> None:
    _, image_path = save_map(GRID, tmp_path / "m", image_format="png")
    whole = image_path.read_bytes()
    bomb = png_chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(64 * MIB), 1)) + png_chunk(b"tEXt", b"a\0b")
    image_path.write_bytes(whole[:33] + bomb + whole[33:])
    with peak_memory() as peak:
        np.testing.assert_array_equal(load_map(tmp_path / "m.yaml").cells, RANDOM_CELLS)
    assert peak.grown_bytes() < 32 * MIB


def test_a_large_map_takes_room_for_its_cells_only(tmp_path: Path) -> None:
    """9 million cells: were shades computed per pixel, each of the arrays would take 72 MB."""
    pixels = np.zeros((3000, 3000), np.uint8)
    path = map_of(tmp_path, png(pixels))
    load_map(path)
    with peak_memory() as peak:
        assert load_map(path).cells.all()
    assert peak.grown_bytes() < 60 * MIB


def yaml_bomb() -> str:
    """A list named l9 of 9^10 items in a kilobyte."""
    lines = ["l0: &l0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 10)]
    return "\n".join(lines) + "\n"


@pytest.mark.fault(46)
@pytest.mark.parametrize(
    "key", ["image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"]
)
@pytest.mark.parametrize("value", ["*l9", "0x" + "f" * 9000, "[*l9, 0, 0]", "{a: *l9}"])
def test_values_of_billions_of_items_are_not_written_out(tmp_path: Path, key: str, value: str) -> None:
    path = grey_map(tmp_path, bytes(6), **{key: value})
    path.write_text(yaml_bomb() + path.read_text())
    with peak_memory() as peak, pytest.raises(MapFileError, match=f"{key}: ") as caught:
        load_map(path)
    assert len(caught.value.message) < 400
    assert peak.grown_bytes() < 16 * MIB


@pytest.mark.parametrize("word", ["", "x", "1..2", "--1", "1e", "nan", "inf", "9" * 30, "1e999999999999"])
def test_words_that_are_no_times(word: str) -> None:
    with pytest.raises((ValueError, ArithmeticError)):
        stamp_ns_from_text(word)


@pytest.mark.parametrize(
    ("word", "stamp_ns"), [("1.283e+09", 1_283_000_000 * 10**9), ("-0.5", -(10**9) // 2), (".5", 5 * 10**8)]
)
def test_words_that_are_times(word: str, stamp_ns: int) -> None:
    assert stamp_ns_from_text(word) == stamp_ns


def test_paths_of_maps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    grid = OccupancyGrid(cells=np.zeros((2, 3), np.int8), resolution_m=0.05, origin_m=(0, 0))
    yaml_path, image_path = save_map(grid, tmp_path / "m")
    with pytest.raises(MapFileError, match=r"none\.yaml: No such file"):
        load_map(tmp_path / "none.yaml")
    plain = yaml_path.read_text()
    (tmp_path / "inner").mkdir()
    inner = tmp_path / "inner" / "m.yaml"
    inner.write_text(plain.replace("m.pgm", "../m.pgm"))
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(load_map(inner).cells, grid.cells)
    assert "leaves the folder of the map" in caplog.text
    inner.write_text(plain.replace("m.pgm", str(image_path)))
    np.testing.assert_array_equal(load_map(inner).cells, grid.cells)
    for name in ('"a\\0b"', "3", '""', "[a]"):
        inner.write_text(plain.replace("m.pgm", name))
        with pytest.raises(MapFileError, match=r"inner/m\.yaml: image: "):
            load_map(inner)
    with pytest.raises(MapFileError, match="mode: 'odd' is not one of"):
        save_map(grid, tmp_path / "n", mode="odd")  # type: ignore[arg-type]
    assert not (tmp_path / "n.yaml").exists() and not (tmp_path / "n.pgm").exists()
