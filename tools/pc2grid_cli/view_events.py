"""What happens while something is located, as server-sent events for all pages that look on."""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pc2grid.geometry import SE2
from pc2grid.model import Health

if TYPE_CHECKING:
    from pc2grid.model import RegisteredScan
    from signature.localization.localizer import Estimate

_MOST_WAITING = 1000
"""Events that wait for a page that does not read them; older ones are dropped."""
_MOST_SCANS = 4000
"""Scans of the path so far, for pages that come later; of a longer path every second one is left out."""
_SCANS_EVERY_S = 0.1
"""Scans are sent together, so often; more could not be seen."""


class Events:
    """Passes events on to any number of pages."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pages: list[queue.Queue[bytes | None]] = []
        self._last: dict[str, bytes] = {}
        self._scans: list[Any] = []
        self._closed = False

    @property
    def looking_on(self) -> int:
        """The number of pages that get the events."""
        return len(self._pages)

    def publish(self, kind: str, data: Any) -> None:
        """Send an event; the last one of each kind, and all scans, are kept for pages that come later."""
        event = _event(kind, data)
        with self._lock:
            if kind == "begin":  # what was before is over
                self._last.clear()
                self._scans.clear()
            if kind == "scans":
                self._scans.extend(data)
                if len(self._scans) > _MOST_SCANS:
                    del self._scans[1::2]
            else:
                self._last[kind] = event
            for page in self._pages:
                _put(page, event)

    @contextlib.contextmanager
    def subscribed(self) -> Iterator[queue.Queue[bytes | None]]:
        """What was, then the events as they come, then None at the end."""
        page: queue.Queue[bytes | None] = queue.Queue(_MOST_WAITING)
        with self._lock:
            for kind, event in self._last.items():
                _put(page, event)
                if kind == "begin" and self._scans:
                    _put(page, _event("scans", self._scans))
            if self._closed:
                _put(page, None)
            self._pages.append(page)
        try:
            yield page
        finally:
            with self._lock:
                self._pages.remove(page)

    def close(self) -> None:
        """No more events: tell all pages."""
        with self._lock:
            self._closed = True
            for page in self._pages:
                _put(page, None)


def _event(kind: str, data: Any) -> bytes:
    return f"event: {kind}\ndata: {json.dumps(data, allow_nan=False)}\n\n".encode()


def _put(page: queue.Queue[bytes | None], event: bytes | None) -> None:
    """Add an event, in place of the oldest one if the page does not keep up."""
    while True:
        try:
            page.put_nowait(event)
            return
        except queue.Full:
            with contextlib.suppress(queue.Empty):
                page.get_nowait()


@dataclass
class Progress:
    """Publishes the scans of one query, and its answers.

    Events: `scans`, a list of x, y, yaw in the query's own frame, and 1 where another such frame begins,
    because registration was lost; `moment`, the state of the answer with the pose in the map and the base in
    the query's frame, from which a page draws the path on the map.
    """

    events: Events
    _waiting: list[list[float]] = field(default_factory=list)
    _sent_s: float = 0.0
    _base: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def add(self, registered: RegisteredScan | None) -> None:
        """The next scan; None: what follows does not go on from what was before."""
        if registered is None:
            self._waiting.append([*self._base, 1])
            return
        self._base = _planar(registered)
        self._waiting.append([*self._base, int(registered.health is Health.LOST)])
        if time.monotonic() - self._sent_s >= _SCANS_EVERY_S:
            self.flush()

    def tell(self, estimate: Estimate) -> None:
        """An estimate; without an answer, the best place all the same."""
        moment = estimate.answer.history[-1]
        self.flush()
        self.events.publish(
            "moment",
            {
                "path_m": moment.path_m,
                "status": moment.status,
                "session": moment.session,
                "confidence": moment.confidence,
                "pose": moment.pose and [moment.pose.x, moment.pose.y, moment.pose.yaw],
                "base": _planar(estimate.registered),
            },
        )

    def flush(self) -> None:
        """Send the scans that wait."""
        if self._waiting:
            self.events.publish("scans", self._waiting)
        self._waiting, self._sent_s = [], time.monotonic()


def _planar(registered: RegisteredScan) -> tuple[float, float, float]:
    """x, y, yaw of the base in the query's frame, as finely as it can be seen."""
    base = SE2.from_matrix(registered.T_session_base)
    return round(base.x, 3), round(base.y, 3), round(base.yaw, 4)
