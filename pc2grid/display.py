"""Displays of results: in a notebook a map as a picture and facts as a table; frozen types as JSON.

Jupyter calls `_repr_png_` and `_repr_html_` of the last value of a cell (https://ipython.readthedocs.io,
"Rich display"); the types of pc2grid use these functions there.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pydantic import TypeAdapter

    from pc2grid.geometry import F64

UNKNOWN_GREY, FREE_GREY, WALL_GREY = 222, 255, 38
PATH_BLUE, CENTRE_GREEN = (178, 114, 0), (115, 158, 0)
"""Blue, green, red of #0072B2 and #009E73: Okabe and Ito, which colour-blind people can tell apart."""
LONGEST_PX, SHORTEST_PX = 900, 300
"""The longer side of a picture: it fits into the column of a notebook, and a small map can be seen."""


def map_png(
    cells: NDArray[np.int8],
    resolution_m: float,
    origin_m: tuple[float, float],
    *,
    path_m: F64 | None = None,
    centers_m: F64 | None = None,
) -> bytes:
    """Draw a map as PNG, cropped to the known cells, north (+y) up.

    cells, resolution_m, origin_m : as in `OccupancyGrid`.
    path_m : (N, 2) path of the robot. centers_m : (M, 2) centres of submaps; both in the map frame, metres.
    """
    import cv2

    known = np.argwhere(cells >= 0)
    (r0, c0), (r1, c1) = (known.min(axis=0), known.max(axis=0) + 1) if len(known) else ((0, 0), cells.shape)
    cells = cells[r0:r1, c0:c1][::-1]
    # The darker, the more probably occupied.
    shade = FREE_GREY - (FREE_GREY - WALL_GREY) / 100.0 * cells
    grey = np.where(cells < 0, UNKNOWN_GREY, shade).astype(np.uint8)
    height, width = grey.shape
    scale = LONGEST_PX / max(height, width, 1)
    if scale > 1.0:  # whole pixels for each cell, and no more than are needed
        scale = float(max(1, min(int(scale), -(-SHORTEST_PX // max(height, width)))))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    image = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST)
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)

    def pixels(points_m: F64) -> NDArray[np.int32]:
        columns, rows = ((points_m - origin_m) / resolution_m - (c0, r0)).T
        return np.asarray(np.rint(np.column_stack((columns, height - rows)) * scale).astype(np.int32))

    if centers_m is not None:
        for x, y in pixels(centers_m):
            cv2.circle(image, (int(x), int(y)), 2, CENTRE_GREEN, -1, cv2.LINE_AA)
    if path_m is not None and len(path_m) > 1:
        cv2.polylines(image, [pixels(path_m)], False, PATH_BLUE, 1, cv2.LINE_AA)
    return bytes(cv2.imencode(".png", image)[1])


def html_picture(png: bytes, description: str) -> str:
    """Return an image element that needs no file beside the page."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img style="max-width:100%" alt="{escape(description)}" src="data:image/png;base64,{data}">'


def html_table(title: str, rows: Iterable[Sequence[object]], head: Sequence[str] = ()) -> str:
    """Return a table with a title; `head` names its columns. Everything is escaped."""
    parts = [f"<table><caption>{escape(title)}</caption>"]
    if head:
        parts.append("<tr>" + "".join(f"<th>{escape(word)}</th>" for word in head) + "</tr>")
    for row in rows:
        cells = "".join(f'<td style="text-align:left">{escape(str(value))}</td>' for value in row)
        parts.append(f"<tr>{cells}</tr>")
    return "".join((*parts, "</table>"))


def short(name: object, longest: int = 60) -> str:
    """Return a name in quotes for a `repr`, without the middle of a long one."""
    text = repr(str(name))
    half = longest // 2 - 1
    return text if len(text) <= longest else f"{text[:half]}...{text[-half:]}"


_LEAST, _MOST = 0.01, 0.99
"""What lies outside is shown as `< 0.01` or `> 0.99`: how true confidence is was measured no finer than that
(`compare sensors`)."""


def probability(value: float) -> str:
    """Format a probability with two digits; never 0 or 1.

    >>> probability(0.5), probability(0.9999), probability(0.0)
    ('0.50', '> 0.99', '< 0.01')
    """
    if value > _MOST:
        return f"> {_MOST}"
    return f"< {_LEAST}" if value < _LEAST else f"{value:.2f}"


def counted(number: int, noun: str) -> str:
    """Format a number with its noun.

    >>> counted(1, "submap"), counted(0, "submap"), counted(12, "lidar scan")
    ('1 submap', '0 submaps', '12 lidar scans')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


SCHEMA_VERSION = 1
"""Of all documents. Within a version they only gain keys: a reader must ignore keys that it does not know."""


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """Return what makes the JSON of a type, and its schema."""
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def plain(document: Any) -> dict[str, Any]:
    """Return a document of plain types: frozen types in it become objects, with the digits they declare."""
    return {"schema_version": SCHEMA_VERSION, **_plain(document)}


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return adapter(type(value)).dump_python(value, mode="json", by_alias=True)
    if isinstance(value, Mapping):
        return {key: _plain(part) for key, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, (list, tuple)) else value
