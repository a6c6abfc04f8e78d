"""Maps and queries that sensors make in simulated plans, kept in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pc2grid.model import OccupancyGrid, SensorKind
from pc2grid_lab.experiments.registered_session import RegisteredSession, simulate_and_register
from pc2grid_lab.experiments.sensor_map import SensorMap, is_saved, save_map
from pc2grid_lab.experiments.sensor_matrix import SENSORS, map_building, query_start
from pc2grid_lab.worlds import WorldConfig
from signature.config import Config

MAP_SEED = 1000
"""Map sessions and query sessions never share a seed: other clutter, start, direction and noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanDrives:
    """Maps and drives that are made unless they exist.

    setting : what their files are named after: map_length (metres driven to make a map), clutter, rate (scans
        a second), change (share of doors and furniture that differ, 0 if left out), and what else the
        results depend on. until_m, length_m : a query is registered so far, of a simulated drive that long.
    """

    out: Path
    setting: tuple[tuple[str, float], ...]
    until_m: float
    length_m: float

    def file(self, kind: str, *names: object, suffix: str) -> Path:
        """A file of the folder `kind`, named after its building, sensor and so on, and the setting."""
        tag = (f"{key}{value:g}" for key, value in sorted(self.setting))
        return self.out / kind / ".".join([*map(str, names), *tag, suffix])

    def simulation(
        self, length_m: float, seed: int, start_m: tuple[float, float] | None = None
    ) -> WorldConfig:
        """Of one drive."""
        setting = dict(self.setting)
        change = setting.get("change", 0.0)
        return WorldConfig.model_validate(
            {
                "length_m": length_m,
                "seed": seed,
                "clutter": int(setting["clutter"]),
                "start_m": start_m,
                "change": {"doors": change, "furniture": change},
                **{sensor: {"rate_hz": setting["rate"]} for sensor in SENSORS},
            }
        )

    @property
    def mapping(self) -> WorldConfig:
        """Of the drive that makes a map."""
        return self.simulation(dict(self.setting)["map_length"], MAP_SEED)

    def make_map(self, name: str, plan: Callable[[], OccupancyGrid], sensor: SensorKind) -> None:
        """Make the map of a plan by one sensor."""
        path = self.file("maps", name, sensor, suffix="submaps")
        if not is_saved(path):
            session_map, T_plan_map = map_building(name, plan(), sensor, self.mapping, Config())
            save_map(path, session_map, T_plan_map, Path(f"{name}.plan"), Config())

    def read_map(self, name: str, sensor: SensorKind) -> SensorMap:
        """What `make_map` has made."""
        path = self.file("maps", name, sensor, suffix="submaps")
        return SensorMap.load(path, name=name, sensor=sensor, config=Config())

    def drive(
        self, name: str, plan: Callable[[], OccupancyGrid], sensor: SensorKind, seed: int
    ) -> RegisteredSession:
        """A registered query session, which starts on the path of the mapping one."""
        path = self.file("drives", name, sensor, seed, suffix="npz")
        if not path.exists():
            grid = plan()
            simulation = self.simulation(self.length_m, seed, query_start(grid, self.mapping, seed))
            made = simulate_and_register(grid, sensor, simulation, Config(), until_m=self.until_m)
            made.save(path)
        return RegisteredSession.load(path)
