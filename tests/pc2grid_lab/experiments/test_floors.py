"""Queries on floors: cut from one drive, judged by the true floor, stored and read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.simulate import SimulationConfig
from pc2grid.simulate.config import LaserConfig
from pc2grid.simulate.session import EPOCH_NS
from pc2grid_lab.experiments.floors import FloorAnswer, FloorResult, FloorTask, cut_queries, share_of
from pc2grid_lab.worlds import HouseConfig, prepare_house_session

ANSWER = FloorAnswer(
    floor=1,
    status="right",
    confidence=0.93,
    session="log0#2",
    error_m=0.02,
    poses={"log0#2": SE2(1.0, 2.0, 0.5)},
    T_house_query=SE2(3.0, 4.0, -0.5),
    walls_m=np.array([(0.25, 1.5)], np.float32),
)
RESULT = FloorResult(
    told_apart=True,
    named=False,
    floors={"log0": 0, "log0#2": 1},
    names={"log0": "0", "log0#2": "lift 1"},
    frames={"log0": SE2(), "log0#2": SE2(5.0, 0.0, 1.0)},
    answers=(ANSWER, replace(ANSWER, status="ambiguous", session=None, error_m=None)),
)


def test_a_drive_is_cut_into_queries_that_share_no_place() -> None:
    task = FloorTask(seed=1, way="logs", alike=True, sensor="laser", query_m=2.0, queries=3)
    drive = prepare_house_session(
        sensor="laser",
        house=HouseConfig(visits=(1,), floors=3),
        config=SimulationConfig(length_m=9.0, laser=LaserConfig(rate_hz=5.0, step_deg=10.0)),
    )
    queries = [[(scan.stamp_ns - EPOCH_NS) * 1e-9 for scan in scans] for scans in cut_queries(drive, task)]
    seconds = np.arange(0.0, drive.drive.duration_s, 0.01)
    steps_m = np.diff([drive.pose(s)[:2, 3] for s in seconds.tolist()], axis=0)
    driven_m = np.concatenate(([0.0], np.cumsum(np.hypot(*steps_m.T))))
    spans_m = [np.interp((times[0], times[-1]), seconds, driven_m) for times in queries]
    assert [tuple(np.round(span_m).astype(int)) for span_m in spans_m] == [(0, 2), (3, 5), (6, 8)]
    times = np.concatenate(queries)
    assert len(times) == len(np.unique(times))


def test_a_result_is_read_as_it_was_stored(tmp_path: Path) -> None:
    RESULT.save(tmp_path / "house.json")
    read = FloorResult.load(tmp_path / "house.json")
    assert read.floors == RESULT.floors and read.names == RESULT.names and read.frames == RESULT.frames
    assert [answer.status for answer in read.answers] == ["right", "ambiguous"]
    first = read.answers[0]
    assert np.array_equal(first.walls_m, ANSWER.walls_m)
    assert replace(first, walls_m=ANSWER.walls_m).poses == ANSWER.poses
    assert (first.session, first.error_m, first.T_house_query) == ("log0#2", 0.02, ANSWER.T_house_query)


def test_houses_with_one_plan_are_drawn_together() -> None:
    """Two plans, one with a wrong answer in both houses: drawn anew, none, half or all of it is wrong."""
    wrong = replace(RESULT, answers=(replace(ANSWER, status="wrong"),))
    right = replace(RESULT, answers=(ANSWER,))
    task = FloorTask(seed=1, way="lift", alike=True)
    houses = [
        (replace(task, seed=seed, alike=alike), made)
        for seed, made in ((1, wrong), (2, right))
        for alike in (True, False)
    ]
    assert share_of(houses, ("wrong",)) == pytest.approx((0.5, 0.0, 1.0))
