"""Simulated recordings with ground truth: a robot with one of three sensors drives through a building.

The building is a procedural office, a given floor plan, or a real building as a point cloud or a mesh.
Nothing here is fitted to recordings of real sensors; numbers without a named origin are chosen by hand.
"""

from pc2grid.simulate.config import SimulationConfig
from pc2grid.simulate.plan import office_floorplan
from pc2grid.simulate.scene import Building, load_building
from pc2grid.simulate.session import (
    Session,
    SimulatedSession,
    prepare_session,
    simulate_session,
)

__all__ = [
    "Building",
    "Session",
    "SimulatedSession",
    "SimulationConfig",
    "load_building",
    "office_floorplan",
    "prepare_session",
    "simulate_session",
]
