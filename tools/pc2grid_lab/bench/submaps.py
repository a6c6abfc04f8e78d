"""Times for one submap: its description, and the alignment of a query with it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.config import PartitionConfig
from pc2grid.geometry import SE2
from pc2grid.io.nav2_map import load_map
from pc2grid.matching.refinement import refine
from pc2grid.matching.two_way_score import Fit, score_fit
from pc2grid.matching.window_search import SearchMap, SearchParameters, search_windows
from pc2grid.simulate import office_floorplan
from pc2grid.submaps.isovist import HIDDEN, Isovist, isovist
from pc2grid.submaps.partition import submap_centers, view_at
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import Row, Time, median, timed
from signature.config import Config
from signature.describe import describe
from signature.localization.hypotheses import coarse_points
from signature.localization.query import QueryMap
from signature.retrieval.likeness import rotate_and_compare

_ONE = SearchParameters(most=1)


def describe_time(folder: Path, quick: bool) -> Iterator[Row]:
    """The signatures of one submap of radius 8 m: of the whole disc, and of what is seen from its centre."""
    grids = [office_floorplan(0)]
    path = fixtures.data_file("maps/fr079.yaml")
    if path is not None:
        grids.append(load_map(path))
    disc = PartitionConfig.paper()
    seen = disc.model_copy(update={"view": "isovist"})
    work = [
        (grid, (float(x), float(y)))
        for grid in grids
        for x, y in submap_centers(grid, disc)[: 10 if quick else None]
    ]
    for grid, center in work[:3]:
        describe(view_at(grid, center, seen))  # compiles
    discs, views = [], []
    for grid, center in work:
        whole = view_at(grid, center, disc)
        discs.append(timed(lambda submap=whole: describe(submap)))
        views.append(timed(lambda g=grid, c=center: describe(view_at(g, c, seen))))
    on = f"{len(work)} submaps of {len(grids)} maps"
    for what, times, goal in (("a disc", discs, 10.0), ("a view", views, 6.0)):
        wall, cpu = median(times).times(1e3)
        yield Row(what=f"describe {what}, 8 m", measured=wall, cpu=cpu, unit="ms", goal=goal, note=on)


def align_time(folder: Path, quick: bool) -> Iterator[Row]:
    """A query aligned with one candidate: every rotation, 1.5 m to all sides, refined and scored.

    exact : windows side by side that cover all of it. fast : the heading is estimated from isovists, and one
    window around it is searched.
    """
    config = Config()
    mapped = list(fixtures.drive(30.0 if quick else 100.0, seed=0))
    grid = fixtures.grid_of(mapped)
    field, sight_m = SearchMap.of(grid), config.partition.radius_m
    centers = [(float(x), float(y)) for x, y in submap_centers(grid, config.partition)][:: 4 if quick else 1]
    places = [isovist(grid, at, sight_m, bearings=90) for at in centers]  # stored in the database
    times: dict[str, list[Time]] = {"fast": [], "exact": []}
    right = {"fast": 0, "exact": 0}
    near = 0
    for query in _queries(field, mapped, config, 1 if quick else 3):
        truth = query.center_m
        profile = isovist(query.grid, truth, sight_m, bearings=90)
        points = coarse_points(query.walls.points_m, truth)  # the same for all candidates
        # One comparison with all candidates gives the rotation of each.
        turns: list[F64] = []
        compared = timed(lambda a=profile, t=turns: t.append(_turns(a, places)))
        share = Time(compared.wall / len(centers), compared.cpu / len(centers))
        found: dict[str, list[Fit | None]] = {"fast": [], "exact": []}
        # All candidates by one way, then all by the other, as in a look-up: this keeps the caches comparable.
        for at, turn in zip(centers, turns[0], strict=True):
            one = timed(
                lambda q=query, p=points, at=at, f=found, t=turn: f["fast"].append(_fast(field, q, p, at, t))
            )
            times["fast"].append(Time(one.wall + share.wall, one.cpu + share.cpu))
        for at in centers:
            times["exact"].append(
                timed(lambda q=query, p=points, at=at, f=found: f["exact"].append(_exact(field, q, p, at)))
            )
        close = [k for k, at in enumerate(centers) if math.dist(at, truth) < 1.0]
        near += len(close)
        for name, fits in found.items():
            for fit in (fits[k] for k in close):
                T = SE2() if fit is None else fit.T_map_query  # the query's frame is the map's
                right[name] += fit is not None and math.hypot(*T.apply(np.array([truth]))[0] - truth) < 0.25
    for name, what in (("fast", "heading from isovists"), ("exact", "every heading")):
        wall, cpu = median(times[name]).times(1e3)
        yield Row(
            what=f"align with one candidate, any rotation, +-1.5 m: {what}",
            measured=wall,
            cpu=cpu,
            unit="ms",
            goal=0.5,
            note=f"cpu: 9 of 10 below {1e3 * np.percentile([t.cpu for t in times[name]], 90):.2f} ms;"
            f" {len(times[name])} pairs; right {right[name]} of the {near} within 1 m",
        )


def _queries(
    field: SearchMap, mapped: Sequence[fixtures.PosedScan], config: Config, count: int
) -> Iterator[QueryMap]:
    """Queries that start on the path of the map, and of which the map covers at least half."""
    for seed in itertools.count(1):
        start = mapped[seed * len(mapped) // (count + 2) % len(mapped)].T_map_base
        drive = fixtures.drive(8.0, seed=seed, start_m=(start.x, start.y))
        query = fixtures.query_map(list(drive), config)
        if score_fit(field.walls, query.walls, SE2(), np.eye(3)).overlap > 0.5:
            yield query
            count -= 1
        if not count:
            return


def _exact(field: SearchMap, query: QueryMap, points: F32, at: tuple[float, float]) -> Fit | None:
    steps = 0.75 * np.arange(4) - 1.125
    starts = np.array([(at[0] + dx, at[1] + dy, 0.0) for dx in steps for dy in steps])
    found = search_windows(field, points, starts, half_t_m=0.375, half_a_rad=math.pi, parameters=_ONE)
    return _fit(field, query, found)


def _turns(profile: Isovist, places: Sequence[Isovist]) -> F64:
    """Heading of the query at each of the places, radians, estimated from their isovists."""
    overlap = rotate_and_compare(
        profile.ranges_m[None],
        (profile.ends != HIDDEN)[None],
        np.stack([place.ranges_m for place in places]),
        np.stack([place.ends != HIDDEN for place in places]),
    )[0]
    turns: F64 = np.argmax(overlap, axis=0) * 2 * np.pi / len(overlap)
    return turns


def _fast(field: SearchMap, query: QueryMap, points: F32, at: tuple[float, float], turn: float) -> Fit | None:
    start = np.array([(*at, turn)])
    found = search_windows(field, points, start, half_t_m=1.5, half_a_rad=math.radians(5.0), parameters=_ONE)
    return _fit(field, query, found)


def _fit(field: SearchMap, query: QueryMap, found: F64) -> Fit | None:
    if not len(found):
        return None
    cx, cy = query.center_m
    T_map_query = SE2(*map(float, found[0, :3])) @ SE2(-cx, -cy, 0.0)
    refined = refine(field.field, query.walls.points_m, T_map_query, query.center_m)
    return score_fit(field.walls, query.walls, *refined)
