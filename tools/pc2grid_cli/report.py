"""A database, and an answer found in it, as one page that needs no network: `report.html` filled with data.

Everything shown is in the page as one JSON document; the template draws it. Metres and radians, in the map
frame of each session.
"""

from __future__ import annotations

import base64
import itertools
import json
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.io.atomic import replace_file
from pc2grid.model import OCCUPIED_FROM

if TYPE_CHECKING:
    import networkx as nx

    from pc2grid.arrays import F64
    from pc2grid.model import Consistency, Loop, OccupancyGrid, Trajectory
    from pc2grid_cli.locate import Found
    from signature.database import SubmapDatabase
    from signature.similarity import SignatureTable

_LARGEST_PIXELS = 3000
_STEP_M = 0.05
"""Poses nearer than this to the last one drawn are left out: they would not be visible."""


def write_report(
    path: Path,
    database: SubmapDatabase,
    *,
    found: Found | None = None,
    accept: float = 0.9,
    truth_m: F64 | None = None,
) -> None:
    """Write the page. Raises OutputError if it cannot be written.

    found : an answer to show over the map. accept : the confidence it needed to be `located`.
    truth_m : (N, 2) the query's true path in the map frame, if known.
    """
    page = files("pc2grid_cli").joinpath("report.html").read_text(encoding="utf-8")
    document = contents(database, found=found, accept=accept, truth_m=truth_m)
    # "<" is the only character that could end the script element.
    data = json.dumps(document, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    with replace_file(path) as temporary:
        temporary.write_text(page.replace("/*DATA*/null", data, 1), encoding="utf-8")


def contents(
    database: SubmapDatabase,
    *,
    found: Found | None = None,
    accept: float = 0.9,
    truth_m: F64 | None = None,
) -> dict[str, Any]:
    """The data of the page as plain types."""
    config, table = database.config(), database.signatures()
    return {
        "title": Path(database.location).name,
        "radius_m": config.partition.radius_m,
        "boundary_bin_m": config.signature.boundary_bin_m,
        "freespace_bin_m": config.signature.freespace_bin_m,
        "sessions": [
            {
                **_facts(info),
                "image": _picture(database.grid(info.name)),
                "submaps": _submaps(table, index),
                "graph": _graph(database.graph(info.name)),
                "path": runs(database.trajectory(info.name)),
                "contradicted": _contradicted(database.trajectory(info.name), info.consistency),
                "loops": _loops(database.trajectory(info.name), database.loops(info.name)),
            }
            for index, info in enumerate(database.sessions())
        ],
        "answer": None if found is None else _answer(found, accept, truth_m),
    }


def _facts(info: Any) -> dict[str, Any]:
    return {
        "name": info.name,
        "source": info.provenance.source,
        "sensor": info.sensor,
        "count": info.submaps,
        "area_m2": round(info.area_m2, 1),
        "path_m": round(info.path_m, 1),
        "duration_s": round(info.duration_s, 1),
        "scans": info.scans,
        "lossy": info.lossy,
        "agreement": None if info.consistency is None else round(1.0 - info.consistency.contradicted, 4),
        "bent": info.consistency is not None and info.consistency.bent,
        "warnings": list(info.warnings),
    }


def _submaps(table: SignatureTable, session_index: int) -> list[dict[str, Any]]:
    return [
        {
            "id": int(table.submap_id[row]),
            "xy": _short(table.center_m[row], 2),
            "boundary": _short(table.boundary[row], 4),
            "freespace": _short(table.freespace[row], 4),
            "symmetry": _short(table.symmetry[row], 2),
        }
        for row in np.flatnonzero(table.session_index == session_index)
    ]


def _graph(graph: nx.Graph) -> dict[str, Any]:
    """Nodes of the junction graph (x, y, whether a junction), and the pairs of them that are joined."""
    return {
        "nodes": [
            [*_short(node["center_m"], 2), int(node["kind"] == "junction")] for _, node in graph.nodes.items()
        ],
        "edges": [[int(a), int(b)] for a, b in graph.edges],
    }


def runs(poses: Trajectory) -> list[dict[str, Any]]:
    """Pieces of a path of equal health, as x, y, x, y, ...; each starts where the last one ends."""
    xy = poses.planar()[:, :2]
    health = [h.value for h in poses.health] or ["fine"] * len(xy)
    pieces: list[dict[str, Any]] = []
    last: F64 | None = None
    for k, (kind, members) in enumerate(itertools.groupby(range(len(xy)), key=lambda i: health[i])):
        indices = list(members)
        points = [] if k == 0 or last is None else [last]
        for i in indices:
            if last is None or i == indices[-1] or np.hypot(*(xy[i] - last)) >= _STEP_M:
                points.append(xy[i])
                last = xy[i]
        pieces.append({"health": kind, "xy": _short(np.ravel(points), 2)})
    return pieces


def _loops(poses: Trajectory, loops: tuple[Loop, ...]) -> list[list[float]]:
    """The two poses of each loop: x, y, x, y, whether it was accepted."""
    xy = poses.planar()[:, :2]
    return [[*_short(xy[loop.older], 2), *_short(xy[loop.newer], 2), int(loop.accepted)] for loop in loops]


def _contradicted(poses: Trajectory, consistency: Consistency | None) -> list[list[float]]:
    """The parts of a path along which the scans do not agree with the map, as x, y, x, y, ..."""
    xy, parts = poses.planar()[:, :2], []
    for stretch in () if consistency is None else consistency.stretches:
        first, last = np.searchsorted(poses.stamps_ns, (stretch.from_ns, stretch.to_ns))
        part = xy[first : last + 1]
        step_m = np.hypot(*np.diff(part, axis=0).T)
        drawn = np.concatenate(([True], np.diff(np.floor(np.cumsum(step_m) / _STEP_M), prepend=0.0) > 0))
        drawn[-1] = True
        parts.append(_short(np.ravel(part[drawn]), 2))
    return parts


def _answer(found: Found, accept: float, truth_m: F64 | None) -> dict[str, Any]:
    answer = found.answer
    document = answer.to_json()
    pose = document["pose"]
    return {
        "status": answer.status,
        "session": answer.session,
        "pose": pose and {key: pose[key] for key in ("x", "y", "yaw")},
        "deviation": None if answer.covariance is None else _short(np.sqrt(np.diag(answer.covariance)), 4),
        "confidence": round(answer.confidence, 4),
        "accept": accept,
        "query": {**found.about, "is_map": found.drawn is not None},
        "hypotheses": [
            {**shown, "T": [h.fit.T_map_query.x, h.fit.T_map_query.y, h.fit.T_map_query.yaw]}
            for shown, h in zip(document["hypotheses"], answer.hypotheses, strict=True)
        ],
        "history": document["history"],
        "path": runs(found.poses),
        "truth": [] if truth_m is None else _short(np.ravel(truth_m), 2),
        "image": None if found.drawn is None else _picture(found.drawn, tint=(0, 94, 213)),
    }


def _picture(grid: OccupancyGrid, tint: tuple[int, int, int] | None = None) -> dict[str, Any]:
    """The known part of a grid as a PNG: free white, walls dark, in between grey, unknown transparent.

    tint : (blue, green, red) to show walls only, for a map laid over another. Large grids are reduced so
    that walls stay.
    """
    import cv2

    known = np.argwhere(grid.cells >= 0)
    (r0, c0), (r1, c1) = (known.min(axis=0), known.max(axis=0) + 1) if len(known) else ((0, 0), (1, 1))
    cells = grid.cells[r0:r1, c0:c1] if len(known) else np.full((1, 1), -1, np.int8)
    n = -(-max(cells.shape) // _LARGEST_PIXELS)
    for axis in (0, 1):
        cells = np.maximum.reduceat(cells, np.arange(0, cells.shape[axis], n), axis=axis)
    pixels = np.zeros((*cells.shape, 4), np.uint8)
    if tint is None:
        pixels[..., :3] = np.clip(255 - 2.2 * np.maximum(cells, 0.0), 30, 255)[..., None]
        pixels[..., 3] = np.where(cells < 0, 0, 255)
    else:
        pixels[..., :3] = tint
        pixels[..., 3] = np.where(cells >= OCCUPIED_FROM, 255, 0)
    # Row 0 of a grid is its lowest, row 0 of a picture its highest.
    data = cv2.imencode(".png", np.ascontiguousarray(pixels[::-1]))[1].tobytes()
    size = grid.resolution_m * n
    return {
        "png": "data:image/png;base64," + base64.b64encode(data).decode(),
        "x": round(float(grid.origin_m[0] + c0 * grid.resolution_m), 4),
        "y": round(float(grid.origin_m[1] + r0 * grid.resolution_m), 4),
        "w": round(cells.shape[1] * size, 4),
        "h": round(cells.shape[0] * size, 4),
    }


def _short(values: Any, digits: int) -> list[float]:
    """Plain numbers, rounded to digits that can be seen."""
    return [round(float(v), digits) for v in np.asarray(values, np.float64)]
