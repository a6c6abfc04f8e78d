"""Poses in the maps of joined sessions, as they are in the frame of their building."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import SE2
from signature.database.protocol import BuildingFrame
from signature.localization.answer import answer_in_building, covariance_in_building
from signature.localization.localizer import locate_map
from tests.helpers.simulated_drives import building, office, office_part

FRAME = BuildingFrame(
    name="ground floor",
    T_building_session=SE2(30.0, -10.0, math.pi / 2),
    covariance=((4e-4, 1e-4, 0.0), (1e-4, 9e-4, 0.0), (0.0, 0.0, 1e-6)),
)


def test_an_answer_is_moved_with_all_its_poses() -> None:
    answer = locate_map(office_part((9.0, 7.0)), building({"monday": office()}))
    assert answer.status == "located" and answer.T_map_base is not None and answer.frame is None
    moved = answer_in_building(answer, {"monday": FRAME})
    # A quarter turn: (9, 7) becomes (-7, 9), and then the shift.
    assert moved.T_map_base is not None and moved.frame == "ground floor"
    assert (moved.T_map_base.x, moved.T_map_base.y) == pytest.approx((23.0, -1.0), abs=0.1)
    assert moved.T_map_base.yaw == pytest.approx(math.pi / 2, abs=0.02)
    assert moved.T_map_odom == moved.T_map_base == moved.hypotheses[0].fit.T_map_query
    assert moved.history[-1].pose == moved.T_map_base
    document = moved.to_json()
    assert document["frame"] == document["hypotheses"][0]["frame"] == "ground floor"
    assert document["pose"] is not None and document["pose"]["x"] == moved.T_map_base.x


def test_an_answer_in_a_bent_map_moves_as_its_place_does() -> None:
    """East of x = 4 m the map lies 0.3 m too far north; in the west it is right."""
    bend = tuple((x, y, 0.0, -0.3 * (x > 4.0), 0.0) for x in (0.0, 8.0) for y in (2.0, 7.0, 12.0))
    answer = locate_map(office_part((9.0, 7.0)), building({"monday": office()}))
    straight, bent = (
        answer_in_building(answer, {"monday": replace(FRAME, bend=rows)}) for rows in ((), bend)
    )
    assert straight.T_map_base is not None and bent.T_map_base is not None
    # South in the map is east in the building, which is turned by a quarter.
    assert bent.T_map_base.x - straight.T_map_base.x == pytest.approx(0.3, abs=0.02)
    assert bent.T_map_base.y == pytest.approx(straight.T_map_base.y, abs=0.02)
    assert bent.T_map_odom == bent.T_map_base == bent.hypotheses[0].fit.T_map_query
    assert bent.history[-1].pose == bent.T_map_base


def test_an_answer_in_a_session_that_was_not_joined_stays() -> None:
    answer = locate_map(office_part((9.0, 7.0)), building({"monday": office()}))
    moved = answer_in_building(answer, {"tuesday": FRAME})
    assert moved.T_map_base == answer.T_map_base and moved.covariance == pytest.approx(answer.covariance)
    assert moved.to_json()["frame"] is moved.to_json()["hypotheses"][0]["frame"] is None


def test_the_covariance_holds_how_exactly_the_session_lies_in_its_building() -> None:
    """Against 20,000 draws of both, which give a standard deviation to half a percent."""
    rng = np.random.default_rng(0)
    own, pose = np.diag([1e-2, 1e-4, 1e-4]), SE2(20.0, 5.0, 0.3)
    T = FRAME.T_building_session
    draws = []
    for off, frame_off in zip(
        rng.multivariate_normal(np.zeros(3), own, 20_000),
        rng.multivariate_normal(np.zeros(3), np.array(FRAME.covariance), 20_000),
        strict=True,
    ):
        there = SE2(T.x + frame_off[0], T.y + frame_off[1], T.yaw + frame_off[2]) @ SE2(
            pose.x + off[0], pose.y + off[1], pose.yaw + off[2]
        )
        draws.append((there.x, there.y, there.yaw))
    expected = np.cov(np.array(draws).T)
    found = covariance_in_building(own, pose, FRAME)
    sigmas = np.sqrt(np.diag(expected))
    assert found / np.outer(sigmas, sigmas) == pytest.approx(expected / np.outer(sigmas, sigmas), abs=0.03)
