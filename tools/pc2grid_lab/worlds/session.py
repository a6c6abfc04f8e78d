"""A session in a world: doors, furniture, glass and mirrors that the plan does not show, and walkers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import cast as typed

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid, Scan, SensorKind
from pc2grid.simulate import Building, Session, SimulatedSession, SimulationConfig, office_floorplan
from pc2grid.simulate.clutter import covered
from pc2grid.simulate.record import record_session, refuse_existing_recording
from pc2grid.simulate.scene import Scene
from pc2grid.simulate.session import Cast, plan_session
from pc2grid_lab.worlds.change import NO_CHANGE, Change, change_building
from pc2grid_lab.worlds.config import WorldConfig
from pc2grid_lab.worlds.panes import Panes
from pc2grid_lab.worlds.walkers import Walker, send_walkers

# Streams of random numbers beside those of `pc2grid.simulate.session`.
_WALKERS, _CHANGE, _PANES = 5, 6, 7
_BUILDING = 0xB011D  # stream of what belongs to the building, whatever the session


@dataclass(frozen=True, slots=True)
class WorldSession(Session):
    """walkers : people who walk. change : what differs from the building as drawn; `grid` shows it."""

    walkers: tuple[Walker, ...] = ()
    change: Change = NO_CHANGE

    def caster(self) -> Cast:
        """What casts the rays of this session: into glass, mirrors and people, too."""
        scene, kind = Scene(self.mesh()), self.change.kind
        glass_return = typed(WorldConfig, self.config).change.glass_return
        panes = None if kind is None else Panes(scene, self.grid, kind, glass_return)

        def cast(rays: F32, times_s: F64, poses: F64, first: int) -> F32:
            flat = rays.reshape(-1, 6)
            if panes is None:
                hits = scene.cast(flat)
            else:
                hits = panes.cast(flat, np.random.default_rng([self.config.seed, _PANES, first]))
            distances = hits.reshape(times_s.shape)
            for walker in self.walkers:
                distances = np.minimum(distances, walker.hits(rays, times_s, poses[:, 0, :2]))
            return distances

        return cast


def prepare_session(
    *,
    sensor: SensorKind,
    grid: OccupancyGrid | Building | None = None,
    config: SimulationConfig | None = None,
) -> WorldSession:
    """As `pc2grid.simulate.prepare_session`, in a world.

    config : a WorldConfig; any other has no change and no walkers.
    """
    config = WorldConfig.model_validate((config or WorldConfig()).model_dump())
    building = office_floorplan(config.building_seed) if grid is None else grid
    plan, shell = (building, None) if isinstance(building, OccupancyGrid) else (building.plan, building.shell)
    plan, shell, change = change_building(
        plan,
        shell,
        config.change,
        np.random.default_rng([config.seed, _CHANGE]),
        np.random.default_rng([config.building_seed, _BUILDING]),
        robot_m=config.drive.clearance_m,
        start_m=config.start_m,
    )
    session = plan_session(sensor, plan, shell, config, change.added)
    walkers = send_walkers(
        plan,
        covered(plan, session.objects),
        config.walkers,
        session.drive.duration_s,
        np.random.default_rng([config.seed, _WALKERS]),
    )
    known = {field.name: getattr(session, field.name) for field in fields(Session)}
    return WorldSession(**known, walkers=walkers, change=change)


def iter_session(
    *,
    sensor: SensorKind,
    grid: OccupancyGrid | Building | None = None,
    config: SimulationConfig | None = None,
) -> Iterator[tuple[Scan, SE2]]:
    """As `pc2grid.simulate.iter_session`, in a world."""
    yield from prepare_session(sensor=sensor, grid=grid, config=config).scans()


def simulate_session(
    out: str | Path,
    *,
    sensor: SensorKind,
    grid: OccupancyGrid | Building | None = None,
    config: SimulationConfig | None = None,
    progress: Callable[[float], None] | None = None,
    force: bool = False,
) -> tuple[SimulatedSession, Change]:
    """As `pc2grid.simulate_session`, in a world; returns what was written, and what differs from the plan."""
    refuse_existing_recording(out, force)
    session = prepare_session(sensor=sensor, grid=grid, config=config)
    return record_session(out, session, progress=progress, force=force), session.change
