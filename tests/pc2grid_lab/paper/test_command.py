"""`pc2grid compare paper`: cells, resuming, tables, JSON, pictures."""

import json
import re
from dataclasses import replace
from functools import partialmethod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from pc2grid.errors import ConfigError, MapFileError
from pc2grid.io.maps import save_map
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.submaps import partition
from pc2grid_cli import console
from pc2grid_cli.main import app
from pc2grid_lab.paper import experiment
from pc2grid_lab.paper.experiment import (
    NOISE_LEVELS,
    BestMatches,
    Experiment,
    MatchMeasures,
    draw_queries,
    evaluate,
)
from pc2grid_lab.paper.methods import ABLATION, DistanceFeatures, make_methods
from pc2grid_lab.paper.tables import (
    MAPS,
    TABLE_3,
    TABLE_4,
    _cell,
    computed_cells,
    paper_tasks,
    read_map,
    that_share_submaps,
)
from tests.helpers.rooms import cross, grid_of, l_shape, rectangle

COMPARE = ("compare", "paper")
runner = CliRunner()


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    save_map(grid_of(np.hstack([cross(6.0, 2.0), rectangle(8.0, 5.0), l_shape()])), folder / "intel")
    return folder


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intervals take most of the time of a small run; one test below looks at them."""
    monkeypatch.setattr(BestMatches, "half_widths", partialmethod(BestMatches.half_widths, resamples=4))


def compare(maps: Path, out: Path, words: str) -> Result:
    where = ("--maps", str(maps), "--out", str(out), "--jobs", "1")
    return runner.invoke(app, [*COMPARE, *where, *words.split()])


def test_published_tables_are_whole() -> None:
    assert all(set(row) == set(MAPS) for level in TABLE_3 for row in level.values())
    assert [len(level) for level in TABLE_3] == [7, 7, 7]
    # The row for 8 m of Table IV is the proposed method's row at noise level 1 of Table III.
    assert TABLE_4[8] == TABLE_3[1]["proposed"]
    assert TABLE_3[2]["sdf"]["killian"] == (0.531, 0.218, 0.456)


def test_a_run_writes_its_cells_and_the_next_one_only_reads_them(
    maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_LINE_EVERY_S", 0.0)
    words = "--queries 4 --offset 0.5 --methods proposed --methods as_used_here"
    first = compare(maps, tmp_path, words)
    assert first.exit_code == 0, first.output
    assert re.search(r"^pc2grid: \d+ cells of the tables: \d+%", first.stderr, re.MULTILINE)
    document = json.loads((tmp_path / "results.json").read_text())
    assert len(document["cells"]) == 10  # 2 methods x (3 levels, and 2 radii)
    assert {c["published"]["auc"] for c in document["cells"] if c["radius_m"] == 6.0} == {0.935}
    assert [c["published"]["auc"] for c in document["cells"] if c["level"] == 2] == [0.955, 0.955]
    assert (tmp_path / "figure-9-offset-0.5.png").read_bytes().startswith(b"\x89PNG")
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").rglob("*.pickle")}
    second = compare(maps, tmp_path, words)
    assert second.exit_code == 0, second.output
    assert len(written) == 10
    assert written == {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").rglob("*.pickle")}
    # Of the one map and of the mean: AUC of the paper, ours, the difference, its interval; R@1 is not in the
    # paper.
    of_auc, of_right = r"965 +\d+ +[-+]\d+ \+-\d+", r"\d+ \+-\d+"
    for measure, cell in (("AUC", of_auc), ("R@1", of_right)):
        row = rf"^ *0 +{measure} +proposed +{cell} +{cell} *$"
        assert re.search(row, second.stdout, re.MULTILINE), (measure, second.stdout)


def test_the_tables_answer_one_question_after_the_other(maps: Path, tmp_path: Path) -> None:
    words = "--queries 3 --offset 1.0 --ablation"
    for method in ("unlearned", "proposed_ln_bc", "sdf", "proposed"):
        words += f" --methods {method}"
    shown = compare(maps, tmp_path, words).stdout
    titles = ["does it hold", "Table IV", "its rivals", "What beats it", "What each signature adds"]
    assert sorted(titles, key=shown.index) == titles
    parts = re.split("|".join(titles), shown)
    for part, methods in zip(parts[1:4], ({"proposed", "proposed_ln_bc"},) * 2 + ({"sdf"},), strict=True):
        assert set(re.findall(r"AUC +(\w+)", part)) == methods
    assert set(re.findall(r"AUC +(\w+) +965", parts[4])) == {"unlearned"}


def test_of_several_maps_the_mean_difference_has_a_narrower_interval(maps: Path, tmp_path: Path) -> None:
    """By independence: of n equal maps the interval of the mean is that of one by the root of n."""
    (task,) = [
        t
        for t in paper_tasks([maps / "intel.yaml"], methods=["unlearned"], offsets_m=[1.0], queries=4, seed=1)
        if t.level == 0
    ]
    (cell,) = computed_cells([task], tmp_path)
    half = MatchMeasures(0.02, 0.02, 0.02, 0.02)
    cells = [
        replace(cell, task=replace(task, map_path=Path(f"{name}.yaml")), half_widths=half)
        for name in ("fr079", "intel", "csail", "aces")
    ]
    mean_auc = 1000 * np.mean([TABLE_3[0]["proposed"][cell.task.map_name].auc for cell in cells])
    ours = 1000 * cell.measures.auc
    expected = [f"{mean_auc:.0f}", f"{ours:.0f}", f"{ours - mean_auc:+.0f}", "+-10"]
    assert _cell(cells, "auc").split() == expected


def test_queries_are_drawn_once_a_level_and_databases_fitted_once(
    maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the matches are those of each method, fitted to the map again and asked alone."""
    tasks = list(
        paper_tasks([maps / "intel.yaml"], methods=["proposed", "sdf"], offsets_m=[1.0], queries=4, seed=1)
    )
    groups = that_share_submaps(tasks)
    assert sorted(map(len, groups)) == [1, 1, 6]  # 6 and 10 m; 2 methods at 3 levels
    fitted, drawn = [], []

    def drawing(*arguments: Any) -> Any:
        drawn.append(arguments)
        return draw_queries(*arguments)

    def fitting(self: DistanceFeatures, submaps: Any) -> Any:
        fitted.append(self)
        return fit(self, submaps)

    fit = DistanceFeatures.__call__
    with monkeypatch.context() as patched:
        patched.setattr(experiment, "draw_queries", drawing)
        patched.setattr(DistanceFeatures, "__call__", fitting)
        found = computed_cells(groups[0], tmp_path)
    assert (len(fitted), len(drawn)) == (1, 3)
    grid = read_map(maps / "intel.yaml")
    submaps = partition(grid, PartitionConfig.paper())
    for cell in found:
        name, level = cell.task.method, NOISE_LEVELS[cell.task.level]
        alone = evaluate(make_methods([name]), grid, submaps, Experiment(queries=4), level)[name]
        assert np.array_equal(cell.matches.similarity, alone.similarity)
        assert np.array_equal(cell.matches.correct, alone.correct)


def test_the_ablation_and_any_floor(tmp_path: Path) -> None:
    """A floor that the paper does not have gets its own column, without published figures."""
    save_map(grid_of(np.hstack([cross(6.0, 2.0), rectangle(8.0, 5.0)])), tmp_path / "depot")
    words = "--queries 3 --offset 1.0 --methods proposed --ablation"
    run = compare(tmp_path / "depot.yaml", tmp_path / "out", words)
    assert run.exit_code == 0, run.output
    assert "depot" in run.stdout and "boundary_alone" in run.stdout and "R@1" in run.stdout
    cells = json.loads((tmp_path / "out" / "results.json").read_text())["cells"]
    assert {cell["published"] for cell in cells} == {None}
    assert len(cells) == 3 + 2 + 3 * len(ABLATION)


def test_intervals_shrink_with_more_queries() -> None:
    rng = np.random.default_rng(4)
    widths = []
    for count in (100, 1600):
        correct = rng.random(count) < 0.8
        half = BestMatches(similarity=rng.normal(correct, 0.7), correct=correct).half_widths(resamples=300)
        assert 0.0 < half.auc < 0.1
        widths.append(half.r_at_1)
    # A share of n draws has the standard deviation sqrt(p (1 - p) / n): a quarter with 16 times as many.
    assert 3.0 < widths[0] / widths[1] < 5.3
    assert abs(widths[0] - 1.645 * np.sqrt(0.8 * 0.2 / 100)) < 0.02


@pytest.mark.parametrize(
    ("options", "kind", "words"),
    [
        (["--methods", "orb"], ConfigError, "orb"),
        (["--offset", "-1"], ConfigError, "above 0"),
        (["--maps", "."], MapFileError, "no map is here"),
    ],
)
def test_wrong_arguments_say_what_is_wrong(
    options: list[str], kind: type[Exception], words: str, maps: Path, tmp_path: Path
) -> None:
    error = runner.invoke(app, [*COMPARE, "--maps", str(maps), "--out", str(tmp_path), *options]).exception
    assert isinstance(error, kind) and words in str(error)
