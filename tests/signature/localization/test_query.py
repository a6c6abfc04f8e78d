"""What a query keeps of what it has seen, and where it is described."""

from __future__ import annotations

import math

import numpy as np
import pytest

from signature.localization.query import Query
from tests.helpers.simulated_drives import building, drive, office

OFFICE = building({"office": office()})


def test_views_lie_apart_and_on_what_was_seen() -> None:
    seen = Query(OFFICE.made_with, OFFICE.config)
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)], field_rad=math.radians(90.0)):
        seen.add(registered, planar_scan)
    query = seen.map()
    centers = np.array([v.center_m for v in query.views])
    apart = np.hypot(*(centers[:, None] - centers[None]).transpose(2, 0, 1))
    assert 2 <= len(centers) <= OFFICE.config.views
    assert apart[~np.eye(len(centers), dtype=bool)].min() >= OFFICE.config.view_spacing_m
    cells = query.grid.to_cell(centers)
    assert (query.grid.cells[cells[:, 0], cells[:, 1]] >= 0).all()


def test_a_window_forgets_what_lies_farther_back() -> None:
    config = OFFICE.config.model_copy(update={"window_m": 3.0})
    long, short = (
        Query(OFFICE.made_with, OFFICE.config),
        Query(OFFICE.made_with, config),
    )
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        for seen in (long, short):
            seen.add(registered, planar_scan)
    assert long.path_m == pytest.approx(short.path_m) == pytest.approx(7.8, abs=0.3)
    assert len(short.map().keyframes) < 20 < len(long.map().keyframes)


def test_the_scans_since_a_slip_know_the_pose_of_a_later_time() -> None:
    scans = list(drive(office(), [(1.5, 7.0), (9.5, 7.0)]))
    for number, kept in ((-4, True), (4, False)):
        seen = Query(OFFICE.made_with, OFFICE.config, prior_ns=scans[number][0].scan.stamp_ns)
        for registered, planar_scan, _ in scans:
            seen.add(registered, planar_scan)
        whole, since = seen.map(), seen.since(10).map()
        assert whole.T_odom_prior is not None and (since.T_odom_prior is not None) is kept
        if kept:
            assert since.T_odom_prior == whole.T_odom_prior
            assert since.since_prior_m == pytest.approx(whole.since_prior_m)


def test_standing_still_adds_nothing() -> None:
    seen = Query(OFFICE.made_with, OFFICE.config)
    registered, planar_scan, _ = next(drive(office(), [(1.5, 7.0), (9.5, 7.0)]))
    for _ in range(50):
        seen.add(registered, planar_scan)
    assert len(seen.map().keyframes) == 2 and seen.path_m == 0.0  # the first one and the newest
