"""Worlds in which simulated robots drive: changed buildings, glass, people."""

from pc2grid_lab.worlds.config import ChangeConfig, WorldConfig
from pc2grid_lab.worlds.session import WorldSession, iter_session, prepare_session, simulate_session

__all__ = [
    "ChangeConfig",
    "WorldConfig",
    "WorldSession",
    "iter_session",
    "prepare_session",
    "simulate_session",
]
