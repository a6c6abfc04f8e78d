"""Searches of the database beside the tracking of a robot.

A search takes up to seconds in a large building, and a robot sends 40 scans in one. So it is made in a thread
of its own, while tracking goes on: its parts that cost most are compiled and run beside Python.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from types import TracebackType
from typing import Generic, Protocol, TypeVar

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.model import RegisteredScan
from signature.localization.query import ViewSpacing

EstimateT = TypeVar("EstimateT")
EstimateT_co = TypeVar("EstimateT_co", covariant=True)


class Follows(Protocol[EstimateT_co]):
    """What follows a robot: a `Localizer` or a `PoseWatch`.

    uses_points : whether the scans that `ViewSpacing` takes are needed with their points.
    """

    @property
    def uses_points(self) -> bool:
        """See above."""
        ...

    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
    ) -> EstimateT_co | None:
        """Take in the next scan; returns an estimate if there is one after it."""
        ...

    def restart(self) -> None:
        """The scans do not go on from those before."""
        ...


_MOST_WAITING = 2000
"""Scans that wait for a search to end; beyond, the oldest are left out. Chosen by hand: some 20 MB,
and the points of a scan every 0.2 m where they are used."""


class Follower(Generic[EstimateT]):
    """Feeds a `Localizer` or a `PoseWatch` with scans, here or in a thread. Use as a context manager.

    lock : is held while the database is read; hold it to read the database in between.
    """

    def __init__(self, localizer: Follows[EstimateT], *, beside: bool, step_m: float = 1.0) -> None:
        """beside : in a thread; otherwise each search is made before `add` returns, always after the same
        scans.

        step_m : travel after which a search is due. It is left out if so much travel waits behind it.
        """
        self.lock = threading.Lock()
        self._localizer, self._step_m = localizer, step_m
        self._path_m = 0.0
        self._last: SE2 | None = None
        self._spacing = ViewSpacing()
        self._waiting: deque[tuple[RegisteredScan, PlanarScan, float] | None] = deque(maxlen=_MOST_WAITING)
        self._estimates: deque[Future[EstimateT | None]] = deque()
        self._thread = ThreadPoolExecutor(1, "searches") if beside else None

    def __enter__(self) -> Follower[EstimateT]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread, when it has finished its search."""
        self._waiting.clear()
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> None:
        """Hand over the next scan."""
        pose = SE2.from_matrix(registered.T_session_base)
        if self._last is not None:
            self._path_m += math.hypot(pose.x - self._last.x, pose.y - self._last.y)
        self._last = pose
        if self._thread is not None and not (self._localizer.uses_points and self._spacing.takes(registered)):
            # Of most scans only the pose is used, and a lidar's points would fill the memory.
            scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
            registered = replace(registered, scan=scan)
        self._hand_over((registered, planar_scan, self._path_m))

    def restart(self) -> None:
        """The scans do not go on from those before."""
        self._last, self._spacing = None, ViewSpacing()
        self._hand_over(None)

    def take(self) -> list[EstimateT]:
        """The estimates that are done. Raises what the thread raised."""
        taken = []
        while self._estimates and self._estimates[0].done():
            estimate = self._estimates.popleft().result()
            taken += [] if estimate is None else [estimate]
        return taken

    def finish(self) -> None:
        """Wait until the scans that were handed over are used."""
        wait(self._estimates)

    def _hand_over(self, item: tuple[RegisteredScan, PlanarScan, float] | None) -> None:
        self._waiting.append(item)
        if self._thread is not None:
            self._estimates.append(self._thread.submit(self._use_next))
            return
        done: Future[EstimateT | None] = Future()
        done.set_result(self._use_next())
        self._estimates.append(done)

    def _use_next(self) -> EstimateT | None:
        try:
            item = self._waiting.popleft()
        except IndexError:  # left out
            return None
        if item is None:
            self._localizer.restart()
            return None
        registered, planar_scan, path_m = item
        with self.lock:
            may_search = self._path_m - path_m < self._step_m
            return self._localizer.add(registered, planar_scan, may_search=may_search)
