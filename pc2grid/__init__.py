"""Recordings -> registered scans -> occupancy grids -> submaps.

The front of pc2grid: everything that depends on the kind of sensor. `signature`, the back, only gets grids
and submaps; its most used names are exported here, too. Importing this package loads no library: each name
loads its module when it is first used. `help(pc2grid.convert)` and so on explain them.

>>> import pc2grid
>>> monday = pc2grid.convert("monday.mcap", "monday.submaps")
>>> monday.sensor, monday.grid.resolution_m, len(monday.submaps) > 10
('laser', 0.05, True)
>>> pc2grid.relocalize("tuesday.mcap", "monday.submaps").status
'located'

From file to file
    convert             a recording or nav2 map becomes a session in a database
    relocalize          where in a database a recording was made: a Found, an Answer that can be drawn

Recordings to maps
    open_log, Log       a recording as a stream of scans
    follow              each scan with its pose, as they come
    build_map           a recording becomes a SessionMap; map_scans: scans of your own
    build_maps          the same; several, if its parts cannot be placed to each other
    submaps_of          the submaps of a grid
    load_map, save_map  nav2 maps; read_tum, write_tum, write_kitti: trajectories
    simulate_session    a recording of a simulated robot, with SimulationConfig

Databases and answers
    open_database       a SubmapDatabase; Label: building and floor of a session
    Localizer           where registered scans were taken, in a MapIndex, while the robot drives: an Answer
    Prior               where the robot is known to be, roughly

Types
    Scan, RegisteredScan, Health, Trajectory, Loop, OccupancyGrid, Submap, SessionMap
    SE2                 a planar pose
    Config, TimeSpan    settings; a part of a recording
    Observer            gets the progress
    Pc2GridError        every error that is raised on purpose; its `hint` is what to do

Everywhere metres, radians, int64 nanoseconds; `T_target_source` maps coordinates of source into target.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from pc2grid._version import __version__

# The public names, for type checkers and editors. A function with the name of its module has another name,
# as the module would hide it.
if TYPE_CHECKING:
    from pc2grid.errors import Pc2GridError as Pc2GridError
    from pc2grid.estimation.tracker import follow as follow
    from pc2grid.geometry import SE2 as SE2
    from pc2grid.io.maps import load_map as load_map, save_map as save_map
    from pc2grid.io.recording import Log as Log, open_log as open_log
    from pc2grid.io.trajectory import read_tum as read_tum, write_kitti as write_kitti, write_tum as write_tum
    from pc2grid.model import (
        Health as Health,
        Loop as Loop,
        OccupancyGrid as OccupancyGrid,
        RegisteredScan as RegisteredScan,
        Scan as Scan,
        SessionMap as SessionMap,
        Submap as Submap,
        Trajectory as Trajectory,
    )
    from pc2grid.observer import Observer as Observer, TimeSpan as TimeSpan
    from pc2grid.simulate import SimulationConfig as SimulationConfig, simulate_session as simulate_session
    from pc2grid.submaps.submaps import partition as submaps_of  # noqa: F401

    # Of the package above this one, so that a user needs one import. `pyproject.toml` allows it here only.
    from signature.config import Config as Config
    from signature.database import (
        Label as Label,
        SubmapDatabase as SubmapDatabase,
        open_database as open_database,
    )
    from signature.localization.answer import Answer as Answer
    from signature.localization.localizer import Localizer as Localizer
    from signature.places.map_index import MapIndex as MapIndex, Prior as Prior
    from signature.session.build import (
        build_map as build_map,
        build_maps as build_maps,
        map_scans as map_scans,
    )
    from signature.sessions import convert as convert, relocalize as relocalize
    from signature.shown.page import Found as Found

# Where each is found; with another name there, behind the colon. A test compares this with the list above.
_HOMES = {
    "Pc2GridError": "pc2grid.errors",
    "SE2": "pc2grid.geometry",
    "load_map": "pc2grid.io.maps",
    "save_map": "pc2grid.io.maps",
    "Log": "pc2grid.io.recording",
    "open_log": "pc2grid.io.recording",
    "read_tum": "pc2grid.io.trajectory",
    "write_kitti": "pc2grid.io.trajectory",
    "write_tum": "pc2grid.io.trajectory",
    "Health": "pc2grid.model",
    "Loop": "pc2grid.model",
    "OccupancyGrid": "pc2grid.model",
    "RegisteredScan": "pc2grid.model",
    "Scan": "pc2grid.model",
    "SessionMap": "pc2grid.model",
    "Submap": "pc2grid.model",
    "Trajectory": "pc2grid.model",
    "Observer": "pc2grid.observer",
    "build_map": "signature.session.build",
    "build_maps": "signature.session.build",
    "follow": "pc2grid.estimation.tracker",
    "map_scans": "signature.session.build",
    "SimulationConfig": "pc2grid.simulate",
    "simulate_session": "pc2grid.simulate",
    "submaps_of": "pc2grid.submaps.submaps:partition",
    "TimeSpan": "pc2grid.observer",
    "Config": "signature.config",
    "Label": "signature.database",
    "SubmapDatabase": "signature.database",
    "open_database": "signature.database",
    "convert": "signature.sessions",
    "relocalize": "signature.sessions",
    "Answer": "signature.localization.answer",
    "Found": "signature.shown.page",
    "MapIndex": "signature.places.map_index",
    "Prior": "signature.places.map_index",
    "Localizer": "signature.localization.localizer",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> object:
    """Load the module of a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, thing = _HOMES[name].partition(":")
    return getattr(import_module(module), thing or name)


def __dir__() -> list[str]:
    return __all__
