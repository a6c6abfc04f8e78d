"""Worlds in which simulated robots drive: changed buildings, glass, people, houses of several floors."""

from pc2grid_lab.worlds.config import ChangeConfig, WorldConfig
from pc2grid_lab.worlds.house import HouseConfig, HouseSession, prepare_house_session
from pc2grid_lab.worlds.session import WorldSession, iter_session, prepare_session, simulate_session

__all__ = [
    "ChangeConfig",
    "HouseConfig",
    "HouseSession",
    "WorldConfig",
    "WorldSession",
    "iter_session",
    "prepare_house_session",
    "prepare_session",
    "simulate_session",
]
