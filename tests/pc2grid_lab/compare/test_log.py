"""`pc2grid compare log`: which parts of a recording become the map and the queries."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from typer.testing import CliRunner

from pc2grid.errors import ConfigError
from pc2grid.time_span import TimeSpan
from pc2grid_cli.main import app
from pc2grid_lab.compare import log as compare_log
from pc2grid_lab.compare import matrix_report
from pc2grid_lab.experiments.trial import Trial
from tests.helpers.recordings import STEP, T0, ros, write_mcap
from tests.helpers.trials import trial


class RecordedReplay:
    """In place of `Replay`: keeps what it is asked, and knows no truth."""

    spans: ClassVar[list[TimeSpan]] = []
    trials: ClassVar[list[Trial]] = []
    up = "z"

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def map(self, span: TimeSpan, _: Any) -> Any:
        self.spans.append(span)
        return SimpleNamespace(warnings=("it is bent",))

    def locate(self, span: TimeSpan, _: Any) -> Trial | None:
        self.spans.append(span)
        return self.trials.pop() if self.trials else None


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of 17.5 s, with its truth."""
    monkeypatch.setattr(compare_log, "Replay", RecordedReplay)
    RecordedReplay.spans = []
    (tmp_path / "a.tum").write_text("1 0 0 0 0 0 0 1\n")
    (tmp_path / "a.relations").write_text("5 6 1 0 0 0 0 0\n")
    return write_mcap(
        tmp_path / "a.mcap", [ros().laser("/scan", T0 + i * STEP, [1.0] * 10) for i in range(176)]
    )


def compare(log: Path, *options: str, truth: str = "a.tum") -> Any:
    arguments = ["compare", "log", str(log), "--truth", str(log.with_name(truth)), "--json", *options]
    return CliRunner().invoke(app, arguments)


def test_the_default_fits_the_length_of_the_log(log: Path) -> None:
    done = compare(log, "--queries", "2")
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["map_s"] == pytest.approx([0.0, 8.75])
    assert document["length_s"] == pytest.approx(4.375)
    assert [(s.start_s, s.duration_s) for s in RecordedReplay.spans] == [
        pytest.approx(pair) for pair in ((0.0, 8.75), (8.75, 4.375), (13.125, 4.375))
    ]
    assert "map: 0.0..8.8 s; queries last 4.4 s" in done.stderr
    assert "warning: map: it is bent" in done.stderr and "points up" not in done.stderr


def test_each_row_says_what_it_counts_as_and_the_sums_agree(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row that is 5 cm off may lie outside of the map, and is not among those that had a right answer."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(RecordedReplay, "up", "-y")
    RecordedReplay.trials = [
        trial(seed=1),
        trial(seed=2, right=False),
        trial(seed=3, status="ambiguous"),
        trial(seed=4, mapped=0.1, status="not_found", right=False),
        trial(seed=5, mapped=0.1, right=False),
        trial(seed=6, mapped=0.4),
    ]
    words = ["compare", "log", str(log), "--truth", str(log.with_name("a.tum")), "--queries", "6"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    text = " ".join(done.stdout.split())
    rows = ["right", "wrong", "no answer", "outside, no answer", "outside, wrong", "outside, right"]
    for seed, (verdict, status) in enumerate(
        zip(rows, ["located", "located", "ambiguous", "not found", "located", "located"], strict=True),
        start=1,
    ):
        assert f"{seed} s {status} {verdict} 10.0 m" in text
    assert (
        "inside, where the map covers 0.50 or more of what the query saw: 1 of 3 located and right, 0.33,"
        " 1 wrong, 1 without an answer"
    ) in text
    assert "outside, where the map covers less than 0.50 of it and no answer is the right one:" in text
    assert (
        "1 of 3 without an answer, 1 located and wrong, 1 located and right all the same, at its edge" in text
    )
    assert "as it should be" not in text
    assert "warning: a.tum: -y points up in it" in done.stderr


def test_a_map_that_leaves_nothing_to_locate_is_refused_before_any_work(log: Path) -> None:
    error = compare(log, "--map", "0..600").exception
    assert isinstance(error, ConfigError)
    assert error.message == "--map 0..600: nothing is left to locate, the log lasts 17.5 s"
    assert error.hint == "for example --map 0..9"
    assert RecordedReplay.spans == []


def test_relations_are_not_taken_for_poses(log: Path) -> None:
    error = compare(log, truth="a.relations").exception
    assert isinstance(error, ConfigError) and "relations between poses" in error.message
    assert error.hint is not None and "compare maps" in error.hint


def test_all_nine_cells_of_the_matrix_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    matrix_report.tables([], [])
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    sensors = ("lidar", "laser", "depth")
    assert [row[:2] for row in rows if row[-1:] == ["0"]] == [[m, q] for m in sensors for q in sensors]
