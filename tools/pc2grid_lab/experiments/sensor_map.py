"""The map of a building that one sensor has made, and where it lies in the true plan."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from pc2grid.geometry import SE2
from pc2grid.model import SensorKind, SessionMap
from pc2grid_lab.experiments.stored import write_text
from signature.config import Config
from signature.database import open_database
from signature.localization.map_index import MapIndex
from signature.sessions import add_session, provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorMap:
    """The map of the building `name` that one sensor has made, ready to be searched.

    T_plan_map : the frame of the map in the true plan.
    """

    name: str
    sensor: SensorKind
    T_plan_map: SE2
    index: MapIndex

    @staticmethod
    def load(path: Path, *, name: str, sensor: SensorKind, config: Config) -> SensorMap:
        """Read what `save_map` has written, as the map of the building `name`."""
        with open_database(path) as database:
            index = MapIndex.of(database, config)
        frame = json.loads(path.with_suffix(".json").read_text())
        return SensorMap(name=name, sensor=sensor, T_plan_map=SE2(*frame), index=index)


def is_saved(path: Path) -> bool:
    """Whether `save_map` has written this file."""
    return path.exists() and path.with_suffix(".json").exists()


def save_map(path: Path, session_map: SessionMap, T_plan_map: SE2, source: Path, config: Config) -> None:
    """Write a map to a database of its own, and its frame in the plan to a .json file beside it.

    source : the plan, scan or recording that the map was made from; only its name is kept.
    """
    path.unlink(missing_ok=True)
    add_session(path, session_map, config, provenance(source, "0" * 64, config))
    frame = (T_plan_map.x, T_plan_map.y, T_plan_map.yaw)
    write_text(path.with_suffix(".json"), json.dumps(frame))
