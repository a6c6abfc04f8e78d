"""Recordings -> registered scans -> occupancy grids -> submaps.

The front of pc2grid: everything that depends on the kind of sensor. `signature`, the back, only gets grids
and submaps. Importing this package loads no library: each name loads its module when it is first used.

Types: `Scan`, `RegisteredScan`, `Trajectory`, `Loop`, `OccupancyGrid`, `Submap`, `SessionMap`; `SE2` for
planar poses. Everywhere metres, radians, int64 nanoseconds; `T_target_source` maps coordinates of source into
target. Errors that are raised on purpose are `Pc2GridError`s, whose `hint` says what to do.

>>> import pc2grid
>>> with pc2grid.open_log("monday.mcap") as log:
...     monday = pc2grid.build_map(log, session="monday")
>>> monday.sensor, monday.grid.resolution_m, len(monday.submaps) > 10
('laser', 0.05, True)
"""

from typing import TYPE_CHECKING

from pc2grid._version import __version__
from pc2grid.lazy import lazy_names

# The only list of the public names. A function with the name of its module has another name here, because the
# module would hide it.
if TYPE_CHECKING:
    from pc2grid.errors import Pc2GridError as Pc2GridError
    from pc2grid.geometry import SE2 as SE2
    from pc2grid.io.nav2_map import load_map as load_map
    from pc2grid.io.nav2_map import save_map as save_map
    from pc2grid.io.recording import Log as Log
    from pc2grid.io.recording import open_log as open_log
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
    from pc2grid.observer import Observer as Observer
    from pc2grid.pipeline import build_map as build_map
    from pc2grid.pipeline import follow as follow
    from pc2grid.pipeline import map_scans as map_scans
    from pc2grid.simulate import SimulationConfig as SimulationConfig
    from pc2grid.simulate import simulate_session as simulate_session
    from pc2grid.submaps.partition import partition as submaps_of  # noqa: F401
    from pc2grid.time_span import TimeSpan as TimeSpan

    # Of the package above this one, so that a user needs one import. `pyproject.toml` allows it here only.
    from signature.config import Config as Config
    from signature.database import Label as Label
    from signature.database import SubmapDatabase as SubmapDatabase
    from signature.database import open_database as open_database
    from signature.files import convert as convert
    from signature.files import relocalize as relocalize
    from signature.relocalization.answer import Answer as Answer
    from signature.relocalization.map_index import MapIndex as MapIndex
    from signature.relocalization.relocalizer import Relocalizer as Relocalizer
    from signature.relocalization.relocalizer import relocalize as locate  # noqa: F401

__getattr__, _names = lazy_names(__name__, __file__)
__all__ = ["__version__", *_names]


def __dir__() -> list[str]:
    return __all__
