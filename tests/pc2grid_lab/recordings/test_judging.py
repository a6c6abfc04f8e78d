"""Answers of several drives in one map judge each other; true poses are carried to the scans between."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid, Trajectory
from pc2grid.observer import TimeSpan
from pc2grid_lab.recordings import judging
from pc2grid_lab.recordings.catalogue import Catalogue, Pair, Placed, Recording
from pc2grid_lab.recordings.judging import Judge, LocatedWindow, RecordedDrive, known_share, levelled
from pc2grid_lab.recordings.run import Folder
from pc2grid_lab.recordings.table import JoinRow, counts_of
from pc2grid_lab.runner import Finished

T_A_B, T_PLAN_A = SE2(3.0, -1.0, 0.4), SE2(20.0, 8.0, -1.2)
RECORDINGS = {
    name: Recording(name=name, file=name, building="x", sensor="map" if name == "plan" else "laser")
    for name in ("a", "b", "plan")
}
B_IN_A = Pair(query="b", map="a", kind="other day", window_s=1.0, windows=4)
A_IN_PLAN = Pair(query="a", map="plan", kind="published map", window_s=1.0, windows=2)
B_IN_PLAN = Pair(query="b", map="plan", kind="published map", window_s=1.0, windows=2)


def pose(window: int) -> SE2:
    return SE2(4.0 * window, 1.0 * window, 0.5 * window)


def located(query: str, window: int, found: SE2 | None, *, status: str = "located") -> LocatedWindow:
    """A window that says `found`; None: its scan has no pose in the drive."""
    said = found or SE2()
    document = {
        "status": status,
        "confidence": 0.9 if status == "located" else 0.2,
        "query": {"path_m": 3.0, "stamp_ns": window},
        "hypotheses": [{"session": "map", "place": 0, "x": said.x, "y": said.y, "yaw": said.yaw}],
    }
    done = Finished(code=0, cpu_s=1.0, document=document)
    where = None if found is None else (0, pose(window))
    return LocatedWindow(query, window, TimeSpan(float(window), 1.0), done, where, np.zeros((1, 2)))


class Known(Judge):
    """A judge who is told the answers."""

    def __init__(self, answers: Mapping[Pair, list[LocatedWindow]]) -> None:
        mapped = tuple(RECORDINGS.values())
        catalogue = Catalogue(recordings=RECORDINGS, mapped=mapped, pairs=tuple(answers))
        super().__init__(catalogue, Folder(Path("/data"), Path("/work")))
        self._windows.update(answers)

    def _problem(self, pair: Pair) -> str:
        return ""

    def _fine(self, pair: Pair, one: LocatedWindow, expected: Any) -> float:
        return 0.95 if one.window % 2 else 0.6


@pytest.fixture(autouse=True)
def all_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every map is of free ground all around."""
    free = OccupancyGrid(cells=np.zeros((400, 400), np.int8), resolution_m=0.2, origin_m=(-40.0, -40.0))
    monkeypatch.setattr(judging, "grids", lambda *_: {"map": free})


def answers(*, a: tuple[SE2, ...], b: tuple[SE2, ...]) -> dict[Pair, list[LocatedWindow]]:
    """b is located in a; both are located in the plan, where they say these transforms."""
    return {
        B_IN_A: [located("b", k, T_A_B @ pose(k)) for k in range(4)],
        A_IN_PLAN: [located("a", k, T @ pose(k)) for k, T in enumerate(a)],
        B_IN_PLAN: [located("b", k, T @ T_A_B @ pose(k)) for k, T in enumerate(b)],
    }


def test_two_drives_of_two_answers_each_judge_each_other() -> None:
    wrong = SE2(-5.0, 2.0, 2.0)
    known = answers(a=(T_PLAN_A, T_PLAN_A), b=(T_PLAN_A, wrong, T_PLAN_A))
    known[B_IN_PLAN].append(located("b", 3, None))
    first, second = Known(known).row(A_IN_PLAN), Known(known).row(B_IN_PLAN)
    assert (first.truth, first.agreeing) == (second.truth, second.agreeing) == ("agreement", 4)
    assert [query.right for query in first.queries] == [True, True]
    assert [query.right for query in second.queries] == [True, False, True, None]
    assert [query.covered for query in second.queries] == [True, True, True, None]


def test_a_drive_alone_has_too_few() -> None:
    known = answers(a=(T_PLAN_A, T_PLAN_A), b=(T_PLAN_A, T_PLAN_A))
    del known[B_IN_A]
    row = Known(known).row(A_IN_PLAN)
    assert row.truth is None and [query.right for query in row.queries] == [None, None]


def test_drives_that_contradict_each_other_are_not_judged() -> None:
    other = T_PLAN_A @ SE2(6.2, 0.0, 0.0)
    row = Known(answers(a=(T_PLAN_A,) * 3, b=(other,) * 3)).row(B_IN_PLAN)
    assert row.truth is None and len(row.queries) == 3


def test_answers_both_ways_judge_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two answers in each direction, which alone are too few: b in the map of a, a in that of b."""
    monkeypatch.setattr(judging, "sessions", lambda *_: {"map": None})
    a_in_b = Pair(query="a", map="b", kind="other day", window_s=1.0, windows=3)
    wrong = SE2(-5.0, 2.0, 2.0)
    known = {
        B_IN_A: [located("b", k, T_A_B @ pose(k)) for k in range(2)],
        a_in_b: [located("a", k, T_A_B.inverse() @ pose(k)) for k in range(2, 4)]
        + [located("a", 4, wrong @ pose(4))],
    }
    first, second = Known(known).row(B_IN_A), Known(known).row(a_in_b)
    assert (first.truth, first.agreeing) == (second.truth, second.agreeing) == ("agreement", 4)
    assert [query.right for query in first.queries] == [True, True]
    assert [query.right for query in second.queries] == [True, True, False]
    del known[a_in_b]
    assert Known(known).row(B_IN_A).truth is None


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch) -> Trajectory:
    """The own trajectory of every recording, a pose a second."""
    poses = np.array([pose(k).lift() for k in range(6)])
    way = Trajectory(stamps_ns=np.arange(6) * 1_000_000_000, T_session_base=poses)
    monkeypatch.setattr(judging, "drive_of", lambda *_: RecordedDrive((way,), None))
    return way


@pytest.mark.usefixtures("driven")
def test_one_pose_found_by_hand_judges_a_drive() -> None:
    """Within what the drawn map allows; the third answer is as near, but turned."""
    known = T_PLAN_A @ pose(1)
    placed = Placed(at_s=1.1, x_m=known.x, y_m=known.y, yaw_deg=math.degrees(known.yaw), within_m=1.0)
    pair = replace(A_IN_PLAN, windows=4, placed=placed)
    offs = (SE2(0.8, 0.0, 0.0), SE2(1.4, 0.0, 0.0), SE2(0.0, 0.0, 0.2), SE2(-26.0, 0.0, 0.0))
    row = Known({pair: [located("a", k, T_PLAN_A @ pose(k) @ off) for k, off in enumerate(offs)]}).row(pair)
    assert row.truth == "hand" and [query.right for query in row.queries] == [True, False, False, False]
    assert counts_of(row.queries)["not judged"] == 0


def test_later_parts_are_judged_by_the_trajectory_of_the_whole(
    driven: Trajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map of the first three seconds has a frame of its own."""
    begun = Trajectory(
        stamps_ns=driven.stamps_ns[:3], T_session_base=np.array([(T_A_B @ pose(k)).lift() for k in range(3)])
    )
    monkeypatch.setattr(judging, "sessions", lambda *_: {"map": begun})
    pair = Pair(query="a", map="a", kind="later part", window_s=1.0, windows=2, until_s=3.0)
    answers = [located("a", 3, T_A_B @ pose(3)), located("a", 4, T_A_B @ pose(4) @ SE2(2.0, 0.0, 0.0))]
    row = Known({pair: answers}).row(pair)
    assert row.truth == "trajectory" and [query.right for query in row.queries] == [True, False]


def test_what_a_check_of_the_true_pose_finds_and_the_search_does_not_is_counted() -> None:
    found = answers(a=(T_PLAN_A, T_PLAN_A), b=(T_PLAN_A, T_PLAN_A))
    found[A_IN_PLAN] = [located("a", k, T_PLAN_A @ pose(k), status="not_found") for k in range(2)]
    judge = Known(found)
    missed, right = judge.row(A_IN_PLAN), judge.row(B_IN_PLAN)
    assert [query.fine for query in missed.queries] == [0.6, 0.95]
    assert [query.fine for query in right.queries] == [None, None]
    assert [counts_of(row.queries)["overlooked"] for row in (missed, right)] == [1, 0]


def test_elsewhere_nothing_is_right() -> None:
    pair = Pair(query="b", map="plan", kind="elsewhere", window_s=1.0, windows=2)
    row = Known({pair: [located("b", 0, SE2()), located("b", 1, SE2(), status="not_found")]}).row(pair)
    assert [query.outcome for query in row.queries] == ["wrong", "refused"]


def test_what_cannot_be_judged_is_a_row_that_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise KeyError("hypotheses")

    monkeypatch.setattr(judging, "_agreed", broken)
    row = Known(answers(a=(T_PLAN_A,), b=(T_PLAN_A,))).row(B_IN_A)
    assert row.problem == "KeyError: 'hypotheses'"


def test_a_join_is_judged_by_the_answers_that_relate_its_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """b is located in a, and a in the plan: how b lies in the plan follows."""
    way = Trajectory(stamps_ns=np.arange(4), T_session_base=np.array([pose(k).lift() for k in range(4)]))
    monkeypatch.setattr(judging, "drive_of", lambda *_: RecordedDrive((way,), None))
    known = {
        B_IN_A: [located("b", k, T_A_B @ pose(k)) for k in range(4)],
        A_IN_PLAN: [located("a", k, T_PLAN_A @ pose(k)) for k in range(4)],
    }

    def joined(target: str, source: str, T: SE2, answers: Any = known) -> JoinRow:
        document = {"status": "joined", "probability": 1.0, "common_m2": 50.0, "looks": []}
        poses = {"T_target_source": asdict(T), "middle": asdict(pose(2))}
        done = Finished(code=0, cpu_s=1.0, document=document | poses)
        monkeypatch.setattr(judging, "kept_result", lambda _: done)
        return Known(answers).join_row(target, source)

    right = joined("plan", "b", T_PLAN_A @ T_A_B)
    assert right.outcome == "right" and right.error_m == pytest.approx(0.0, abs=1e-6)
    assert joined("a", "b", T_A_B).outcome == joined("b", "a", T_A_B.inverse()).outcome == "right"
    wrong = joined("plan", "b", SE2(0.0, 1.0, 0.0) @ T_PLAN_A @ T_A_B)
    assert wrong.outcome == "wrong" and wrong.error_m == pytest.approx(1.0)
    assert joined("plan", "b", T_PLAN_A @ T_A_B, {B_IN_A: known[B_IN_A]}).outcome == "not judged"


def trajectory(*stamps_s: float) -> Trajectory:
    """1 m/s along a line that turns."""
    poses = np.array([SE2(t, 0.1 * t, 0.05 * t).lift() for t in stamps_s]).reshape(-1, 4, 4)
    return Trajectory(stamps_ns=(np.array(stamps_s) * 1e9).astype(np.int64), T_session_base=poses)


def test_true_poses_are_interpolated_or_carried() -> None:
    own = trajectory(*np.arange(0.0, 30.0, 0.25))
    dense = RecordedDrive((), trajectory(0.0, 0.2, 0.4))
    part, between = dense.where(100_000_000) or (0, SE2())
    assert part == -1 and (between.x, between.y) == pytest.approx((0.1, 0.01))
    sparse = RecordedDrive((own,), trajectory(0.0, 1.0, 8.0))
    part, carried = sparse.where(6_000_000_000) or (0, SE2())
    assert part == -1 and (carried.x, carried.yaw) == pytest.approx((6.0, 0.3))
    assert sparse.where(25_000_000_000) is None  # 17 s from the last true pose
    assert RecordedDrive((), trajectory(0.0, 8.0)).where(6_000_000_000) is None


def test_a_world_that_lies_as_the_first_image_is_put_upright() -> None:
    own = trajectory(*np.arange(0.0, 30.0, 0.25))
    lying = np.eye(4)
    lying[:3, :3] = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]  # x right, y down, z forward
    upright = levelled(replace(own, T_session_base=lying @ own.T_session_base), [own])
    first, last = (SE2.from_matrix(upright.T_session_base[k]) for k in (0, -1))
    way, expected = first.inverse() @ last, SE2.from_matrix(own.T_session_base[-1])
    # The heading of the world stays its own: only motions can be compared.
    assert (way.x, way.y, way.yaw) == pytest.approx((expected.x, expected.y, expected.yaw))
    assert np.allclose(levelled(own, []).T_session_base, own.T_session_base)


def test_known_ground_is_known_a_little_behind_walls() -> None:
    cells = np.full((20, 20), -1, np.int8)
    cells[:, :10] = 0
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    points = np.array([(0.1, 0.5), (0.6, 0.5), (0.9, 0.5), (9.0, 9.0)])
    assert known_share(grid, points) == 0.5
    assert known_share(grid, np.empty((0, 2))) == 0.0
