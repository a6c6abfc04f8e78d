"""What is kept of the commands of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pc2grid_lab.recordings import run
from pc2grid_lab.runner import Finished, Task, kept_result, run_tasks
from tests.helpers.recordings import ros, write_mcap


@pytest.mark.parametrize(("code", "is_kept"), [(0, True), (1, True), (-11, True), (130, False), (143, False)])
def test_a_command_that_was_stopped_is_done_by_the_next_run(tmp_path: Path, code: int, is_kept: bool) -> None:
    """A crash is a result; somebody who ends the program is none."""
    done = Finished(code=code, cpu_s=1.0, document=None)
    file, told = tmp_path / "answers" / "a.json", list[float]()
    run_tasks([Task(file, lambda: done, 0.0)], 1, told.append)
    assert told == [1]
    assert (kept_result(file) is not None) == is_kept


def test_a_disturbed_recording_has_other_last_bits(tmp_path: Path) -> None:
    """Points are moved by at most 1e-5 m; stamps and other messages stay as they are."""
    encoder, source, target = ros(), tmp_path / "a.mcap", tmp_path / "b.mcap"
    cloud = np.random.default_rng(0).uniform(-5.0, 5.0, (50, 3))
    drive = [
        encoder.tf(1, "odom", "base", 0.5),
        encoder.odometry("/odom", 2, 1.0),
        encoder.cloud("/points", 3, cloud),
        encoder.camera("/info", 4, 3, 3, 500.0),
    ]
    run.write_disturbed(write_mcap(source, drive), target, 1)
    before, after = (list(run.stored_messages(path)) for path in (source, target))
    assert [m.log_time_ns for m in after] == [1, 2, 3, 4]
    assert [m.data for m in after[:2]] == [m.data for m in before[:2]]
    points, camera = (
        np.array([read(encoder.store.deserialize_cdr(m[k].data, m[k].schema.name)) for m in (before, after)])
        for k, read in (
            (2, lambda content: content.data.view(np.float32)),
            (3, lambda content: np.array((content.k[0], content.p[0])) / 500.0),
        )
    )
    for pair in (points, camera):
        assert 0.0 < np.abs(pair[0] - pair[1]).max() < 1.1e-5
