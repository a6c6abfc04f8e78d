"""One submap: to its signatures, and a query aligned with it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import material
import numpy as np
from measure import Row, Time, median, timed

from pc2grid.alignment import Fit, LikelihoodField, assess, prepare, refine, search
from pc2grid.config import PartitionConfig
from pc2grid.geometry import SE2
from pc2grid.model import F32
from pc2grid.partition import submap_centers, view_at
from pc2grid.simulate import office_floorplan
from signature.config import Config
from signature.describe import describe
from signature.query import QueryMap
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
    """A query against one candidate: every rotation, 1.5 m to all sides, the best refined and scored."""
    config = Config()
    field = prepare(material.grid_of(material.drive(30.0 if quick else 100.0, seed=0)))
    candidates = submap_centers(office_floorplan(0), config.partition)[:: 20 if quick else 2]
    times: list[Time] = []
    for seed in (1, 2, 3):
        query = material.query_map(list(material.drive(8.0, seed=seed)), config)
        points = coarse_points(query, query.aligned.center_m)
        for x, y in candidates:
            times.append(timed(lambda x=x, y=y, q=query, p=points: _align(field, q, p, float(x), float(y))))
    wall, cpu = median(times).times(1e3)
    yield Row(
        what="align a query with one candidate, any rotation, +-1.5 m",
        measured=wall,
        cpu=cpu,
        unit="ms",
        goal=0.5,
        note=f"cpu: mean {1e3 * np.mean([t.cpu for t in times]):.2f} ms, 9 of 10 below"
        f" {1e3 * np.percentile([t.cpu for t in times], 90):.2f} ms; {len(times)} pairs",
    )


def _align(field: LikelihoodField, query: QueryMap, points: F32, x: float, y: float) -> Fit | None:
    steps, turns = 0.75 * np.arange(4) - 1.125, np.radians(15.0) * np.arange(24)
    starts = np.array([(x + dx, y + dy, yaw) for dx in steps for dy in steps for yaw in turns])
    found = search(field, points, starts, half_t_m=0.375, half_a_rad=np.radians(7.5), most=1)
    if not len(found):
        return None
    cx, cy = query.aligned.center_m
    T_map_query = SE2(*map(float, found[0, :3])) @ SE2(-cx, -cy, 0.0)
    return assess(field, query.aligned, *refine(field, query.aligned, T_map_query))
