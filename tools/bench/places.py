"""One submap: to its signatures, and a query aligned with it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import material
import numpy as np
from measure import Row, Time, median, timed

from pc2grid.alignment import Fit, LikelihoodField, assess, prepare, refine, search
from pc2grid.config import PartitionConfig
from pc2grid.geometry import F64, SE2
from pc2grid.model import F32
from pc2grid.partition import submap_centers, view_at
from pc2grid.simulate import office_floorplan
from pc2grid.visibility import HIDDEN, Isovist, isovist
from pc2grid.windows import search_windows
from signature.config import Config
from signature.describe import describe
from signature.query import QueryMap
from signature.retrieve import rotate_and_compare
from signature.verify import coarse_points


def describe_time(folder: Path, quick: bool) -> Iterator[Row]:
    """One submap of radius 8 m to its signatures: as a disc, and as what is seen from its centre."""
    grids = [office_floorplan(0)]
    path = material.data_file("maps/fr079.yaml")
    if path is not None:
        from pc2grid.io.nav2_map import load_map

        grids.append(load_map(path))
    disc, seen = PartitionConfig(radius_m=8.0), PartitionConfig(radius_m=8.0, view="isovist")
    work = [
        (grid, (float(x), float(y)))
        for grid in grids
        for x, y in submap_centers(grid, disc)[: 10 if quick else None]
    ]
    for grid, center in work[:3]:
        describe(view_at(grid, center, seen))  # compiled code warms up
    alone, seen_too = [], []
    for grid, center in work:
        whole = view_at(grid, center, disc)
        alone.append(timed(lambda submap=whole: describe(submap)))
        seen_too.append(timed(lambda g=grid, c=center: describe(view_at(g, c, seen))))
    on = f"{len(work)} submaps of {len(grids)} maps"
    for what, times, goal in (("a submap", alone, 2.0), ("what is seen", seen_too, 3.0)):
        wall, cpu = median(times).times(1e3)
        yield Row(what=f"describe {what}, 8 m", measured=wall, cpu=cpu, unit="ms", goal=goal, note=on)


def align_time(folder: Path, quick: bool) -> Iterator[Row]:
    """A query against one candidate: every rotation, 1.5 m to all sides, the best refined and scored.

    exact : branch and bound over all of it. fast : isovists say how it is turned, windows where it lies.
    """
    config = Config()
    grid = material.grid_of(material.drive(30.0 if quick else 100.0, seed=0))
    field, sight_m = prepare(grid), config.partition.radius_m
    centers = [(float(x), float(y)) for x, y in submap_centers(grid, config.partition)][:: 4 if quick else 1]
    places = [isovist(grid, at, sight_m, bearings=90) for at in centers]  # the database knows them beforehand
    times: dict[str, list[Time]] = {"fast": [], "exact": []}
    right = {"fast": 0, "exact": 0}
    near = 0
    for query in _within(field, config, 1 if quick else 3):
        truth = query.aligned.center_m
        profile = isovist(query.grid, truth, sight_m, bearings=90)
        points = coarse_points(query, truth)  # the same for all candidates
        # How each is turned against the query comes out of one comparison with all of them.
        turns: list[F64] = []
        compared = timed(lambda a=profile, t=turns: t.append(_turns(a, places)))
        share = Time(compared.wall / len(centers), compared.cpu / len(centers))
        found: dict[str, list[Fit | None]] = {"fast": [], "exact": []}
        # One candidate after the other, as a look-up does it: each way finds the memory as it left it.
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
    for name, what in (("fast", "heading from isovists"), ("exact", "branch and bound")):
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


def _within(field: LikelihoodField, config: Config, count: int) -> Iterator[QueryMap]:
    """Queries that the map has seen at least half of."""
    for seed in itertools.count(1):
        query = material.query_map(list(material.drive(8.0, seed=seed)), config)
        if assess(field, query.aligned, SE2(), np.eye(3)).overlap > 0.5:
            yield query
            count -= 1
        if not count:
            return


def _exact(field: LikelihoodField, query: QueryMap, points: F32, at: tuple[float, float]) -> Fit | None:
    steps, turns = 0.75 * np.arange(4) - 1.125, np.radians(15.0) * np.arange(24)
    starts = np.array([(at[0] + dx, at[1] + dy, yaw) for dx in steps for dy in steps for yaw in turns])
    found = search(field, points, starts, half_t_m=0.375, half_a_rad=np.radians(7.5), most=1)
    return _fit(field, query, found)


def _turns(profile: Isovist, places: Sequence[Isovist]) -> F64:
    """How the query is turned at each of the places, radians, as their isovists say."""
    overlap = rotate_and_compare(
        profile.ranges_m[None],
        (profile.ends != HIDDEN)[None],
        np.stack([place.ranges_m for place in places]),
        np.stack([place.ends != HIDDEN for place in places]),
    )[0]
    turns: F64 = np.argmax(overlap, axis=0) * 2 * np.pi / len(overlap)
    return turns


def _fast(
    field: LikelihoodField, query: QueryMap, points: F32, at: tuple[float, float], turn: float
) -> Fit | None:
    start = np.array([(*at, turn)])
    found = search_windows(field, points, start, half_t_m=1.5, half_a_rad=np.radians(5.0), most=1)
    return _fit(field, query, found)


def _fit(field: LikelihoodField, query: QueryMap, found: F64) -> Fit | None:
    if not len(found):
        return None
    cx, cy = query.aligned.center_m
    T_map_query = SE2(*map(float, found[0, :3])) @ SE2(-cx, -cy, 0.0)
    return assess(field, query.aligned, *refine(field, query.aligned, T_map_query))
