"""Which of several matches is taken, and how far it is believed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pc2grid.estimation.scan_matching import MatchedScan, MatchSelector, ScanMatch
from pc2grid.estimation.smoother import PLANAR, PoseWithCovariance
from pc2grid.geometry import F64, SE2
from pc2grid.model import Scan

SCAN = Scan(stamp_ns=0, points_m=np.zeros((0, 3), np.float32), T_base_sensor=np.eye(4), sensor="laser")
EXACT = np.diag([1e4, 1e4, 1e4])  # a centimetre


def fit_at(x: float, *, evidence: float, fits: bool = True) -> ScanMatch:
    """A match at a place on the x axis; one that does not fit has half of its points on the map."""
    pose = SE2(x, 0.0, 0.0).lift()
    overlap = 0.9 if fits else 0.45
    return ScanMatch(
        pose=pose, alone=(pose, EXACT), overlap=overlap, measured=True,
        evidence=evidence, credible=fits,
    )  # fmt: skip


def expected(x: float, sigma: float) -> PoseWithCovariance:
    """A base at a place on the x axis, known to so many m and rad."""
    return PoseWithCovariance(SE2(x, 0.0, 0.0).lift(), sigma**2 * np.eye(3), np.array(PLANAR))


@dataclass
class Sensor:
    """Its matches are given: near where it is expected, and by search."""

    near: ScanMatch
    elsewhere: Sequence[ScanMatch] = ()
    searched: int = 0
    free = PLANAR
    ground = None

    def __bool__(self) -> bool:
        return True

    def start(self, *of_scan: object) -> F64:
        return np.eye(4)

    def take(self, *of_scan: object) -> None: ...

    def match(self, belief: PoseWithCovariance) -> list[ScanMatch]:
        return [self.near]

    def search(self, belief: PoseWithCovariance) -> Iterator[ScanMatch]:
        self.searched += 1
        yield from self.elsewhere

    def observable(self, fit: ScanMatch) -> ScanMatch:
        return fit

    def follow(self, belief: PoseWithCovariance) -> None: ...

    def levelled(self, pose: F64) -> F64:
        return pose

    def cut(self, *of_scan: object, lost: bool) -> None: ...

    def extend(self, pose: F64) -> None: ...

    def restart(self) -> None: ...


def placed(sensor: Sensor, belief: PoseWithCovariance) -> MatchedScan:
    return MatchSelector(sensor).place(SCAN, SCAN.points_m, [belief])  # type: ignore[arg-type]


def test_what_fits_where_it_is_expected_is_not_searched_for() -> None:
    sensor = Sensor(fit_at(0.01, evidence=100.0), [fit_at(2.0, evidence=200.0)])
    found = placed(sensor, expected(0.0, 0.02))
    assert found.alone is not None and found.alone[0][0, 3] == 0.01
    assert found.alone[1] == pytest.approx(EXACT) and not sensor.searched


def test_what_may_be_far_off_and_does_not_fit_is_searched_for() -> None:
    sensor = Sensor(fit_at(0.0, evidence=10.0, fits=False), [fit_at(1.0, evidence=100.0)])
    found = placed(sensor, expected(0.0, 0.5))
    assert sensor.searched and found.pose[0, 3] == 1.0


def test_of_two_places_that_fit_alike_neither_is_known() -> None:
    """The map may have it at either; the scans that follow decide."""
    here, there = fit_at(-0.5, evidence=100.0, fits=False), fit_at(0.5, evidence=100.5)
    found = placed(Sensor(here, [there]), expected(0.0, 0.5))
    assert found.alone is not None
    sigma_m = np.sqrt(np.linalg.inv(found.alone[1]).diagonal())
    assert sigma_m[0] > 0.5  # of masses that are equal; a third of it is 0.58 m
    assert sigma_m[1] == pytest.approx(0.01, rel=0.01)


@pytest.mark.parametrize(("new_ground", "believed"), [(90.0, True), (110.0, False)])
def test_new_ground_may_explain_a_scan_better_than_what_was_searched_for(
    new_ground: float, believed: bool
) -> None:
    """A sensor that may see what its map does not know offers that as a match without overlap."""
    nothing = replace(fit_at(0.0, evidence=new_ground, fits=False), overlap=0.0)
    sensor = Sensor(fit_at(0.0, evidence=0.0, fits=False), [fit_at(0.4, evidence=100.0), nothing])
    assert (placed(sensor, expected(0.0, 0.5)).alone is not None) is believed


def test_what_fits_neither_here_nor_elsewhere_is_not_placed() -> None:
    belief = expected(0.0, 0.02)
    found = placed(Sensor(fit_at(0.5, evidence=10.0, fits=False)), belief)
    assert found.alone is None and np.array_equal(found.pose, belief.pose)
