"""A recording cut into a map and queries, which are judged by the true poses."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.io.sensors.depth import T_BODY_OPTICAL
from pc2grid.io.trajectory import read_tum, write_tum
from pc2grid.model import Trajectory
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid.time_span import TimeSpan
from pc2grid_lab.compare import log as compare_log
from pc2grid_lab.experiments.metrics import QueryCounts
from pc2grid_lab.experiments.replay import MappedPart, Replay, evenly_spaced, with_z_up
from pc2grid_lab.experiments.sensor_map import SensorMap
from signature.config import Config
from tests.helpers.simulated_drives import office
from tests.helpers.trials import trial


def test_parts_are_spread_over_the_time_left() -> None:
    spans = evenly_spaced(600.0, 1060.0, 10, 40.0)
    assert [span.start_s for span in spans[:2]] == pytest.approx([600.0, 600.0 + 420.0 / 9])
    assert {span.duration_s for span in spans} == {40.0} and spans[-1].start_s == pytest.approx(1020.0)
    assert len({span.start_s for span in evenly_spaced(100.0, 110.0, 3, 40.0)}) == 1


def test_queries_outside_the_map_are_counted_separately() -> None:
    trials = [
        trial(),
        trial(right=False),
        trial(status="ambiguous"),
        trial(mapped=0.1, status="not_found", right=False),
        trial(mapped=0.1, right=False),
        trial(mapped=0.4),
    ]
    assert QueryCounts.of(trials) == QueryCounts(
        inside=3, right=1, wrong=1, unsure=1, outside=3, refused=1, wrong_outside=1
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A laser goes around a small office, 30 m."""
    folder = tmp_path_factory.mktemp("recorded")
    slow: dict[str, Any] = {"laser": {"rate_hz": 4.0}, "length_m": 30.0, "seed": 3, "clutter": 4}
    simulate_session(
        folder / "round.mcap",
        sensor="laser",
        grid=office(),
        config=SimulationConfig.model_validate(slow),
    )
    return folder


def test_later_parts_are_located_in_the_map_of_the_earlier(recorded: Path) -> None:
    with open_log(recorded / "round.mcap", Config().read) as log:
        replay = Replay(log, read_tum(recorded / "round.tum"), Config(), of_base=True)
        end_s = (log.info.end_ns - log.info.start_ns) * 1e-9
        part = replay.map(TimeSpan(0.0, 0.8 * end_s))
        found = replay.locate(TimeSpan(0.82 * end_s, 0.18 * end_s), part)
    assert found is not None and found.mapped > 0.8
    assert found.status == "located" and found.right
    assert found.error_m is not None and found.error_m < 0.15
    assert found.map_bent_m is not None and found.map_bent_m < 0.05


@pytest.mark.parametrize("up", ["y", "-y", "x", "-x"])
def test_a_truth_in_another_world_gives_the_same_poses(recorded: Path, up: str) -> None:
    """With y up, as phones record it, and with y down, as cameras do; in any heading."""
    truth = read_tum(recorded / "round.tum")
    axis, sign = "xyz".index(up[-1]), -1.0 if up[0] == "-" else 1.0
    other = np.eye(4)
    other[:3, 2] = sign * np.eye(3)[axis]  # where z comes to lie
    other[:3, 0] = np.eye(3)[(axis + 1) % 3]
    other[:3, 1] = np.cross(other[:3, 2], other[:3, 0])
    turned = Trajectory(stamps_ns=truth.stamps_ns, T_session_base=other @ truth.T_session_base)
    with open_log(recorded / "round.mcap", Config().read) as log:
        replays = [Replay(log, poses, Config(), of_base=True) for poses in (truth, turned)]
    assert [replay.up for replay in replays] == ["z", up]
    first = [replay.truth(int(truth.stamps_ns[0])) for replay in replays]
    for stamp_ns in truth.stamps_ns[::20].tolist():
        now = [replay.truth(stamp_ns) for replay in replays]
        a, b = (begin.inverse() @ pose for begin, pose in zip(first, now, strict=True))
        assert (a.x, a.y, a.yaw) == pytest.approx((b.x, b.y, b.yaw), abs=1e-6)


def test_the_poses_of_a_camera_are_turned_by_its_own_axes() -> None:
    """Its world is its first frame, z forward and y down; the base is level in it."""
    to_the_right = np.eye(4)
    to_the_right[:3, 3] = 1.0, 0.0, 2.0  # 2 m forward, 1 m to the right
    truth = Trajectory(stamps_ns=np.arange(2), T_session_base=np.stack([np.eye(4), to_the_right]))
    turned, up = with_z_up(truth, T_BODY_OPTICAL)
    assert up == "-y"
    base = [
        SE2.from_matrix(pose) @ SE2.from_matrix(T_BODY_OPTICAL).inverse() for pose in turned.T_session_base
    ]
    ahead = base[0].inverse() @ base[1]
    assert (ahead.x, ahead.y, ahead.yaw) == pytest.approx((2.0, -1.0, 0.0), abs=1e-9)
    assert with_z_up(truth, np.eye(4)) == (truth, "z")


def test_an_answer_is_judged_by_the_map_around_it() -> None:
    """A map that is bent by 1 m from end to end, and exact around each place."""
    true_xy = np.column_stack((np.linspace(0.0, 100.0, 401), np.zeros(401)))
    mapped_xy = true_xy + np.column_stack((np.zeros(401), (true_xy[:, 0] / 100.0) ** 2))
    whole = SE2.fit(mapped_xy, true_xy)
    index: Any = None
    part = MappedPart(
        SensorMap(name="bent", sensor="laser", T_plan_map=whole, index=index), mapped_xy, true_xy
    )
    end = SE2(100.0, 0.0, 0.0)
    T_map_base = part.around(end).T_plan_map.inverse() @ end
    assert abs(T_map_base.y - 1.0) < 0.02 and abs(T_map_base.x - 100.0) < 0.02
    assert abs((whole.inverse() @ end).y - 1.0) > 0.1
    assert part.bent_m(end) > 0.1
    assert part.around(SE2(50.0, 60.0, 0.0)) is part.sensor_map  # no scan of the map is near


def test_without_truth_nothing_is_judged(recorded: Path, tmp_path: Path) -> None:
    truth = read_tum(recorded / "round.tum")
    late = Trajectory(stamps_ns=truth.stamps_ns + 10**12, T_session_base=truth.T_session_base)
    write_tum(tmp_path / "late.tum", late)
    with open_log(recorded / "round.mcap", Config().read) as log:
        replay = Replay(log, read_tum(tmp_path / "late.tum"), Config(), of_base=True)
        assert replay.truth(int(truth.stamps_ns[0])) is None
        with pytest.raises(ConfigError, match="no poses at the stamps"):
            replay.map(TimeSpan(0.0, 3.0))


@pytest.mark.parametrize("text", ["600", "0..x", "50..50", "-5..10"])
def test_a_text_that_is_not_a_span_of_seconds_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=f"--map {text}"):
        compare_log._seconds(text)


def test_a_trial_consists_of_plain_json_types() -> None:
    stored = json.loads(json.dumps(asdict(trial(error_m=None))))
    assert trial(**stored) == trial(error_m=None)
