"""Sessions of one corridor of 40 m: what one of them knows straightens the other, if that is soft."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2
from pc2grid.model import Health, Precision, Trajectory
from signature.database.protocol import BuildingFrame, Deformation, largest_m
from signature.localization.joining.building import RIGID, body_of, straighten
from signature.localization.joining.join import Link

DRIFT = 0.002
"""Rad a metre: over a local map of 4 m as much as one standard deviation of tracking."""
S = np.arange(0.0, 40.05, 0.2)
EXACT = np.diag((0.025, 0.025, 0.002)) ** 2
T_PLAN_DRAWN = SE2(3.0, -2.0, 0.5)
"""How the session begins in the plan."""


def drawn(s: float, drift: float = DRIFT) -> SE2:
    """A pose of the session, which turns slowly where the corridor is straight."""
    return SE2(s, drift * s * s / 2, drift * s)


def true(s: float) -> SE2:
    return T_PLAN_DRAWN @ SE2(s)


def way(drift: float = DRIFT, health: tuple[Health, ...] = ()) -> Trajectory:
    poses = np.array([drawn(s, drift).lift() for s in S.tolist()])
    return Trajectory(stamps_ns=np.arange(len(S)) * 10**8, T_session_base=poses, health=health)


def exact_to(sigma_m: float) -> Precision:
    """Of a local map each 4 m."""
    return Precision(stamps_ns=tuple(range(0, 201 * 10**8, 20 * 10**8)), sigma_m=(sigma_m,) * 11)


SOFT = body_of(way(), (), exact_to(0.1))
"""About as soft as tracking is (`LoopParameters`): its drift is no surprise."""


def frame(T: SE2, bend: Deformation = ()) -> BuildingFrame:
    exact = ((0.0, 0.0, 0.0),) * 3
    return BuildingFrame(name="plan", T_building_session=T, covariance=exact, bend=bend)


def link(s: float, T_target_there: SE2, drift: float = DRIFT) -> Link:
    """A piece of the session, around the place that it passed after `s` metres."""
    at = drawn(s, drift)
    return Link(center_m=(at.x, at.y), T_target_source=T_target_there @ at.inverse(), covariance=EXACT)


FOUND = (4.0, 12.0, 20.0, 28.0, 36.0)


def off_m(at: BuildingFrame, drift: float = DRIFT) -> F64:
    """How far the way lies from the corridor, all along."""
    placed = [at.placed(drawn(s, drift)) for s in S.tolist()]
    errors = [true(s).inverse() @ pose for s, pose in zip(S.tolist(), placed, strict=True)]
    return np.array([math.hypot(error.x, error.y) for error in errors])


def test_a_session_that_drifts_is_straightened_by_a_map() -> None:
    links = {("plan", "drive"): [link(s, true(s)) for s in FOUND]}
    frames = {"plan": frame(SE2()), "drive": frame(T_PLAN_DRAWN)}
    found = straighten({"plan": RIGID, "drive": SOFT}, frames, links)
    assert found["plan"] == frames["plan"]
    # Drawn, its end is 1.6 m off. A piece is exact to 2.5 cm, and 4 m beyond the last one drift goes on for
    # 4 m: 1.6 cm.
    assert off_m(frame(T_PLAN_DRAWN)).max() > 1.5 and off_m(found["drive"]).max() < 0.05
    # About as many rows as there are metres of way in a square.
    assert 10 <= len(found["drive"].bend) <= 12


def test_a_stiff_session_straightens_a_soft_one_and_never_the_other_way() -> None:
    bodies = {"stiff": body_of(way(drift=0.0), (), exact_to(0.01)), "soft": SOFT}
    for names in (("stiff", "soft"), ("soft", "stiff")):
        begin = {"stiff": frame(T_PLAN_DRAWN), "soft": frame(T_PLAN_DRAWN @ SE2(0.0, 0.5, -0.04))}
        links = {("stiff", "soft"): [link(s, SE2(s)) for s in FOUND]}
        found = straighten(bodies, {name: begin[name] for name in names}, links)
        # Nothing that a map could show of it. A bow of 40 m is 0.4 m high: half of it to either side.
        assert found["stiff"].bend == () and largest_m(found["soft"].bend) > 0.2
        T_stiff = found["stiff"].T_building_session
        T_soft_true = [(T_stiff @ SE2(s)).inverse() @ found["soft"].placed(drawn(s)) for s in S.tolist()]
        assert max(math.hypot(error.x, error.y) for error in T_soft_true) < 0.05
        # The session that the frame is named after stays where it lies on an average.
        assert found[names[0]].T_building_session == begin[names[0]].T_building_session


def test_a_wrong_piece_bends_nothing() -> None:
    links = [link(s, true(s)) for s in FOUND]
    links[2] = link(20.0, true(20.0) @ SE2(0.0, 1.0, 0.1))
    found = straighten(
        {"plan": RIGID, "drive": SOFT},
        {"plan": frame(SE2()), "drive": frame(T_PLAN_DRAWN)},
        {("plan", "drive"): links},
    )
    # As without it: between the pieces beside it, tracking is exact enough to refuse it.
    assert off_m(found["drive"]).max() < 0.05


def test_sessions_that_were_joined_before_stay_bent_as_they_are() -> None:
    """The plan lies half a metre to the left of where it was drawn: what is found in it follows."""
    links = {("plan", "drive"): [link(s, true(s)) for s in FOUND]}
    plan = frame(SE2(), ((0.0, 0.0, 0.0, 0.5, 0.0),))
    frames = {"first": frame(SE2()), "plan": plan, "drive": frame(T_PLAN_DRAWN)}
    bodies = {"first": RIGID, "plan": RIGID, "drive": SOFT}
    found = straighten(bodies, frames, links, held=("first", "plan"))
    assert found["first"] == frames["first"] and found["plan"] == plan
    there = found["drive"].placed(drawn(20.0))
    wanted = SE2(0.0, 0.5, 0.0) @ true(20.0)
    assert (there.x, there.y) == pytest.approx((wanted.x, wanted.y), abs=0.05)
