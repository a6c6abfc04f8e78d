"""Progress and news of a piece of work, and the part of a recording that it works on.

`Observer` is one object in place of a callback for each kind of news. It is also the null object: all its
methods do nothing, so a stage calls them without a test. A subclass overrides the methods that it needs.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

    from pc2grid.model import RegisteredScan


class Observer:
    """Gets the news of a piece of work, in the thread that does the work.

    >>> class Shares(Observer):
    ...     def __init__(self) -> None:
    ...         self.shares: list[float] = []
    ...     def on_progress(self, share: float) -> None:
    ...         self.shares.append(share)
    >>> import pc2grid
    >>> observer = Shares()
    >>> with pc2grid.open_log("monday.mcap") as log:
    ...     part = pc2grid.TimeSpan(0.0, 1.0)
    ...     monday = pc2grid.build_map(log, session="monday", span=part, observer=observer)
    >>> observer.shares == sorted(observer.shares), observer.shares[-1]
    (True, 1.0)
    """

    def step(self, what: str, recorded_s: float | None = None) -> AbstractContextManager[None]:
        """Surround a step of the work.

        what : name of the step, for the user. recorded_s : length of the recording that the step works
        through; None if there is none.
        """
        return nullcontext()

    def on_progress(self, share: float) -> None:
        """Take the finished share of the present step: 0..1, never decreasing."""

    def on_scan(self, registered: RegisteredScan) -> None:
        """Take the next scan with its tracked pose, before loops are closed."""

    def on_note(self, text: str) -> None:
        """Take a sentence about a choice of the program, for a user who wants details."""

    def on_warning(self, text: str) -> None:
        """Take a sentence about a problem that the program has dealt with."""


_UPDATE_EVERY_S = 0.1
"""Least time between two updates of a progress bar, the period of rich; stages report each scan."""


class ProgressBars(Observer):
    """Shows each step as a moving bar, on a terminal (standard error) or in a notebook; else nothing."""

    def __init__(self) -> None:
        self._update: Callable[[float], None] | None = None

    @contextmanager
    def step(self, what: str, recorded_s: float | None = None) -> Iterator[None]:
        """Surround a step of the work with its bar."""
        from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TimeElapsedColumn

        columns = (SpinnerColumn(), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        with bars_on_stderr("{task.description}", *columns) as bars:
            task = bars.add_task(what, total=1.0)
            self._update = seldom(lambda share: bars.update(task, completed=share))
            yield
        self._update = None

    def on_progress(self, share: float) -> None:
        """Move the bar."""
        if self._update is not None:
            self._update(share)


def bars_on_stderr(*columns: str | ProgressColumn) -> Progress:
    """Return bars that are shown, and at the end wiped away, where stderr is a terminal or a notebook.

    Of what is printed meanwhile they take over only what goes to a terminal, too, to write it above the bars:
    else they would swallow the result of a program whose output goes to a file.
    """
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    return Progress(
        *columns,
        console=console,
        transient=True,
        redirect_stdout=sys.stdout.isatty(),
        redirect_stderr=console.is_terminal,
        disable=not (console.is_terminal or console.is_jupyter),
        get_time=time.monotonic,
    )


def seldom(update: Callable[[float], None]) -> Callable[[float], None]:
    """Return `update` as one that may be called for each scan: it works ten times a second at most."""
    last_s = -_UPDATE_EVERY_S

    def at_most(share: float) -> None:
        nonlocal last_s
        now_s = time.monotonic()
        if now_s - last_s >= _UPDATE_EVERY_S:
            last_s = now_s
            update(share)

    return at_most


@dataclass(frozen=True, slots=True)
class TimeSpan:
    """A part of a recording.

    start_s : its begin, in seconds after the begin of the recording.
    duration_s : its length; None: to the end of the recording.

    >>> TimeSpan(10.0).share_done(40_000_000_000, start_ns=0, end_ns=70_000_000_000)
    0.5
    """

    start_s: float = 0.0
    duration_s: float | None = None

    def length_ns(self, start_ns: int, end_ns: int) -> int:
        """Return the length of this part of a recording from `start_ns` to `end_ns`; at least 1."""
        if self.duration_s is not None:
            return max(int(self.duration_s * 1e9), 1)
        return max(end_ns - start_ns - int(self.start_s * 1e9), 1)

    def share_done(self, stamp_ns: int, start_ns: int, end_ns: int) -> float:
        """Return the share of this part, 0..1, before `stamp_ns`."""
        elapsed_ns = stamp_ns - start_ns - int(self.start_s * 1e9)
        return min(max(elapsed_ns / self.length_ns(start_ns, end_ns), 0.0), 1.0)
