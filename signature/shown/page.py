"""A database, and an answer found in it, as one page that needs no network: `report.html` filled with data.

Everything shown is in the page as one JSON document; the template draws it. Metres and radians, in the map
frame of each session. The page shows

- the sessions of the database: map, path, junction graph, submaps and their signatures;
- where the signatures of a submap come from: points, a graph and two axes, in cells of the submap's grid, x
  before y;
- the answer: the walls of the query at each hypothesis, coloured by what the map shows there;
- why the best place, and why not the next one: for each view of the query the histograms that can be drawn on
  those of the map, and the log-likelihood ratio that `signature.places.places` adds up.

Nothing here decides.
"""

from __future__ import annotations

import base64
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import datetime, timezone
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from pc2grid._version import __version__
from pc2grid.errors import OutputError
from pc2grid.geometry import F32, F64, I64, SE2
from pc2grid.io.atomic import replace_file, require_writable
from pc2grid.matching.score import Support
from pc2grid.model import Loop, OccupancyGrid, ReadReport, Submap, Trajectory
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.submaps import look_around
from signature.boundary import PAIR_BINS, RANGE_BINS, boundary_edges, boundary_points, boundary_seen
from signature.config import SignatureConfig
from signature.database import SessionInfo, SubmapDatabase, open_database
from signature.freespace import PATH_BINS, freespace_nodes, freespace_seen, visibility_graph
from signature.localization.answer import Answer
from signature.paper import SignatureTable, score_matrix
from signature.places.places import POSES
from signature.shown.picture import (
    FURNITURE,
    PALETTE,
    UNKNOWN,
    agreements,
    answer_figure,
    drawn_as,
    figure_png,
    write_figure,
)
from signature.symmetry import line_segments, mirror_agreement, symmetry_axes
from signature.visible import PROFILE_BEARINGS, seen_signatures
from signature.weights import seen_spread, seen_weights

if TYPE_CHECKING:
    import networkx as nx
    from matplotlib.figure import Figure


_LARGEST_PIXELS = 3000
_EPOCH = datetime.fromtimestamp(0, timezone.utc)
"""The year in which stamps begin that count from a start."""
_MOST_EXPLAINED = 2000
"""A page of more submaps does not show where signatures come from: it takes 10 ms and 3 kB for each."""


NO_POSES = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
"""Of a query that is a map."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Found(Answer):
    """The answer of `pc2grid.relocalize`, with the query and the database it is about: it can be drawn.

    about : the query as documents describe it, see `signature.sessions.about_query`. database : where was
    looked. accept : the confidence that `located` needed. poses : the query in its own frame, see
    `corrected_path`; empty for a map. drawn : the query if it is a map. read : what was read of a recording,
    and what was lost; None for a map.
    """

    about: dict[str, Any]
    database: str
    accept: float
    poses: Trajectory = NO_POSES
    drawn: OccupancyGrid | None = None
    read: ReadReport | None = None

    @staticmethod
    def of(answer: Answer, **asked: Any) -> Found:
        """Return the answer to a query. asked : the further fields."""
        return Found(**{field.name: getattr(answer, field.name) for field in fields(answer)}, **asked)

    def plot(self) -> Figure:
        """Return the map with the best hypothesis, and what supports and contradicts it, as a figure of
        matplotlib.

        A notebook shows it; `figure.savefig` and `save` write it.
        """
        figure = answer_figure(self, self.map or self.local_map, self.poses)
        figure._repr_png_ = partial(figure_png, figure)  # type: ignore[attr-defined]
        return figure

    def report(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the page of `pc2grid relocalize --report`, which needs no network.

        The database is read again: it must be there still, and be no map.

        Raises OutputError if the page cannot be written, and the errors of `pc2grid.open_database`.
        """
        require_writable(path, overwrite)
        with open_database(self.database) as database:
            write_report(Path(path), database, found=self)

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the answer: as the document of `to_json` to a .json, as the picture of `plot` to a .png.

        Raises OutputError for another suffix, and for a file that exists without `overwrite`.
        """
        path = Path(path)
        if path.suffix not in (".json", ".png"):
            raise OutputError(f"{path}: an answer is saved as .json or .png", hint="end its name so")
        require_writable(path, overwrite)
        if path.suffix == ".png":
            write_figure(self.plot(), path)
            return
        with replace_file(path) as temporary:
            temporary.write_text(json.dumps(self.to_json(), indent=1), encoding="utf-8")


def write_report(
    path: Path, database: SubmapDatabase, *, found: Found | None = None, truth_m: F64 | None = None
) -> None:
    """Write the page. Raises OutputError if it cannot be written.

    found : an answer to show over the map. truth_m : (N, 2) the query's true path in the map frame, if known.
    """
    html = page(database, found=found, truth_m=truth_m)
    with replace_file(path) as temporary:
        temporary.write_text(html, encoding="utf-8")


def page(database: SubmapDatabase, *, found: Found | None = None, truth_m: F64 | None = None) -> str:
    """Return the page as text; parameters as for `write_report`."""
    template = files("signature.shown").joinpath("report.html").read_text(encoding="utf-8")
    document = contents(database, found=found, truth_m=truth_m)
    # "<" is the only character that could end the script element.
    data = json.dumps(document, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return template.replace("/*DATA*/null", data, 1)


def contents(
    database: SubmapDatabase, *, found: Found | None = None, truth_m: F64 | None = None
) -> dict[str, Any]:
    """Return the data of the page as plain types."""
    config, table, infos = database.config(), database.signatures(), database.sessions()
    explained = {info.name for info in infos}
    if found is not None:  # only the maps that the answer is about
        explained = {found.sessions[h.session_index] for h in found.hypotheses}
    if sum(info.submaps for info in infos if info.name in explained) > _MOST_EXPLAINED:
        explained = set()
    return {
        "title": Path(database.location).name,
        "version": __version__,
        "radius_m": config.partition.radius_m,
        "boundary_bin_m": config.signature.boundary_bin_m,
        "freespace_bin_m": config.signature.freespace_bin_m,
        "sessions": [
            {
                **_facts(info, database.trajectory(info.name)),
                "image": _picture(database.grid(info.name)),
                "submaps": _submaps(database, table, index, info.name, explain=info.name in explained),
                "graph": _graph(database.graph(info.name)),
                "path": runs(database.trajectory(info.name), info.resolution_m),
                "contradicted": _contradicted(database.trajectory(info.name), info),
                "loose": _bands(database.trajectory(info.name), info),
                "loops": _loops(database.trajectory(info.name), database.loops(info.name)),
            }
            for index, info in enumerate(infos)
        ],
        "answer": None if found is None else _answer(found, database, truth_m),
    }


def _facts(info: SessionInfo, poses: Trajectory) -> dict[str, Any]:
    label = info.provenance.label
    return {
        "name": info.name,
        "place": str(label) if label.building or label.floor else None,
        "date": _date(poses),
        "source": info.provenance.source,
        "sensor": info.sensor,
        "count": info.submaps,
        "area_m2": round(info.area_m2, 1),
        "path_m": round(info.path_m, 1),
        "duration_s": round(info.duration_s, 1),
        "scans": info.scans,
        "lossy": info.report.lossy,
        "agreement": None if info.consistency is None else round(1.0 - info.consistency.contradicted, 4),
        "bent": info.consistency is not None and info.consistency.bent,
        "worst_m": None if info.precision is None else round(info.precision.worst_m, 2),
        "warnings": list(info.report.warnings),
    }


def _date(poses: Trajectory) -> str | None:
    """Return the day of the first scan, UTC; None if its stamp is no time of day but counts from a start."""
    begin = datetime.fromtimestamp(poses.stamps_ns[0] / 1e9 if len(poses) else 0.0, timezone.utc)
    return None if begin.year == _EPOCH.year else f"{begin:%Y-%m-%d}"


def _submaps(
    database: SubmapDatabase, table: SignatureTable, session_index: int, session: str, *, explain: bool
) -> list[dict[str, Any]]:
    """Return the submaps of a session with their signatures and the places that are most similar.

    explain : also where the signatures come from, see `submap_sources`.
    """
    config = database.config()
    rows = np.flatnonzero(table.session_index == session_index).tolist()
    drawn = {s.submap_id: sources(s, config.signature) for s in database.submaps(session)} if explain else {}
    alike = similar_places(table, rows, config.partition, config.signature) if explain else [[] for _ in rows]
    return [
        {
            "id": int(table.submap_id[row]),
            "xy": _short(table.center_m[row], 2),
            "boundary": _short(table.boundary[row], 4),
            "freespace": _short(table.freespace[row], 4),
            "symmetry": _short(table.symmetry[row], 2),
            "sources": drawn.get(int(table.submap_id[row])),
            "similar": [
                [int(table.session_index[k]), int(table.submap_id[k]), float(f"{score:.3g}")]
                for k, score in similar
            ],
        }
        for row, similar in zip(rows, alike, strict=True)
    ]


def _graph(graph: nx.Graph) -> dict[str, Any]:
    """Return the nodes of the junction graph (x, y, whether a junction), and the pairs that are joined."""
    return {
        "nodes": [
            [*_short(node["center_m"], 2), int(node["kind"] == "junction")] for _, node in graph.nodes.items()
        ],
        "edges": [[int(a), int(b)] for a, b in graph.edges],
    }


def runs(poses: Trajectory, step_m: float) -> list[dict[str, Any]]:
    """Return pieces of a path of equal health, as x, y, x, y, ...; each starts where the last one ends.

    step_m : poses nearer to the last one drawn are left out; nearer than a cell they would not be visible.
    """
    xy = poses.planar()[:, :2]
    health = [h.value for h in poses.health] or ["fine"] * len(xy)
    pieces: list[dict[str, Any]] = []
    last: F64 | None = None
    for k, (kind, members) in enumerate(itertools.groupby(range(len(xy)), key=lambda i: health[i])):
        indices = list(members)
        points = [] if k == 0 or last is None else [last]
        for i in indices:
            if last is None or i == indices[-1] or np.hypot(*(xy[i] - last)) >= step_m:
                points.append(xy[i])
                last = xy[i]
        pieces.append({"health": kind, "xy": _short(np.ravel(points), 2)})
    return pieces


def _loops(poses: Trajectory, loops: tuple[Loop, ...]) -> list[list[float]]:
    """Return the two poses of each loop: x, y, x, y, whether it was accepted."""
    xy = poses.planar()[:, :2]
    return [[*_short(xy[loop.older], 2), *_short(xy[loop.newer], 2), int(loop.accepted)] for loop in loops]


def _contradicted(poses: Trajectory, info: SessionInfo) -> list[list[float]]:
    """Return the parts of a path along which the scans do not agree with the map, as x, y, x, y, ..."""
    xy, parts = poses.planar()[:, :2], []
    for stretch in () if info.consistency is None else info.consistency.stretches:
        first, last = np.searchsorted(poses.stamps_ns, (stretch.from_ns, stretch.to_ns))
        part = xy[first : last + 1]
        cells = np.floor(np.cumsum(np.hypot(*np.diff(part, axis=0).T)) / info.resolution_m)
        drawn = np.concatenate(([True], np.diff(cells, prepend=0.0) > 0))
        drawn[-1] = True
        parts.append(_short(np.ravel(part[drawn]), 2))
    return parts


def _bands(poses: Trajectory, info: SessionInfo) -> list[list[float]]:
    """Return pieces of a path with the standard deviation of the positions there: metres, x, y, x, y, ...

    Pieces that are known better than to two cells of the map, as wide as a path is drawn, are left out.
    """
    precision = info.precision
    if precision is None or len(precision.stamps_ns) < 2:
        return []
    xy, bands = poses.planar()[:, :2], []
    at = np.searchsorted(poses.stamps_ns, precision.stamps_ns)
    for first, last, *sigmas_m in zip(at, at[1:], precision.sigma_m, precision.sigma_m[1:], strict=False):
        sigma_m = sum(sigmas_m) / 2.0
        if sigma_m >= 2.0 * info.resolution_m:
            kept = np.unique(np.linspace(first, last, 5).astype(np.int64))
            bands.append([round(sigma_m, 2), *_short(np.ravel(xy[kept]), 2)])
    return bands


def _answer(answer: Found, database: SubmapDatabase, truth_m: F64 | None) -> dict[str, Any]:
    document = answer.to_json()
    pose = document["pose"]
    sigmas = None
    if answer.covariance is not None and answer.session is not None:
        resolution_m = database.session(answer.session).resolution_m
        sigmas = deviation(answer.covariance, resolution_m, database.config().partition.radius_m)
    compared = agreements(answer, database)
    # The wall points are the same for all hypotheses; only what the map says about them differs.
    walls_m = compared[0].points_m if compared else np.empty((0, 2))
    return {
        "status": answer.status,
        "session": answer.session,
        "pose": pose and {key: pose[key] for key in ("x", "y", "yaw")},
        "deviation": None if sigmas is None else _short(sigmas, 4),
        "confidence": round(answer.confidence, 4),
        "accept": answer.accept,
        "space": document["in_space"],
        "query": {**answer.about, "is_map": answer.about["sensor"] == "map"},
        "walls": _short(np.ravel(walls_m), 2),
        "hypotheses": [
            {
                **shown,
                "T": [h.T_map_query.x, h.T_map_query.y, h.T_map_query.yaw],
                "support": "".join(map(str, points.support.tolist())),
                "shares": _short([points.share(kind) for kind in Support], 4),
                "missed": _short(np.ravel(points.missed_m), 2),
            }
            for shown, h, points in zip(document["hypotheses"], answer.hypotheses, compared, strict=True)
        ],
        "history": [
            {"path_m": m.path_m, "status": m.status, "confidence": m.confidence} for m in answer.history
        ],
        "why": why_here(answer, database),
        "path": runs(answer.poses, answer.local_map.resolution_m),
        "truth": [] if truth_m is None else _short(np.ravel(truth_m), 2),
    }


def deviation(covariance: F64, resolution_m: float, radius_m: float) -> tuple[float, float, float]:
    """Return standard deviations of x, y (metres) and yaw (radians), but not less than the map can show.

    covariance : (3, 3), of the refinement alone: with thousands of wall points it gets far smaller than the
        error of the map. resolution_m : of the map; a position is given no finer than half a cell.
    radius_m : of the submaps; a heading is given no finer than the angle that moves a wall so far away by
        half a cell.

    >>> [round(float(v), 4) for v in deviation(np.diag([1e-6, 0.04, 1e-8]), 0.05, 5.0)]
    [0.025, 0.2, 0.005]
    """
    half_cell_m = 0.5 * resolution_m
    x, y, yaw = np.sqrt(np.diag(covariance)).tolist()
    return max(x, half_cell_m), max(y, half_cell_m), max(yaw, math.atan(half_cell_m / radius_m))


def _picture(grid: OccupancyGrid) -> dict[str, Any]:
    """Return the known part of a grid as a PNG, unknown cells transparent. Large grids are reduced so that
    walls stay."""
    kinds = drawn_as(grid)
    known = np.argwhere(grid.cells >= 0)
    (r0, c0), (r1, c1) = (known.min(axis=0), known.max(axis=0) + 1) if len(known) else ((0, 0), (1, 1))
    kinds = kinds[r0:r1, c0:c1]
    n = -(-max(kinds.shape) // _LARGEST_PIXELS)
    for axis in (0, 1):
        kinds = np.maximum.reduceat(kinds, np.arange(0, kinds.shape[axis], n), axis=axis)
    opaque = np.where(kinds == UNKNOWN, 0, 255).astype(np.uint8)
    pixels = np.dstack((PALETTE[kinds][..., ::-1], opaque))  # OpenCV has blue first
    # Row 0 of a grid is its lowest, row 0 of a picture its highest.
    data = cv2.imencode(".png", np.ascontiguousarray(pixels[::-1]))[1].tobytes()
    size = grid.resolution_m * n
    return {
        "png": "data:image/png;base64," + base64.b64encode(data).decode(),
        "x": round(float(grid.origin_m[0] + c0 * grid.resolution_m), 4),
        "y": round(float(grid.origin_m[1] + r0 * grid.resolution_m), 4),
        "w": round(kinds.shape[1] * size, 4),
        "h": round(kinds.shape[0] * size, 4),
        "furniture": PALETTE[FURNITURE].tolist() if grid.things.any() else None,
    }


def _short(values: Any, digits: int) -> list[float]:
    """Return plain numbers, rounded to digits that can be seen."""
    return [round(float(v), digits) for v in np.asarray(values, np.float64)]


_SIMILAR = 5
"""So many most similar places are listed for each submap; chosen by hand."""


def sources(submap: Submap, config: SignatureConfig) -> dict[str, Any]:
    """Return what the three histograms and scores of a submap are computed from (paper III-B to III-D).

    corner, cell_m : the lower left corner of the submap's grid in the map frame, and the size of its cells.
    boundary : the boundary points. nodes, edges : the free-space graph, see `joined_pairs`.
    axes : directions of the symmetry axes alpha and beta, radians; empty if there is none.
    """
    grid = submap.grid
    edges = boundary_edges(submap, config)
    nodes = freespace_nodes(submap, config)
    axes = symmetry_axes(line_segments(edges, grid.resolution_m, config), config)
    return {
        "corner": [round(float(v), 4) for v in grid.origin_m],
        "cell_m": grid.resolution_m,
        "boundary": _columns_first(boundary_points(edges, grid.resolution_m, config)),
        "nodes": _columns_first(nodes),
        "edges": joined_pairs(visibility_graph(grid, nodes, config)),
        "axes": [] if axes is None else [round(angle, 4) for angle in axes],
    }


def joined_pairs(graph: nx.Graph) -> str:
    """Return the edges of a graph with nodes 0 .. N - 1 as bits, base64: whether i < j are joined.

    (0, 1) is the first.

    A graph of lines of sight has so many edges that a list of them would be the largest part of the page.
    """
    first, second = np.triu_indices(len(graph), 1)
    pairs = zip(first.tolist(), second.tolist(), strict=True)
    bits = np.fromiter((graph.has_edge(i, j) for i, j in pairs), np.bool_, len(first))
    return base64.b64encode(np.packbits(bits, bitorder="little").tobytes()).decode()


def similar_places(
    table: SignatureTable, rows: Sequence[int], partition: PartitionConfig, config: SignatureConfig
) -> list[list[tuple[int, float]]]:
    """Return for each of these rows of a table the most similar places elsewhere: (row, score of Eq. 6).

    The best come first. Submaps of the same session whose centre is nearer than the radius show the same
    walls and are left out.
    """
    found = []
    for row in rows:
        one = slice(row, row + 1)
        scores = score_matrix(table.boundary[one], table.freespace[one], table.symmetry[one], table, config)[
            0
        ]
        near = np.hypot(*(table.center_m - table.center_m[row]).T) < partition.radius_m
        scores[near & (table.session_index == table.session_index[row])] = np.inf
        best = np.argsort(scores, kind="stable")[:_SIMILAR]
        found.append([(int(k), float(scores[k])) for k in best if np.isfinite(scores[k])])
    return found


def _columns_first(cells: I64) -> list[int]:
    """Return cells (N, 2) as (row, column) in one list: x, y, x, y, ..."""
    return [int(v) for v in cells[:, ::-1].ravel()]


def why_here(answer: Answer, database: SubmapDatabase) -> dict[str, Any] | None:
    """Return the signatures of the query's views at the best place and at its best rival, elsewhere or in
    another map; None without a hypothesis or a view.

    views : where they lie in the query's frame. told_apart : the number of the view whose likelihoods differ
    most between the two, of those that stand on free floor at both. places : of each, the number of its
    hypothesis and for each view `log_ratio`, and [query, map] of each of the three signatures of
    `described`.
    """
    if not answer.places or not answer.views_m:
        return None
    rival = len(answer.places[0].fits) if len(answer.places) > 1 else None
    sight_m = database.config().partition.radius_m
    compared = []
    for number in (0,) if rival is None else (0, rival):
        hypothesis = answer.hypotheses[number]
        grid = database.grid(answer.sessions[hypothesis.session_index])
        views = compare_views(answer.local_map, answer.views_m, grid, hypothesis.T_map_query, sight_m)
        compared.append((number, views))
    ratios = np.array([[view.log_ratio for view in views] for _, views in compared], np.float64)
    apart = ratios[0] - ratios[-1] if len(ratios) > 1 else ratios[0]
    return {
        "sight_m": sight_m,
        "views": [[round(v, 2) for v in at_m] for at_m in answer.views_m],
        "told_apart": int(np.argmax(np.where(np.isnan(apart), -np.inf, apart))),
        "places": [
            {
                "hypothesis": number,
                "views": [
                    {
                        "log_ratio": None if view.log_ratio is None else round(view.log_ratio, 2),
                        **{n: [_short(side[n], 3) for side in (view.query, view.map)] for n in view.query},
                    }
                    for view in views
                ],
            }
            for number, views in compared
        ],
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedView:
    """One view of a query where a hypothesis puts it.

    query, map : the signatures of both there, see `described`. log_ratio : natural logarithm of the ratio of
    the likelihoods that both show one place, and that they show two, no less than `PoseParameters.least`;
    None where the map has no free floor, which counts as 0.
    """

    query: dict[str, F64]
    map: dict[str, F64]
    log_ratio: float | None


def compare_views(
    query: OccupancyGrid,
    views_m: Sequence[tuple[float, float]],
    grid: OccupancyGrid,
    T_map_query: SE2,
    sight_m: float,
) -> tuple[ComparedView, ...]:
    """Return the signatures of each view of a query beside those of the map at the same point, in its frame.

    query : what was seen, in the query's frame. grid : the map. sight_m : as the places of the map were
    described.
    """
    if not views_m:
        return ()
    points_m = np.array(views_m, np.float64)
    turned = round(T_map_query.yaw * PROFILE_BEARINGS / math.pi)
    there_m = T_map_query.apply(points_m)
    own, at_own = described(query, points_m, sight_m, turned)
    theirs, at_theirs = described(grid, there_m, sight_m, 0)
    weights = seen_weights()
    squared = ((weights.of_queries(at_own) - weights.of_places(at_theirs)) ** 2).sum(axis=1)
    ratios = seen_spread().log_ratio(squared, 2.0 - at_own[:, -1] - at_theirs[:, -1])
    counted = np.maximum(ratios, POSES.least).tolist()
    return tuple(
        ComparedView(query=mine, map=other, log_ratio=ratio if free else None)
        for mine, other, ratio, free in zip(
            own, theirs, counted, grid.look_up(grid.free, there_m, outside=False), strict=True
        )
    )


def described(
    grid: OccupancyGrid, points_m: F64, sight_m: float, turned: int
) -> tuple[list[dict[str, F64]], F32]:
    """Return what is seen from points (N, 2), as shares that a person can read, and the signatures (N, K).

    boundary : (Nb + 2,) of pairs of wall points by their distance, in equal bins up to twice the limit of
        sight; then of pairs of which one ray, and of which both, meet no wall within sight.
    freespace : (Nf,) of pairs of free places by the length of the shortest path, in equal bins up to twice
        the limit of sight.
    symmetry : (B,) agreement of the walls with their mirror image, 0..1, at axes pi k / B from the map's x,
        counted on by `turned`.
    """
    ranges_m, ends = look_around(grid, points_m, sight_m, bearings=PROFILE_BEARINGS)
    boundary = boundary_seen(ranges_m, ends, sight_m)[:, RANGE_BINS + 1 :][:, : PAIR_BINS + 2] ** 2
    freespace = freespace_seen(ranges_m, ends, sight_m)[:, :PATH_BINS] ** 2
    symmetry = np.roll(mirror_agreement(ranges_m, ends), turned, axis=1)
    drawn = [
        {"boundary": one, "freespace": two, "symmetry": three}
        for one, two, three in zip(boundary, freespace, symmetry, strict=True)
    ]
    return drawn, seen_signatures(ranges_m, ends, sight_m)
