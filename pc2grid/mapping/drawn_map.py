"""Maps that are no recordings: a nav2 map, a point cloud or a mesh of a building, as an occupancy grid."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pc2grid.arrays import F64, freeze
from pc2grid.config import Config, ReadConfig
from pc2grid.errors import MapFileError
from pc2grid.geometry import invert_pose, transform_points
from pc2grid.io.building_file import (
    axis_of_file,
    building_points,
    digest_of_building,
    is_building_file,
    kind_of,
    neighbour_distances_m,
)
from pc2grid.io.nav2_map import is_map_file, load_map
from pc2grid.mapping.cloud_doubts import is_upside_down, other_floors, side_that_is_up
from pc2grid.mapping.cloud_map import check_plausible, level_cloud, map_cloud, voxel_cloud
from pc2grid.model import OccupancyGrid

_SPARSE_M = 0.15
"""Spacing of points above which walls have gaps in a grid of 5 cm. Chosen by hand."""
_SPACING_NEIGHBOUR = 3
"""On a surface the third neighbour is as far away as a voxel filter is wide; the first may be much nearer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnMap:
    """A map that was read from a file.

    grid : in the map frame. kind : "nav2 map", "cloud" or "mesh".
    T_map_file : (4, 4), the frame of the file in the map frame, whose floor is level and at z = 0. Of a nav2
        map the two are the same.
    level_points_m : (V, 3) in the map frame, one a voxel of the size of a cell; empty for a nav2 map.
    digest : sha256 of what was read. warnings : sentences for the user.
    """

    grid: OccupancyGrid
    kind: str
    T_map_file: F64
    level_points_m: F64
    digest: str
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        freeze(self, "T_map_file", np.float64, (4, 4))
        freeze(self, "level_points_m", np.float64, (None, 3))


def is_drawn_map(path: Path) -> bool:
    """Whether an input is a map rather than a recording."""
    return is_map_file(path) or is_building_file(path)


def load_drawn_map(path: str | Path, config: Config = Config()) -> DrawnMap:
    """Read a map. `config.read` says how the numbers of a cloud are meant, `projection` how it is drawn.

    Raises MapFileError if it cannot be read, shows no floor or is not in metres; LimitExceeded if it is too
    large.

    >>> drawn = load_drawn_map("map.yaml")
    >>> drawn.kind, drawn.grid.resolution_m
    ('nav2 map', 0.05)
    """
    path = Path(path)
    if is_map_file(path):
        warnings: list[str] = []
        grid = load_map(path, warnings.append)
        return DrawnMap(
            grid=grid,
            kind="nav2 map",
            T_map_file=np.eye(4),
            level_points_m=np.empty((0, 3)),
            digest=_digest_of_nav2_map(path, grid),
            warnings=tuple(warnings),
        )
    kind = kind_of(path)
    try:
        points = voxel_cloud(building_points(path, config.read, check_plausible), config.projection)
        T_map_file = level_cloud(points, floor_z=config.read.floor_z, up=config.read.up)
        level = transform_points(T_map_file, points)
        # Viewpoints, unlike `drivable_plan(level)`, also know the ground that furniture hides from above, as
        # the map of a robot does.
        sparse = _sparse(points)
        try:
            grid = map_cloud(level, config.projection, origin_m=T_map_file[:3, 3])
        except MapFileError as error:
            raise MapFileError("; ".join((error.message, *sparse)), hint=error.hint) from error
    except MapFileError as error:
        if str(path) in error.message:
            raise
        raise MapFileError(f"{path}: {error.message}", hint=error.hint) from error
    return DrawnMap(
        grid=grid,
        kind=kind,
        T_map_file=T_map_file,
        level_points_m=level,
        digest=digest_of_building(path),
        warnings=tuple(
            f"{path.name}: {sentence}"
            for sentence in (*sparse, *_doubts(level, T_map_file, config.read, dense=not sparse))
        ),
    )


def digest_of_map(path: Path) -> str:
    """The sha256 of `DrawnMap.digest`, without drawing the map."""
    return (
        _digest_of_nav2_map(path, load_map(path, warn=lambda sentence: None))
        if is_map_file(path)
        else digest_of_building(path)
    )


def _digest_of_nav2_map(path: Path, grid: OccupancyGrid) -> str:
    """Of the text and the cells, not of the image file: other image formats can hold the same cells."""
    return hashlib.sha256(path.read_bytes() + grid.cells.tobytes()).hexdigest()


def _sparse(points: F64) -> tuple[str, ...]:
    """A sentence if the points (V, 3) are too far from each other to draw walls without gaps."""
    spacing_m = float(np.median(neighbour_distances_m(points, _SPACING_NEIGHBOUR)))
    if spacing_m <= _SPARSE_M:
        return ()
    return (
        f"its points are {spacing_m:.2f} m apart, so walls have gaps and a lidar may not be found in it; less"
        f" than {_SPARSE_M:g} m is needed: a voxel filter of 0.1 m or finer",
    )


def _doubts(level: F64, T_map_file: F64, read: ReadConfig, *, dense: bool) -> Iterator[str]:
    """What may be wrong with the map of a levelled cloud (V, 3), told; `dense` enough to show its doors."""
    if dense and is_upside_down(level):
        down = axis_of_file(np.array([0.0, 0.0, -1.0]), read.up)
        yield (
            "it looks upside down, as doors or furniture reach up to its highest plane, not down to its"
            f" lowest; if so, the map is mirrored: --set read.up={down} turns it"
        )
    if read.floor_z is not None:
        return
    side = side_that_is_up(level)
    if side is not None:
        side = T_map_file[:3, :3].T @ side
        axes = (axis_of_file(side, read.up), axis_of_file(-side, read.up))
        yield (
            "it looks as if it lay on its side, with a wall taken for the floor:"
            f" --set read.up={axes[0]} or {axes[1]} turns it"
        )
    others = other_floors(level)
    if others:
        middle_m = np.median(level[:, :2], axis=0)
        there = np.array([(*middle_m, other.height_m) for other in others], np.float64)
        z_m = transform_points(invert_pose(T_map_file), there)[:, 2]
        floors = " and ".join(
            f"another floor lies at z = {z:.1f} with {other.area_m2:.0f} m2"
            for z, other in zip(z_m, others, strict=True)
        )
        yield f"the lowest floor is mapped; {floors}: --set read.floor_z={z_m[0]:.1f} maps that one"
