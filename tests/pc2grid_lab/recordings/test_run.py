"""What is kept of the commands of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from pc2grid_lab.runner import Finished, Task, kept_result, run_tasks


@pytest.mark.parametrize(("code", "is_kept"), [(0, True), (1, True), (-11, True), (130, False), (143, False)])
def test_a_command_that_was_stopped_is_done_by_the_next_run(tmp_path: Path, code: int, is_kept: bool) -> None:
    """A crash is a result; somebody who ends the program is none."""
    done = Finished(code=code, cpu_s=1.0, document=None)
    file, told = tmp_path / "answers" / "a.json", list[float]()
    run_tasks([Task(file, lambda: done, 0.0)], 1, told.append)
    assert told == [1]
    assert (kept_result(file) is not None) == is_kept
