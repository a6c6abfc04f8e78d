"""Recordings -> registered scans -> occupancy grids -> submaps.

The front of pc2grid: everything that knows what a sensor is. `signature` (the back) only sees grids
and submaps. Importing this package costs nothing: its names load their modules when first used.

Types: `Scan`, `RegisteredScan`, `Trajectory`, `Loop`, `OccupancyGrid`, `Submap`, `SessionMap`; `SE2` for
planar poses. Everywhere metres, radians, int64 nanoseconds; `T_target_source` maps coordinates of source into
target. What is raised on purpose is a `Pc2GridError`, whose `hint` says what to do.

>>> import pc2grid, signature
>>> with pc2grid.open_log("monday.mcap") as log:
...     monday = pc2grid.build_map(log, signature.Config(), session="monday")
>>> monday.sensor, monday.grid.resolution_m, len(monday.submaps) > 10
('laser', 0.05, True)
"""

from typing import TYPE_CHECKING

from pc2grid.lazy import lazy_names

if TYPE_CHECKING:
    from pc2grid.errors import Pc2GridError as Pc2GridError
    from pc2grid.geometry import SE2 as SE2
    from pc2grid.io.log import Log as Log
    from pc2grid.io.log import open_log as open_log
    from pc2grid.io.nav2_map import load_map as load_map
    from pc2grid.io.nav2_map import save_map as save_map
    from pc2grid.io.trajectory import read_tum as read_tum
    from pc2grid.io.trajectory import write_kitti as write_kitti
    from pc2grid.io.trajectory import write_tum as write_tum
    from pc2grid.model import Health as Health
    from pc2grid.model import Loop as Loop
    from pc2grid.model import OccupancyGrid as OccupancyGrid
    from pc2grid.model import RegisteredScan as RegisteredScan
    from pc2grid.model import Scan as Scan
    from pc2grid.model import SessionMap as SessionMap
    from pc2grid.model import Submap as Submap
    from pc2grid.model import Trajectory as Trajectory
    from pc2grid.partition import partition as submaps_of  # noqa: F401
    from pc2grid.pipeline import build_map as build_map
    from pc2grid.pipeline import follow as follow
    from pc2grid.pipeline import map_scans as map_scans
    from pc2grid.simulate import SimulationConfig as SimulationConfig
    from pc2grid.simulate import simulate_session as simulate_session

__version__ = "0.1.0"

# A function whose module has its name goes by another one here: the module would hide it.
_HOMES = {
    "Health": "model.Health",
    "Log": "io.log.Log",
    "Loop": "model.Loop",
    "OccupancyGrid": "model.OccupancyGrid",
    "Pc2GridError": "errors.Pc2GridError",
    "RegisteredScan": "model.RegisteredScan",
    "SE2": "geometry.SE2",
    "Scan": "model.Scan",
    "SessionMap": "model.SessionMap",
    "SimulationConfig": "simulate.SimulationConfig",
    "Submap": "model.Submap",
    "Trajectory": "model.Trajectory",
    "build_map": "pipeline.build_map",
    "follow": "pipeline.follow",
    "load_map": "io.nav2_map.load_map",
    "map_scans": "pipeline.map_scans",
    "open_log": "io.log.open_log",
    "read_tum": "io.trajectory.read_tum",
    "save_map": "io.nav2_map.save_map",
    "simulate_session": "simulate.simulate_session",
    "submaps_of": "partition.partition",
    "write_kitti": "io.trajectory.write_kitti",
    "write_tum": "io.trajectory.write_tum",
}
__all__ = ["__version__", *_HOMES]
__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
