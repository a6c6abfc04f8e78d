"""Looks at the database beside the tracking of a robot.

A look takes up to seconds in a large building, and a robot sends 40 scans in one. So it is made in a thread
of its own, while tracking goes on: its parts that cost most are compiled and run beside Python.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import replace
from types import TracebackType
from typing import Generic, Protocol, TypeVar

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.model import RegisteredScan
from signature.relocalization.in_space import ViewSpacing

LookT = TypeVar("LookT", covariant=True)


class Looks(Protocol[LookT]):
    """What looks at the database: a `Watcher` or a `PoseWatcher`.

    uses_points : whether the scans that `ViewSpacing` takes are needed with their points.
    """

    @property
    def uses_points(self) -> bool:
        """See above."""
        ...

    def add(
        self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_look: bool = True
    ) -> LookT | None:
        """Take in the next scan; returns what a look said if there was one after it."""
        ...

    def restart(self) -> None:
        """The scans do not go on from those before."""
        ...


_MOST_WAITING = 2000
"""Scans that wait for a look to end; beyond, the oldest are left out. Chosen by hand: some 20 MB,
and the points of a scan every 0.2 m where they are used."""


class Looking(Generic[LookT]):
    """Feeds a `Watcher` or a `PoseWatcher` with scans, here or in a thread. Use as a context manager.

    lock : is held while the database is read; hold it to read the database in between.
    """

    def __init__(self, watcher: Looks[LookT], *, beside: bool, step_m: float = 1.0) -> None:
        """beside : in a thread; otherwise each look is made before `add` returns, always after the same
        scans.

        step_m : travel after which a look is due. A look is left out if so much travel waits behind it.
        """
        self.lock = threading.Lock()
        self._watcher, self._step_m = watcher, step_m
        self._done: deque[LookT] = deque()
        self._waiting: deque[tuple[RegisteredScan, PlanarScan, float] | None] = deque()
        self._path_m = 0.0
        self._last: SE2 | None = None
        self._spacing = ViewSpacing()
        self._changed = threading.Condition()
        self._stop = self._busy = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="looks", daemon=True) if beside else None
        if self._thread is not None:
            self._thread.start()

    def __enter__(self) -> Looking[LookT]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the thread, when it has finished its look."""
        with self._changed:
            self._stop = True
            self._waiting.clear()
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> None:
        """Hand over the next scan."""
        pose = SE2.from_matrix(registered.T_session_base)
        if self._last is not None:
            self._path_m += math.hypot(pose.x - self._last.x, pose.y - self._last.y)
        self._last = pose
        if self._thread is None:
            look = self._watcher.add(registered, planar_scan)
            if look is not None:
                self._done.append(look)
            return
        if not (self._watcher.uses_points and self._spacing.takes(registered)):
            # Of most scans only the pose is used, and a lidar's points would fill the memory.
            scan = replace(registered.scan, points_m=np.empty((0, 3), np.float32), offsets_s=None)
            registered = replace(registered, scan=scan)
        with self._changed:
            self._waiting.append((registered, planar_scan, self._path_m))
            while len(self._waiting) > _MOST_WAITING:
                self._waiting.popleft()
            self._changed.notify_all()

    def restart(self) -> None:
        """The scans do not go on from those before."""
        self._last, self._spacing = None, ViewSpacing()
        if self._thread is None:
            self._watcher.restart()
            return
        with self._changed:
            self._waiting.append(None)
            self._changed.notify_all()

    def take(self) -> list[LookT]:
        """The looks that are done. Raises what the thread raised."""
        if self._error is not None:
            raise self._error
        taken = []
        while self._done:
            taken.append(self._done.popleft())
        return taken

    def finish(self) -> None:
        """Wait until the scans that were handed over are used."""
        with self._changed:
            while (self._waiting or self._busy) and self._error is None and self._thread is not None:
                self._changed.wait()

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
                    while not self._waiting and not self._stop:
                        self._changed.wait()
                    if self._stop:
                        return
                    item = self._waiting.popleft()
                    self._busy = True
                if item is None:
                    self._watcher.restart()
                    continue
                registered, planar_scan, path_m = item
                behind_m = self._path_m - path_m
                with self.lock:
                    look = self._watcher.add(registered, planar_scan, may_look=behind_m < self._step_m)
                if look is not None:
                    self._done.append(look)
        except BaseException as error:
            with self._changed:
                self._error = error
                self._busy = False
                self._changed.notify_all()
