"""An office before and after it is rearranged, and how many of the changes are found.

Of forty things, ten are taken away and ten others come; the doors are left as each session found them. Both
sessions are driven, registered and joined as a user's, so the errors of all of that are in the figures.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from pc2grid.arrays import F64, BoolGrid
from pc2grid.geometry import SE2
from pc2grid.mapping.changes import ChangeKind, MapChanges, map_changes
from pc2grid.model import OccupancyGrid, Scan
from pc2grid.pipeline import map_scans
from pc2grid.simulate import Session, office_floorplan
from pc2grid.simulate.clutter import Furniture, place_clutter
from pc2grid.simulate.passage import outline_mask
from pc2grid.simulate.session import plan_session
from pc2grid.submaps.junction_graph import junction_graph
from pc2grid_lab.worlds import WorldConfig
from pc2grid_lab.worlds.change import change_building
from signature.config import Config
from signature.localization.joining.join import JoinableMap, join_maps

_THINGS, _KEPT = 40, 30  # in the building, and of these in each session
_DOORS = 0.6  # share of the doorways with a leaf, half of which is shut
_LENGTH_M, _RATE_HZ = 80.0, 4.0  # of a drive, and of its laser
_NEAR_M = 0.12
"""So far from the truth a cell may lie: two cells of the grid, by the diagonal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MappedSession:
    """A session with its map, and T_plan_map, where that lies in the true plan."""

    session: Session
    grid: OccupancyGrid
    T_plan_map: SE2

    def solid(self, things: tuple[Furniture, ...]) -> BoolGrid:
        """The cells (H, W) of the plan that are below these things, at the height of the laser."""
        plan, height_m = self.session.grid, float(self.session.sensor.T_base_sensor[2, 3])
        found: BoolGrid = np.zeros(plan.cells.shape, bool)
        for thing in things:
            for part in thing.parts:
                if part.bottom_m <= height_m <= part.top_m:
                    outline = (thing.pose.apply(part.outline_m) - plan.origin_m) / plan.resolution_m
                    found |= outline_mask(outline, (plan.cells.shape[0], plan.cells.shape[1]))
        return found

    def known(self, points_m: F64) -> BoolGrid:
        """Whether the map knows points (N, 2) of the plan."""
        at = self.grid.to_cell(self.T_plan_map.inverse().apply(points_m))
        known: BoolGrid = np.asarray(((at >= 0) & (at < self.grid.cells.shape)).all(axis=1))
        known[known] = self.grid.cells[tuple(at[known].T)] >= 0
        return known


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeCount:
    """What was found in one building. reported, right : patches. seen, found : things that truly came or went
    and that both sessions saw. joined : whether the two sessions were joined; if not, all is 0."""

    joined: bool = False
    reported: int = 0
    right: int = 0
    seen: int = 0
    found: int = 0

    def __add__(self, other: ChangeCount) -> ChangeCount:
        return ChangeCount(
            joined=self.joined or other.joined,
            reported=self.reported + other.reported,
            right=self.right + other.right,
            seen=self.seen + other.seen,
            found=self.found + other.found,
        )


def count_changes(building_seed: int, config: Config) -> ChangeCount:
    """Map an office before and after, join the two maps, and hold what changed against the truth."""
    before, after = (_mapped(session, config) for session in _sessions(building_seed))
    sight_m = config.partition.radius_m
    maps = [
        JoinableMap.of(m.grid, junction_graph(m.grid, config.partition), sight_m) for m in (before, after)
    ]
    join = join_maps(*maps)
    if join.status != "joined":
        return ChangeCount()
    changes = map_changes(before.grid, after.grid, join.T_target_source, join.covariance)
    came, went = _judged("came", before, after, changes), _judged("went", before, after, changes)
    return came + went


def _sessions(building_seed: int) -> Iterator[Session]:
    plan = office_floorplan(building_seed)
    robot_m = WorldConfig().drive.clearance_m
    things = place_clutter(plan, _THINGS, np.random.default_rng([building_seed, 77]), robot_m=robot_m)
    for number, present in enumerate((things[:_KEPT], things[-_KEPT:])):
        config = WorldConfig.model_validate(
            {
                "length_m": _LENGTH_M,
                "seed": 100 * building_seed + number,
                "clutter": 0,
                "change": {"doors": _DOORS},
                "laser": {"rate_hz": _RATE_HZ},
            }
        )
        streams = (np.random.default_rng([config.seed, 6]), np.random.default_rng([building_seed, 1]))
        _, _, doors = change_building(plan, None, config.change, *streams, robot_m=robot_m)
        yield plan_session("laser", plan, None, config, (*doors.added, *present))


def _mapped(session: Session, config: Config) -> MappedSession:
    true_m: list[tuple[float, float]] = []

    def scans() -> Iterator[Scan]:
        for scan, truth in session.scans():
            true_m.append((truth.x, truth.y))
            yield scan

    grid, trajectory, _ = map_scans(scans(), config)
    T_plan_map = SE2.fit(trajectory.planar()[:, :2], np.array(true_m))
    return MappedSession(session=session, grid=grid, T_plan_map=T_plan_map)


def _judged(
    kind: ChangeKind, before: MappedSession, after: MappedSession, changes: MapChanges
) -> ChangeCount:
    """A patch is right if most of its cells are near what came (or went); a thing is found if a patch is near
    it. It was seen by both if their maps know half of the cells around its outline."""
    here, there = (after, before) if kind == "came" else (before, after)
    plan = before.session.grid
    elsewhere = plan.occupied | there.solid(there.session.objects)
    new = here.solid(here.session.objects) & ~elsewhere
    patches_m = [before.T_plan_map.apply(patch.points_m) for patch in changes.of(kind)]
    right = sum(bool(np.mean(_near(new, plan, points_m)) >= 0.5) for points_m in patches_m)
    all_m = np.concatenate([np.empty((0, 2)), *patches_m])
    seen = found = 0
    for thing in here.session.objects:
        cells = here.solid((thing,))
        if not cells.any() or (cells & ~elsewhere).sum() < 0.5 * cells.sum():
            continue
        around_m = plan.to_point(np.argwhere(_outline(cells)))
        if (here.known(around_m) & there.known(around_m)).mean() >= 0.5:
            seen += 1
            found += bool(_near(cells & ~elsewhere, plan, all_m).any())
    return ChangeCount(joined=True, reported=len(patches_m), right=right, seen=seen, found=found)


def _near(mask: BoolGrid, plan: OccupancyGrid, points_m: F64) -> BoolGrid:
    """Whether points (N, 2) of the plan lie near the cells of a mask."""
    n = round(_NEAR_M / plan.resolution_m)
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((2 * n + 1, 2 * n + 1), np.uint8)).astype(bool)
    at = plan.to_cell(points_m).clip(min=0, max=np.array(mask.shape) - 1)
    return np.asarray(wide[at[:, 0], at[:, 1]])


def _outline(mask: BoolGrid) -> BoolGrid:
    """The edge of what is below a thing, one cell to either side."""
    solid, square = mask.astype(np.uint8), np.ones((3, 3), np.uint8)
    return np.asarray((cv2.dilate(solid, square) - cv2.erode(solid, square)).astype(bool))
