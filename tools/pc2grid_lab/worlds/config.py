"""The settings of a world: what differs in it from the building as it was drawn, and who walks about."""

from __future__ import annotations

from pydantic import Field

from pc2grid.config import Section
from pc2grid.simulate import SimulationConfig


class ChangeConfig(Section):
    """What differs from the building as it was drawn or scanned. Shares are 0..1; nothing by default.

    Doors and furniture change from session to session; glass, mirrors and relief are part of the building.
    """

    doors: float = Field(default=0.0, ge=0, le=1, description="share of the doorways with a door leaf")
    closed: float = Field(
        default=0.5, ge=0, le=1, description="share of these that are shut; others stand ajar"
    )
    furniture: float = Field(
        default=0.0, ge=0, le=1, description="share of the free-standing furniture moved or exchanged"
    )
    exchanged: float = Field(default=0.3, ge=0, le=1, description="share of this that is exchanged")
    relief_per_m: float = Field(
        default=0.0, ge=0, le=2, description="radiators, pilasters and cases on a metre of wall"
    )
    glass: float = Field(default=0.0, ge=0, le=1, description="share of the visible walls that is glass")
    mirrors: float = Field(default=0.0, ge=0, le=0.5, description="share of the visible walls that is mirror")
    glass_return: float = Field(
        default=0.1, ge=0, le=1, description="share of the rays that glass returns at an angle"
    )


class WorldConfig(SimulationConfig):
    """One session in a world. The same configuration gives the same bytes."""

    walkers: int = Field(default=0, ge=0, le=1000, description="people who walk about during the drive")
    change: ChangeConfig = ChangeConfig()
