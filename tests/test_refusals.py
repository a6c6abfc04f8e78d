"""What the parts refuse, and with which words; what is left alone."""

from __future__ import annotations

import fcntl
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import ClusterError, ConfigError
from pc2grid.geometry import SE2, hand_over
from pc2grid.io.atomic import replace_file
from pc2grid.model import Health, Loop, OccupancyGrid, Scan, SessionMap, Trajectory
from pc2grid.settings import load_settings
from pc2grid_lab.truth import read_relations, relation_error
from signature.config import Config
from signature.paper import Signature, SignatureTable
from signature.retrieval.places import LazySequence

GRID = OccupancyGrid(cells=np.zeros((2, 2)), resolution_m=0.05, origin_m=(0.0, 0.0))
STILL = Trajectory(stamps_ns=np.arange(3), T_session_base=np.stack([np.eye(4)] * 3))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: Scan(stamp_ns=0, points_m=np.ones((5, 2)), T_base_sensor=np.eye(4), sensor="lidar"),
            r"Scan\.points_m: expected shape \('N', 3\), got \(5, 2\)",
        ),
        (
            lambda: Trajectory(stamps_ns=np.arange(3), T_session_base=np.stack([np.eye(4)] * 2)),
            r"Trajectory\.T_session_base: expected shape \(3, 4, 4\), got \(2, 4, 4\)",
        ),
        (
            lambda: Trajectory(
                stamps_ns=STILL.stamps_ns, T_session_base=STILL.T_session_base, health=(Health.FINE,)
            ),
            r"Trajectory\.health: expected 3 entries, got 1",
        ),
        (
            lambda: OccupancyGrid(cells=np.zeros((2, 2)), resolution_m=math.nan, origin_m=(0.0, 0.0)),
            r"OccupancyGrid\.resolution_m: expected > 0, got nan",
        ),
        (
            lambda: SessionMap(
                session="a",
                sensor="map",
                grid=GRID,
                submaps=(),
                trajectory=STILL,
                loops=(Loop(older=1, newer=3, T_older_newer=SE2(), information=np.eye(3)),),
            ),
            r"SessionMap\.loops: expected poses of 0\.\.2, got 1 and 3",
        ),
        (
            lambda: Signature(boundary=np.ones((1, 3)), freespace=np.ones(3), symmetry=np.ones(2)),
            r"Signature\.boundary: expected shape \('N',\), got \(1, 3\)",
        ),
        (
            lambda: SignatureTable.of((), np.empty((0, 2)), submap_id=[1]),
            r"SignatureTable\.submap_id: expected 0 entries",
        ),
    ],
)
def test_values_that_do_not_fit_together(make: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_other_code_cannot_change_the_arrays_of_a_frozen_type() -> None:
    points = np.ones((5, 3), np.float32)
    shown = points.view()
    shown.flags.writeable = False
    for given in (points, points[::-1], shown, memoryview(points)):
        scan = Scan(stamp_ns=0, points_m=np.asarray(given), T_base_sensor=np.eye(4), sensor="lidar")
        with pytest.raises(ValueError, match="read-only"):
            scan.points_m[0] = 2.0
        points[:] += 1.0
        assert np.ptp(scan.points_m) == 0.0 and scan.points_m[0, 0] == points[0, 0] - 1.0
    again = replace(scan, stamp_ns=1)
    assert again.points_m is scan.points_m  # nobody can write to it: no need for a copy
    mine = hand_over(np.zeros((2, 2), np.int8))
    assert OccupancyGrid(cells=mine, resolution_m=0.05, origin_m=(0.0, 0.0)).cells is mine
    from_bytes = np.frombuffer(bytes(4), np.int8).reshape(2, 2)
    assert OccupancyGrid(cells=from_bytes, resolution_m=0.05, origin_m=(0.0, 0.0)).cells is from_bytes


def test_settings_that_cannot_be_read(tmp_path: Path) -> None:
    for name, words in (("none.toml", "no such file"), (".", "cannot be read: Is a directory")):
        with pytest.raises(ConfigError, match=words):
            load_settings(Config, tmp_path / name)
    (tmp_path / "a.toml").write_bytes(b"[read]\ntopic = '\xff'\n")
    with pytest.raises(ConfigError, match=r"a\.toml: not TOML"):
        load_settings(Config, tmp_path / "a.toml")
    assert load_settings(Config, environment={}) == Config()


def test_what_a_killed_writer_left_is_swept_and_nothing_else(tmp_path: Path) -> None:
    swept = [".a.pc2grid-0123abcd.tmp", ".a.pc2grid-1.tmp"]
    kept = [
        ".a.pc2grid-fedc9876.tmp",  # somebody is at it
        ".a.pc2grid-x.tmp",
        ".a.pc2grid-0123abcd",
        ".b.pc2grid-0123abcd.tmp",
        ".a.pc2grid-00.tmp",  # a link to somebody's file
    ]
    for name in (*swept, *kept[:-1]):
        (tmp_path / name).touch()
    (tmp_path / kept[-1]).symlink_to(kept[0])
    with (tmp_path / kept[0]).open() as busy, replace_file(tmp_path / "b") as other:
        other.write_text("b")
        fcntl.flock(busy, fcntl.LOCK_EX)
        for content in ("new", "newer"):
            with replace_file(tmp_path / "a") as temporary:
                temporary.write_text(content)
            assert (tmp_path / "a").read_text() == content
    (tmp_path / "b").unlink()
    kept.remove(".b.pc2grid-0123abcd.tmp")  # by the writer of b
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(["a", *kept])


def test_a_lost_worker_ends_all_and_what_is_stored_stays(tmp_path: Path) -> None:
    from signature.conversion_jobs import Job, _outcome

    def result() -> None:
        raise OSError("closed")

    job = Job(path=tmp_path / "a.mcap", name="a", config=Config())
    with pytest.raises(
        ClusterError, match=r"a worker was lost; .*a\.mcap and what follows it is not stored: OSError"
    ) as caught:
        _outcome(job, SimpleNamespace(result=result))
    assert caught.value.hint is not None and "the same command continues" in caught.value.hint


def test_relations_that_a_trajectory_says_nothing_of(tmp_path: Path) -> None:
    (tmp_path / "a.relations").write_text("# t1 t2 x y z roll pitch yaw\n\n5 6 1 0 0 0 0 0\n")
    relations = read_relations(tmp_path / "a.relations")
    nothing = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
    for trajectory in (STILL, nothing):
        error = relation_error(trajectory, relations)
        assert (error.used, error.total) == (0, 1)
        assert math.isnan(error.translation_m) and math.isnan(error.rotation_deg)


def test_things_made_lazily_are_made_once_and_only_when_asked_for() -> None:
    made: list[int] = []
    things = LazySequence(lambda i: made.append(i) or i * i, 10)
    assert len(things) == 10 and made == []
    assert (things[-1], things[2:5], things[9]) == (81, (4, 9, 16), 81)
    assert made == [9, 2, 3, 4]
    with pytest.raises(IndexError):
        things[10]
