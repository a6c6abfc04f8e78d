"""The start of a recording by a sensor in the hand that does not show yet which way is up.

Without odometry in space and without an IMU, the vertical is that of the floor. A camera that begins with a
wall or a table can be followed in space all the same, but neither its walls nor its floor can be told. So
its first scans are kept aside and followed in the frame of the first one. The scans that show a floor give
all of them their vertical, and they are handed on.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from pc2grid.arrays import F64
from pc2grid.clouds.level import LEVEL
from pc2grid.clouds.upright import level_floor
from pc2grid.config import Config
from pc2grid.estimation.ground_model import is_rolling
from pc2grid.estimation.tracker import Tracker
from pc2grid.geometry import leveling
from pc2grid.model import Health, Scan
from pc2grid.observer import Observer

AGREEING = 3
"""Scans in a row that must show the same floor: a plane of a single view may be that of a chair. By hand."""
MOST_WAITING = 100
"""Scans that wait for a floor, at most: some 50 MB. Chosen by hand."""

_UNKNOWN = (
    "the first scans show no floor, and neither odometry nor an IMU says what is up: the sensor is taken "
    "to be held level at first; begin with the floor in view"
)


def with_vertical(
    scans: Iterable[Scan],
    config: Config,
    observer: Observer,
    assumed: Callable[[str], object],
) -> Iterator[Scan]:
    """All scans, the first with the vertical that a later one shows, if it does not know it (`T_level_base`).

    observer : is warned when scans wait. assumed : is told if no floor is seen before tracking is lost or too
        many wait, so that the sensor is taken to be held level at first.
    """
    scans = iter(scans)
    waiting: list[Scan] = []
    ups: list[F64] = []  # normals of the floor in the last scans, in the frame of the first
    tracker = Tracker(config.registration, config.projection)
    for scan in scans:
        waiting.append(scan)
        if len(waiting) == 1 and _knows_vertical(scan):
            break
        registered, normal = tracker.track(scan).registered, _floor_normal(scan)
        # The first pose is the identity, as no vertical was known.
        ups = [] if normal is None else [*ups[1 - AGREEING :], registered.T_session_base[:3, :3] @ normal]
        if len(ups) == AGREEING and (up := _common(ups)) is not None:
            waiting[0] = dataclasses.replace(waiting[0], T_level_base=leveling(up))
            break
        if len(waiting) == 1:
            observer.on_warning("the first scans show no floor: they are kept aside until one is in view")
        if registered.health is Health.LOST or len(waiting) == MOST_WAITING:
            assumed(_UNKNOWN)
            break
    else:
        if waiting:
            assumed(_UNKNOWN)
    yield from waiting
    yield from scans


def _knows_vertical(scan: Scan) -> bool:
    """Whether nothing need be waited for: on wheels, by odometry or IMU, or by a floor in view."""
    known = scan.T_odom_base is not None or scan.T_level_base is not None
    return known or is_rolling(scan) or _floor_normal(scan) is not None


def _common(ups: Sequence[F64]) -> F64 | None:
    """The mean (3,) of normals, None if one of them does not agree with it."""
    mean: F64 = np.mean(ups, axis=0)
    mean /= np.linalg.norm(mean)
    return mean if min(float(up @ mean) for up in ups) > LEVEL.level else None


def _floor_normal(scan: Scan) -> F64 | None:
    """The normal (3,) of the floor in a scan, base frame; None if it shows none."""
    ground = level_floor(scan, scan.points_m)
    return None if ground is None else ground.normal
