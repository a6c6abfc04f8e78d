"""nav2 map files: `map.yaml` and its image, read and written with exactly the semantics of nav2_map_server.

Pixels are grey: 254 free, 0 occupied, 205 unknown (trinary); image row 0 is the largest y; `origin` is the
lower-left corner of the lower-left pixel.
"""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator
from typing_extensions import Self

from pc2grid.arrays import F64, BoolGrid, hand_over
from pc2grid.errors import MapFileError
from pc2grid.io.atomic import replace_file
from pc2grid.io.error_translation import LFS_HINT, is_lfs_pointer
from pc2grid.io.map_image import MAX_CELLS, MapImage, encode_image, read_image
from pc2grid.io.messages.types import FARTHEST_M
from pc2grid.model import FREE, FREE_BELOW, OCCUPIED, OCCUPIED_FROM, UNKNOWN, MapOf, OccupancyGrid

MapMode = Literal["trinary", "scale", "raw"]

_MAX_YAML_BYTES = 65_536
# Metres per pixel outside of this range are a typing error: submaps are some metres wide.
_RESOLUTION_M = (1e-3, 100.0)
# Defaults of nav2_map_server for a written map. 0.196 and not 0.25: an unknown pixel, grey 205, has the
# occupancy 0.196078, which a free_thresh of 0.25 would read as free.
_OCCUPIED_THRESH, _FREE_THRESH = 0.65, 0.196
_FREE_GREY, _UNKNOWN_GREY, _OCCUPIED_GREY = 254, 205, 0
# Two roundings, of a cell's edge and of the product, are at most so many units in the last place.
_DIGITS, _ROUNDED = 12, 2
_LEAST_YAW_RAD = 1e-9
_ROUNDED_CELLS = 1e-6  # a corner of a rotated map so near to a corner of a cell is there
# Half a corridor is wider than this, half a wall is not. In eight real maps a tenth of the floor is .8 m and
# more from all else, and nine tenths of the walls, up to .4 m thick, are .4 m and less from it.
_WIDE_M, _MOST = 0.5, 0.9
_RAW = "the image has the values of a raw map, 0 to 100 and 255: mode: raw"
_log = logging.getLogger(__name__)


def is_map_file(path: Path) -> bool:
    """Whether an input is a nav2 map rather than a recording (a rosbag2 folder's metadata.yaml is one)."""
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

    warn : gets a sentence for the user on each of these differences, and on a map that cannot be meant so: no
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
    if abs(yaw_rad) <= _LEAST_YAW_RAD:
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
    """Whether the thresholds make unknown pixels free, in an image that has lighter ones for free space."""
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
    """The map in cells along the axes of its frame; `grid` is as if it were not rotated about its origin.

    A cell is what the map has at its centre, and occupied too where the centre of an occupied cell of the map
    falls: walls of one cell stay closed.
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
    """Yield sentences on a map that says something else than what was drawn."""
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
    resolution: float = Field(ge=_RESOLUTION_M[0], le=_RESOLUTION_M[1])
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
            text = file.read(_MAX_YAML_BYTES + 1)
    except OSError as error:
        raise MapFileError(f"{path}: {error.strerror}") from error
    if is_lfs_pointer(text):
        raise MapFileError(f"{path}: a Git LFS pointer to a map.yaml", hint=LFS_HINT)
    if len(text) > _MAX_YAML_BYTES:
        raise MapFileError(f"{path}: larger than {_MAX_YAML_BYTES} bytes: not a map.yaml")
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
    """A number with the fewest digits that tell it apart: -478 cells of 0.05 m are -23.9, and no
    -23.900000000000002, by what sums and products of floats are rounded."""
    short = float(f"{value:.{_DIGITS}g}")
    text = repr(short if abs(short - value) <= _ROUNDED * math.ulp(value) else float(value))
    # PyYAML reads "1e-05" as text, because the mantissa has no decimal point.
    return text.replace("e", ".0e", 1) if "e" in text and "." not in text else text
