"""A building as one sensor mapped it, and where that map lies in the true plan."""

from __future__ import annotations

from dataclasses import dataclass

from pc2grid.geometry import SE2
from pc2grid.model import SensorKind
from signature.building import Building


@dataclass(frozen=True, slots=True, kw_only=True)
class Mapped:
    """A building as one sensor mapped it. T_plan_map : where the map's frame lies in the true plan."""

    name: str
    sensor: SensorKind
    T_plan_map: SE2
    building: Building
