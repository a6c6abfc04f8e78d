"""When a robot is told its pose."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from signature.localization.belief import State


@dataclass(slots=True)
class ResetPolicy:
    """When `/initialpose` is sent: when the robot is located first, and when it was lost or carried away.

    Limits how often: repeated resets would keep navigation from continuing.

    pause_s : least time between two resets. most : resets until the robot has been located for `calm_s`.
    """

    pause_s: float = 10.0
    most: int = 5
    calm_s: float = 60.0
    clock: Callable[[], float] = time.monotonic
    _is_due: bool = True
    _last_s: float | None = None
    _count: int = 0

    def allows(self, state: State) -> bool:
        """Whether the pose of an estimate is to be sent; it then counts as sent.

        state : of each estimate in turn.
        """
        self._is_due = self._is_due or state in ("lost", "recovered")
        if state not in ("located", "recovered") or not self._is_due:
            return False
        now_s = self.clock()
        if self._last_s is not None:
            if now_s - self._last_s > self.calm_s:
                self._count = 0
            if now_s - self._last_s < self.pause_s or self._count >= self.most:
                return False
        self._is_due, self._last_s = False, now_s
        self._count += 1
        return True
