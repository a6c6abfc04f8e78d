"""nav2 map files: `map.yaml` and its image, read and written with exactly the semantics of nav2_map_server.

Pixels are grey: 254 free, 0 occupied, 205 unknown (trinary); image row 0 is the largest y; `origin` is the
lower-left corner of the lower-left pixel.

The image is a PGM or its kin, PNG, BMP or JPEG, decoded by OpenCV once its size is known (`read_image`).
"""

from __future__ import annotations

import json
import logging
import math
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from pc2grid.errors import MapFileError
from pc2grid.geometry import F64, BoolGrid, hand_over
from pc2grid.io.atomic import replace_file
from pc2grid.io.messages.types import EDGES_M, FARTHEST_M, HEADER_BYTES
from pc2grid.io.sensors.depth import MAGIC as PNG_MAGIC, read_header
from pc2grid.io.source import LFS_HINT, is_lfs_pointer
from pc2grid.model import FREE, FREE_BELOW, OCCUPIED, OCCUPIED_FROM, UNKNOWN, MapOf, OccupancyGrid

MapMode = Literal["trinary", "scale", "raw"]

# Defaults of nav2_map_server for a written map. 0.196 and not 0.25: an unknown pixel, grey 205, has the
# occupancy 0.196078, which a free_thresh of 0.25 would read as free.
_OCCUPIED_THRESH, _FREE_THRESH = 0.65, 0.196
_FREE_GREY, _UNKNOWN_GREY, _OCCUPIED_GREY = 254, 205, 0
# Two roundings, of a cell's edge and of the product, are at most so many units in the last place.
_DIGITS, _ROUNDED = 12, 2
_ROUNDED_CELLS = 1e-6  # a corner of a rotated map so near to a corner of a cell is there
# Half a corridor is wider than this, half a wall is not. In eight real maps a tenth of the floor is .8 m and
# more from all else, and nine tenths of the walls, up to .4 m thick, are .4 m and less from it.
_WIDE_M, _MOST = 0.5, 0.9
_RAW = "the image has the values of a raw map, 0 to 100 and 255: mode: raw"
_log = logging.getLogger(__name__)


def is_map_file(path: Path) -> bool:
    """Return True if an input is a nav2 map, not a recording (a rosbag2 folder's metadata.yaml is one)."""
    return path.suffix in (".yaml", ".yml") and path.name != "metadata.yaml" and not path.is_dir()


def load_map(yaml_path: str | Path, warn: Callable[[str], object] = _log.warning) -> OccupancyGrid:
    """Read a `map.yaml` with its image, as nav2_map_server's map_io does, but for two differences.

    The shade of a pixel, 0 (black) to 1, is the mean of its colours; a colour of 16 bits is a share of 65535,
    and one of a PGM a share of its white. Trinary: above `occupied_thresh` 100, below `free_thresh` 0, else
    -1, and alpha is one of the colours; but grey 205, which map savers write for unknown, stays -1 beside
    lighter pixels. Scale: linear between the thresholds, not opaque -1. Raw: 255 shades if 0..100, else -1. A
    map whose origin is rotated is turned into the axes of its frame.

    This is `loadMapFromFile` of nav2 until Humble. Since Jazzy's 1.3.7 it weighs colours by their luminance,
    and alpha is a mask: what is not opaque is -1, in trinary maps, too.

    warn : gets a sentence for the user on each of these differences, and on a map with a likely mistake: no
        cell is occupied, or walls and floor are exchanged.

    Raises MapFileError naming the key or the image that is wrong.

    >>> grid = load_map("map.yaml")
    >>> grid.cells.shape, grid.resolution_m, grid.origin_m
    ((280, 400), 0.05, (0.0, 0.0))
    """
    yaml_path = Path(yaml_path)
    keys = _read_yaml(yaml_path)
    if ".." in Path(keys.image).parts:
        warn(f"{yaml_path}: image: {keys.image} leaves the folder of the map")
    image = read_image(yaml_path.parent / keys.image)  # an absolute name stays absolute, as in nav2
    cells = _cells(image, keys)
    if _frees_unknown(image, keys):
        warn(
            f"{yaml_path}: free_thresh {keys.free_thresh:g} would make grey {_UNKNOWN_GREY} free, which map "
            f"savers write for unknown: it stays unknown; free_thresh: {_FREE_THRESH} says so in the .yaml"
        )
        cells[image.colours[::-1] == _unknown_shade(image)] = UNKNOWN
    for sentence in _doubts(image, keys, cells):
        warn(f"{yaml_path}: {sentence}")
    x_m, y_m, yaw_rad = keys.origin
    grid = OccupancyGrid(cells=hand_over(cells), resolution_m=keys.resolution, origin_m=(x_m, y_m))
    if abs(yaw_rad) * max(cells.shape) <= _ROUNDED_CELLS:
        return grid
    warn(
        f"{yaml_path}: the origin is rotated by {yaw_rad:g} rad, which nav2's costmap ignores: the map is "
        "turned into the axes of its frame"
    )
    return _turned(yaml_path, grid, yaw_rad)


def _unknown_shade(image: MapImage) -> int:
    """Return the integer that stands for the grey 205 in `colours`."""
    return image.white * _UNKNOWN_GREY // 255


def _frees_unknown(image: MapImage, keys: _Keys) -> bool:
    """Return whether the thresholds make unknown pixels free, in an image that has lighter ones for free
    space."""
    if keys.mode != "trinary" or image.alpha is not None:
        return False
    unknown = _unknown_shade(image)
    if _cell_of(np.array([unknown / image.white]), keys)[0] != FREE:
        return False
    return bool((image.colours == unknown).any() and image.colours.max() > unknown)


def _cells(image: MapImage, keys: _Keys) -> NDArray[np.int8]:
    """Return (H, W) the cells of a map, row 0 with the smallest y."""
    shades, white = _shades(image, keys)
    table = _cell_of(np.arange(white + 1) / white, keys)
    cells = np.empty(shades.shape, np.int8)
    # Row by row: the index takes eight times the memory of a pixel.
    for target, row in zip(cells[::-1], shades, strict=True):
        target[:] = table[row]
    if keys.mode == "scale" and image.alpha is not None:
        cells[image.alpha[::-1] < image.opaque] = UNKNOWN
    return cells


def _shades(image: MapImage, keys: _Keys) -> tuple[NDArray[np.unsignedinteger], int]:
    """Return (H, W) the shades of the pixels as integers, and which of them is white; 0 is black."""
    if keys.mode == "trinary" and image.alpha is not None:
        return image.colours + image.alpha, image.white + image.opaque
    return image.colours, image.white


def _cell_of(shade: F64, keys: _Keys) -> NDArray[np.int8]:
    """Return the cells of shades, 0 (black) .. 1."""
    occupied_thresh, free_thresh = keys.occupied_thresh, keys.free_thresh
    occupancy = shade if keys.negate else 1.0 - shade
    cells = np.full(shade.shape, UNKNOWN, dtype=np.int8)
    if keys.mode == "raw":
        value = np.round(shade * 255.0)
        cells[value <= 100] = value[value <= 100].astype(np.int8)
        return cells
    if keys.mode == "scale":
        span = (occupied_thresh - free_thresh) or 1.0
        between = (occupancy >= free_thresh) & (occupancy <= occupied_thresh)
        cells[between] = np.rint((occupancy[between] - free_thresh) / span * 100.0).astype(np.int8)
    cells[occupancy > occupied_thresh] = OCCUPIED
    cells[occupancy < free_thresh] = FREE
    return cells


def _turned(path: Path, grid: OccupancyGrid, yaw_rad: float) -> OccupancyGrid:
    """Rotate a map into cells along the axes of its frame; `grid` is as if it were not rotated about its
    origin.

    A cell gets the value of the map at its centre, and is occupied, too, if the centre of an occupied cell of
    the map falls into it: walls of one cell stay closed.
    """
    height, width = grid.cells.shape
    R = np.array([[math.cos(yaw_rad), -math.sin(yaw_rad)], [math.sin(yaw_rad), math.cos(yaw_rad)]])
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)]) @ R.T
    low = np.floor(corners.min(axis=0) + _ROUNDED_CELLS)
    columns, rows = np.ceil(corners.max(axis=0) - _ROUNDED_CELLS - low).astype(int)
    if rows * columns > MAX_CELLS:
        raise MapFileError(
            f"{path}: rotated, the map has {columns} x {rows} cells; the limit is {MAX_CELLS}",
            hint="rotate the image, and set the yaw to 0",
        )
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    x = low[0] + np.arange(columns) + 0.5
    for row in range(rows):
        y = np.full(columns, low[1] + row + 0.5)
        column, line = np.floor(R.T @ np.stack((x, y))).astype(int)
        inside = (column >= 0) & (column < width) & (line >= 0) & (line < height)
        cells[row, inside] = grid.cells[line[inside], column[inside]]
    walls = np.argwhere(grid.occupied)[:, ::-1] + 0.5
    column, row = np.clip(np.floor(walls @ R.T - low).astype(int), 0, (columns - 1, rows - 1)).T
    cells[row, column] = OCCUPIED
    x_m, y_m = np.array(grid.origin_m) + low * grid.resolution_m
    return OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=(float(x_m), float(y_m)))


# --- maps that cannot be meant as they are read -------------------------------------------------------


def _doubts(image: MapImage, keys: _Keys, cells: NDArray[np.int8]) -> Iterator[str]:
    """Yield warnings about a map that is probably read in another way than it was drawn."""
    if keys.mode == "trinary" and image.alpha is not None:
        masked = _cells(image._replace(alpha=None), keys)
        masked[image.alpha[::-1] < image.opaque] = UNKNOWN
        if others := np.count_nonzero(masked != cells):
            yield (
                f"alpha counts as a colour, as in nav2 until Humble; since Jazzy it is a mask, which reads "
                f"{others} of {cells.size} cells otherwise: save the image without alpha"
            )
    if not (cells >= OCCUPIED_FROM).any():
        yield f"no cell is occupied, so nothing can be located in it: {_why_empty(image, keys)}"
    elif not _plausible(cells, keys.resolution):
        raw = _looks_raw(image)
        change = {"mode": "raw"} if raw else {"negate": not keys.negate}
        if _plausible(_cells(image, keys.model_copy(update=change)), keys.resolution):
            negated = f"negate: {1 - keys.negate} takes {'light' if keys.negate else 'dark'} for free"
            yield f"walls and floor look exchanged: {_RAW if raw else negated}"


def _why_empty(image: MapImage, keys: _Keys) -> str:
    """Return why no cell is occupied, and what to change."""
    if keys.mode == "raw":
        return "mode: raw takes values of 0 to 100 for percent, mode: trinary takes dark for occupied"
    if _looks_raw(image):
        return _RAW
    shades, white = _shades(image, keys)
    if keys.mode == "scale" and image.alpha is not None:
        shades = shades[image.alpha == image.opaque]
        if not shades.size:
            return "all of the image is transparent, which mode: scale takes for unknown"
    occupancy = int(shades.max()) / white if keys.negate else 1.0 - int(shades.min()) / white
    hint = "save the image without alpha, or lower it" if white > image.white else "lower it, or draw walls"
    return (
        f"its {'lightest' if keys.negate else 'darkest'} pixel is occupied by {occupancy:.2g}, "
        f"occupied_thresh is {keys.occupied_thresh:g}: {hint}"
    )


def _looks_raw(image: MapImage) -> bool:
    """Return whether the image has the values of a raw map: floor, walls, and 255 for unknown."""
    present = np.zeros(image.white + 1, bool)
    for row in image.colours:
        present[row] = True
    values = np.round(np.flatnonzero(present) * 255.0 / image.white)
    percents = values[values <= 100]
    return bool(
        ((values <= 100) | (values == 255)).all()
        and (percents < FREE_BELOW).any()
        and (percents >= OCCUPIED_FROM).any()
    )


def _plausible(cells: NDArray[np.int8], resolution_m: float) -> bool:
    """Return whether a floor is wide, and either the walls are thin or all around the floor is solid."""
    free, occupied = (cells >= 0) & (cells < FREE_BELOW), cells >= OCCUPIED_FROM
    if not occupied.any() or not _wide(free, resolution_m):
        return False
    if not _wide(occupied, resolution_m):
        return True
    edge = np.concatenate((free[0], free[-1], free[:, 0], free[:, -1]))
    if edge.mean() > 1.0 - _MOST:
        return False
    _, _, stats, _ = cv2.connectedComponentsWithStats(free.view(np.uint8))
    return bool(stats[1:, cv2.CC_STAT_AREA].max() >= _MOST * np.count_nonzero(free))


def _wide(cells: BoolGrid, resolution_m: float) -> bool:
    """Return whether many of the cells are far from all others, as those of a floor and not of a wall."""
    away = cv2.distanceTransform(cells.view(np.uint8), cv2.DIST_L1, 3, dstType=cv2.CV_8U)
    least = min(1 + math.ceil(_WIDE_M / resolution_m), 255)
    return bool(np.count_nonzero(away >= least) > (1.0 - _MOST) * np.count_nonzero(cells))


def save_map(
    grid: OccupancyGrid,
    stem: str | Path,
    *,
    mode: Literal["trinary", "raw"] = "trinary",
    image_format: Literal["pgm", "png"] = "pgm",
    of: MapOf = "everything",
    comment: str = "",
) -> tuple[Path, Path]:
    """Write `<stem>.yaml` and `<stem>.pgm` or `.png`; returns both paths. Existing files are replaced.

    of : what a trinary map shows, see `OccupancyGrid.told`; a raw one holds the cells as they are.
    comment : lines that begin the .yaml; programs that read it skip them.

    Numbers have full precision (nav2's saver rounds them to three decimals).

    >>> [path.name for path in save_map(load_map("map.yaml"), "copy")]
    ['copy.yaml', 'copy.pgm']
    """
    stem = Path(stem)
    if mode not in ("trinary", "raw"):
        raise MapFileError(f"mode: {mode!r} is not one of trinary, raw")
    cells = grid.cells if mode == "raw" else grid.told(of)
    pixels = cells[::-1].astype(np.uint8)  # row 0 of an image has the largest y; unknown is 255
    if mode == "trinary":
        told = [cells[::-1] == FREE, cells[::-1] == OCCUPIED]
        pixels = np.select(told, [_FREE_GREY, _OCCUPIED_GREY], _UNKNOWN_GREY).astype(np.uint8)
    image_path = stem.with_name(f"{stem.name}.{image_format}")
    yaml_path = stem.with_name(f"{stem.name}.yaml")
    plain = re.fullmatch(r"[A-Za-z_][\w.\-]*", image_path.name)
    text = "".join(f"# {line}\n" for line in comment.splitlines()) + (
        f"image: {image_path.name if plain else json.dumps(image_path.name)}\n"
        f"mode: {mode}\n"
        f"resolution: {_yaml_number(grid.resolution_m)}\n"
        f"origin: [{_yaml_number(grid.origin_m[0])}, {_yaml_number(grid.origin_m[1])}, 0]\n"
        "negate: 0\n"
        f"occupied_thresh: {_OCCUPIED_THRESH}\n"
        f"free_thresh: {_FREE_THRESH}\n"
    )
    # Both files are complete before the first is renamed: a full disk leaves the old pair, not a mixed one.
    with replace_file(yaml_path) as new_yaml, replace_file(image_path) as new_image:
        new_image.write_bytes(encode_image(pixels, image_format, grid.resolution_m))
        new_yaml.write_text(text, encoding="utf-8")
    return yaml_path, image_path


# --- yaml ---------------------------------------------------------------------------------------------

_Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]


def _lower(mode: object) -> object:
    return mode.lower() if isinstance(mode, str) else mode


class _Keys(BaseModel):
    """The keys of a map.yaml. Other programs write further ones into it."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    image: str = Field(pattern=r"^[^\x00]+$")
    resolution: float = Field(ge=EDGES_M[0], le=EDGES_M[1])
    origin: tuple[_Coordinate, _Coordinate, float]
    negate: bool
    occupied_thresh: float = Field(ge=0, le=1)
    free_thresh: float = Field(ge=0, le=1)
    mode: Annotated[MapMode, BeforeValidator(_lower)] = "trinary"

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.free_thresh > self.occupied_thresh:
            raise ValueError(f"free_thresh: {self.free_thresh} is above occupied_thresh")
        return self


def _read_yaml(path: Path) -> _Keys:
    try:
        with path.open("rb") as file:
            text = file.read(HEADER_BYTES + 1)
    except OSError as error:
        raise MapFileError(f"{path}: {error.strerror}") from error
    if is_lfs_pointer(text):
        raise MapFileError(f"{path}: a Git LFS pointer to a map.yaml", hint=LFS_HINT)
    if len(text) > HEADER_BYTES:
        raise MapFileError(f"{path}: larger than {HEADER_BYTES} bytes: not a map.yaml")
    try:
        return _Keys.model_validate(yaml.safe_load(text))
    except ValidationError as error:
        raise _wrong_key(path, error) from None
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:
        raise MapFileError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from error


def _wrong_key(path: Path, error: ValidationError) -> MapFileError:
    first = error.errors()[0]
    key = "".join(f"{part}: " for part in first["loc"][:1])
    complaint = first["msg"][:1].lower() + first["msg"][1:]
    # What was found is not shown: with aliases, a few lines of YAML hold billions of items.
    return MapFileError(f"{path}: {key}{complaint}", hint="see nav2's map.yaml format")


def _yaml_number(value: float) -> str:
    """Format a number with the fewest digits that identify it.

    -478 cells of 0.05 m are -23.9, and no -23.900000000000002, which sums and products of floats give.
    """
    short = float(f"{value:.{_DIGITS}g}")
    text = repr(short if abs(short - value) <= _ROUNDED * math.ulp(value) else float(value))
    # PyYAML reads "1e-05" as text, because the mantissa has no decimal point.
    return text.replace("e", ".0e", 1) if "e" in text and "." not in text else text


MAX_CELLS = 100_000_000
_MAX_BYTES = 4 * MAX_CELLS + (1 << 20)
_DEEPEST = np.iinfo(np.uint16).max  # the largest white of a PGM
_NUMBER = rb"(?:\s|#[^\n]*\n)+(\d{1,9})"
_PNM = re.compile(rb"P([1-6])" + _NUMBER * 2 + rb"(?:" + _NUMBER + rb")?\s")  # bitmaps have no white
_PNG_KIND, _PNG_GREY, _PNG_FIRST = 25, 0, 33  # where the kind of pixels stands, and where the header ends
_JPEG_MAGIC, _JPEG_FRAMES = b"\xff\xd8\xff", {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
# A block of 8 x 8 pixels takes a bit at least.
_MOST_PIXELS_A_JPEG_BYTE = 512
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # our errors report the damage


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
    opaque = size.white or (_DEEPEST if deep else 255)
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
    """Encode pixels (H, W) as `pgm` or `png`; a pgm carries the resolution in a comment."""
    if suffix == "pgm":
        height, width = pixels.shape
        header = f"P5\n# CREATOR: pc2grid {resolution_m:.3f} m/pix\n{width} {height}\n255\n"
        return header.encode("ascii") + pixels.tobytes()
    done, encoded = cv2.imencode(".png", pixels)
    if not done:
        raise MapFileError(f"cannot encode a map image as {suffix}")
    return bytes(encoded.tobytes())
