"""Recordings of robots that never were, with the truth: offices or real floor plans, three sensors."""

from pc2grid.simulate.config import SimulationConfig
from pc2grid.simulate.floorplan import office_floorplan
from pc2grid.simulate.record import SimulatedSession, simulate_session
from pc2grid.simulate.session import Session, iter_session, prepare_session

__all__ = [
    "Session",
    "SimulatedSession",
    "SimulationConfig",
    "iter_session",
    "office_floorplan",
    "prepare_session",
    "simulate_session",
]
