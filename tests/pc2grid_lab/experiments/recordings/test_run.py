"""What is kept of the commands of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from pc2grid.observer import TimeSpan
from pc2grid_lab.experiments.recordings import run
from pc2grid_lab.experiments.recordings.catalogue import Catalogue
from pc2grid_lab.experiments.recordings.run import Finished, Folder, Task, _locate, _run, kept


@pytest.mark.parametrize(("code", "is_kept"), [(0, True), (1, True), (-11, True), (130, False), (143, False)])
def test_a_command_that_was_stopped_is_done_by_the_next_run(tmp_path: Path, code: int, is_kept: bool) -> None:
    """A crash is a result; somebody who ends the program is none."""
    done = Finished(code=code, cpu_s=1.0, document=None)
    file, told = tmp_path / "answers" / "a.json", list[float]()
    _run([Task(file, lambda: done, 0.0)], 1, told.append)
    assert told == [1]
    assert (kept(file) is not None) == is_kept


def test_a_control_asks_with_another_shortlist_and_is_kept_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    catalogue, asked = Catalogue.of(), []
    monkeypatch.setattr(run, "pc2grid", lambda *arguments: asked.append(arguments))
    pair, window = catalogue.pairs[0], TimeSpan(1.0, 2.0)
    tasks = []
    for by in ("signatures", "shuffled", "random"):
        folder = Folder(tmp_path, tmp_path, by)  # type: ignore[arg-type]
        tasks.append(_locate(folder, catalogue.recordings[pair.query], pair, window))
        tasks[-1].do()
        assert f"relocalize.shortlist_by={by}" in asked[-1]
    assert len({task.file for task in tasks}) == 3
