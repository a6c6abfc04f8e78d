"""Looks beside the tracking are those that are made in its place, and do not hold it up."""

from __future__ import annotations

import math
import threading
import time

import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.model import RegisteredScan
from signature.localization import localizer as follower_module
from signature.localization.localizer import Estimate, Follower, Localizer
from tests.helpers.simulated_drives import building, drive, office

OFFICE = building({"office": office()})
STEPS = [
    (registered, planar_scan)
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (5.5, 7.0)], field_rad=math.radians(270))
]


FACTS = ("stamp_ns", "path_m", "session", "T_map_base")


def facts(found: list[Estimate]) -> list[tuple[object, ...]]:
    return [(k.state, *(getattr(k.answer, name) for name in FACTS)) for k in found]


def test_a_thread_makes_the_same_looks() -> None:
    found = []
    for beside in (False, True):
        with Follower(Localizer(OFFICE), beside=beside) as follower:
            estimates: list[Estimate] = []
            for registered, planar_scan in STEPS:
                follower.add(registered, planar_scan)
                follower.finish()  # no travel waits, so no estimate is left out
                estimates += follower.take()
        found.append(facts(estimates))
    assert found[0] == found[1]
    assert len(found[0]) >= 3


class Slow:
    """A localizer whose estimates last until they are let go."""

    uses_points = False

    def __init__(self) -> None:
        self.go = threading.Event()
        self.scans = self.searches = self.restarts = self.points = 0

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True) -> None:
        self.scans += 1
        self.points += len(registered.scan.points_m)
        if may_search:
            self.searches += 1
            self.go.wait(60.0)

    def restart(self) -> None:
        self.restarts += 1


def test_a_slow_look_holds_up_no_scan_and_looks_that_are_out_of_date_are_left_out() -> None:
    slow = Slow()
    with Follower[None](slow, beside=True) as follower:
        for registered, planar_scan in STEPS:  # returns at once, although the first estimate lasts
            follower.add(registered, planar_scan)
        follower.restart()
        slow.go.set()
        follower.finish()
    assert slow.scans == len(STEPS)
    assert slow.restarts == 1
    # The estimates at the last metre, and at what was there before the rest came.
    assert slow.searches < len(STEPS) / 2


def test_what_waits_is_bounded_and_holds_no_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower_module, "_MOST_WAITING", 5)
    slow = Slow()
    with Follower[None](slow, beside=True) as follower:
        for registered, planar_scan in STEPS:
            follower.add(registered, planar_scan)
        slow.go.set()
        follower.finish()
    assert 5 <= slow.scans <= 6 and slow.points == 0


def test_an_error_of_the_thread_is_raised_where_looks_are_taken() -> None:
    class Broken(Slow):
        def add(
            self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
        ) -> None:
            raise MemoryError("too large")

    with Follower[None](Broken(), beside=True) as follower:
        follower.add(*STEPS[0])
        follower.finish()
        with pytest.raises(MemoryError, match="too large"):
            follower.take()


def test_leaving_ends_the_thread_without_using_what_waits() -> None:
    slow = Slow()
    with Follower[None](slow, beside=True) as follower:
        for registered, planar_scan in STEPS:
            follower.add(registered, planar_scan)
        while not slow.scans:
            time.sleep(0.001)
        threading.Timer(0.05, slow.go.set).start()
    assert slow.scans < len(STEPS)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("searches")]
