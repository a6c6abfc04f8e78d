"""Which wall points the coarse search takes, and how exactly a place is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import F32, SE2
from pc2grid.matching.score import score_fit
from pc2grid.matching.search import SearchMap
from pc2grid.model import OccupancyGrid
from signature.config import Config, RelocalizeConfig, ShortlistBy
from signature.localization import map_index
from signature.localization.decision import decide
from signature.localization.hypotheses import (
    HYPOTHESES,
    Hypothesis,
    best_around,
    coarse_points,
    distinct,
    fitted,
)
from signature.localization.query import query_of
from tests.helpers.simulated_drives import building, office, office_part, with_tables

CENTER_M = (3.0, -2.0)


def ring(radius_m: float, count: int) -> F32:
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    around = radius_m * np.column_stack((np.cos(angles), np.sin(angles))) + CENTER_M
    return np.asarray(around, np.float32)


def test_near_and_far_walls_have_the_same_share() -> None:
    """Boxes around the robot give many points; the walls of the hall behind them must count as well."""
    boxes = np.concatenate([ring(r, 200) for r in (1.0, 2.0, 3.0, 4.0)])
    chosen = coarse_points(np.concatenate((boxes, ring(15.0, 500), ring(30.0, 500))), CENTER_M)
    away_m = np.hypot(*chosen.T)
    assert np.count_nonzero(away_m < 8.0) == HYPOTHESES.few_points
    assert np.count_nonzero(np.abs(away_m - 15.0) < 0.1) == HYPOTHESES.few_points
    assert away_m.max() < HYPOTHESES.far_m


def test_a_room_has_near_walls_only() -> None:
    chosen = coarse_points(ring(4.0, 400), CENTER_M)
    assert 0 < len(chosen) <= HYPOTHESES.few_points
    assert coarse_points(np.empty((0, 2), np.float32), CENTER_M).shape == (0, 2)


def test_a_pose_is_not_stated_more_exactly_than_the_map_is_drawn() -> None:
    """The map on itself: the alignment alone states 2 to 4 cm along rooms and some millimetres across."""
    query = query_of(office(), np.empty((0, 2)), Config(), Config().relocalize)
    fit = fitted(query, 0, -1, SearchMap.of(office()), SE2(0.04, -0.03, 0.01)).fit
    stated = np.sqrt(np.diag(fit.covariance))
    assert np.all(stated >= (HYPOTHESES.map_m, HYPOTHESES.map_m, HYPOTHESES.map_rad))
    assert np.all(stated < (0.1, 0.1, 0.01))  # a tenth of a robot's width: what is aligned is known


def test_tables_that_a_lidar_has_seen_over_and_under_hide_no_place_from_a_laser() -> None:
    of_laser, of_lidar = office(), with_tables(office())
    at_map = SE2(0.04, -0.03, 0.01)

    def agreement(query: OccupancyGrid, target: OccupancyGrid) -> float:
        config = Config()
        asked = query_of(query, np.empty((0, 2)), config, config.relocalize)
        searched = building({"map": target}, config).maps_for(asked)[0]
        return fitted(asked, 0, -1, searched, at_map).fit.known_agreement_both_ways

    plain = replace(of_lidar, heights=None)
    assert agreement(of_laser, of_lidar) > 0.9 > agreement(of_laser, plain)
    assert agreement(of_lidar, of_laser) > 0.9 > agreement(plain, of_laser)


def test_a_shoulder_is_led_to_its_peak_and_is_no_place_of_its_own() -> None:
    query = query_of(office(), np.empty((0, 2)), Config(), Config().relocalize)
    target = SearchMap.of(office())
    peak = fitted(query, 0, -1, target, SE2())
    aside = SE2(0.6, -0.5, 0.06)
    shoulder = Hypothesis(
        session_index=0, row=3, fit=score_fit(target.walls, query.walls, aside, peak.fit.covariance)
    )
    assert distinct(query, (shoulder, peak)) == (replace(peak, row=3),)
    led = best_around(query, shoulder, target)
    pose = led.fit.T_map_query
    assert abs(pose.x) + abs(pose.y) < 0.05 and led.fit.score > shoulder.fit.score
    (one,) = distinct(query, (led, peak))
    assert one.row == 3  # of the place that proposed it
    elsewhere = replace(led, session_index=1)
    farther = replace(shoulder, fit=replace(shoulder.fit, T_map_query=SE2(0.9, 0.0, 0.0)))
    for other in (elsewhere, farther):
        assert len(distinct(query, (other, peak))) == 2


@pytest.mark.parametrize("by", ["signatures", "random"])
def test_a_search_goes_on_until_it_is_sure(by: ShortlistBy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the order is, no length of a list decides what is found."""
    monkeypatch.setattr(map_index, "FIRST_PLACES", 2)
    config = Config(relocalize=RelocalizeConfig(shortlist_by=by))
    index = building({"office": office()}, config)
    query = query_of(office_part((15.0, 5.0), 4.5), np.empty((0, 2)), config, config.relocalize)
    steps = [left for _, left in index.search(query)]
    assert len(steps) > 1 and steps == sorted(steps, reverse=True) and abs(steps[-1]) < 1e-9
    verdict, _ = decide(index, query)
    assert verdict.status == "located"
    pose = verdict.hypotheses[0].fit.T_map_query
    assert abs(pose.x - 15.0) + abs(pose.y - 5.0) < 0.1
