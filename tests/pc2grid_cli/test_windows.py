"""`pc2grid relocalize` of several recordings, and of windows along them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import pytest
from click.testing import Result
from typer.testing import CliRunner

from pc2grid.errors import ConfigError
from pc2grid.io import open_log
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.json_schemas import schema
from pc2grid_cli.main import app
from signature.localization.map_index import MapIndex
from tests.helpers.json_schema import closed
from tests.helpers.simulated_drives import office


@pytest.fixture(scope="module")
def folder(office_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The office, and a.mcap and b.mcap of a laser that drives in it."""
    folder = shutil.copytree(office_folder, tmp_path_factory.mktemp("windows"), dirs_exist_ok=True)
    for name, seed in (("a", 3), ("b", 5)):
        config = SimulationConfig(length_m=4.0, seed=seed, clutter=0)
        simulate_session(folder / f"{name}.mcap", sensor="laser", grid=office(), config=config)
    (folder / "text.mcap").write_text("no recording")
    return folder


def run(*words: object, code: int = 0) -> Result:
    done = CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done


def relocalize(folder: Path, names: str, *words: object, code: int = 0) -> Result:
    logs = [folder / name for name in names.split()]
    return run("relocalize", *logs, "-d", folder / "b.submaps", *words, code=code)


def documents(done: Result) -> list[Any]:
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_several_recordings_are_answered_as_one_is(folder: Path) -> None:
    together = documents(relocalize(folder, "a.mcap b.mcap", "--json"))
    assert [document["query"]["source"] for document in together] == ["a.mcap", "b.mcap"]
    for document in together:
        jsonschema.validate(document, closed(schema("relocalize")))
        alone = json.loads(relocalize(folder, document["query"]["source"], "--json").stdout)
        assert document["pose"] == alone["pose"] and document["confidence"] == alone["confidence"]


def test_windows_along_a_recording_are_located_by_one_index(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, index_of = [], MapIndex.of
    monkeypatch.setattr(MapIndex, "of", lambda *given: made.append(given) or index_of(*given))
    words = ("--start", 1, "--every", 2, "--duration", 3, "--plot", tmp_path / "all.png", "--json")
    answers = documents(relocalize(folder, "a.mcap", *words))
    assert len(made) == 1 and len(answers) > 1
    with open_log(folder / "a.mcap") as log:
        start_ns, end_s = log.info.start_ns, (log.info.end_ns - log.info.start_ns) * 1e-9
    assert [answer["query"]["start_s"] for answer in answers] == [1.0 + 2.0 * k for k in range(len(answers))]
    for answer in answers:
        until_s = answer["query"]["start_s"] + answer["query"]["duration_s"]
        assert until_s <= end_s
        assert (answer["query"]["stamp_ns"] - start_ns) * 1e-9 == pytest.approx(until_s, abs=0.3)
    assert cv2.imread(str(tmp_path / "all.png")) is not None


def test_a_person_gets_a_line_for_each_window(folder: Path) -> None:
    text = relocalize(folder, "a.mcap office.yaml").stdout
    assert text.startswith("2 queries: 2 located")
    assert text.count("a.mcap") == 1 and text.count("office.yaml") == 1


def test_exit_code_4_if_none_is_located(folder: Path) -> None:
    done = relocalize(folder, "a.mcap a.mcap", "--set", "relocalize.accept=0.9999999", code=4)
    assert "2 queries: 2 ambiguous" in done.stdout or "not found" in done.stdout


def test_others_go_on_if_a_recording_cannot_be_read(folder: Path) -> None:
    done = relocalize(folder, "text.mcap a.mcap", code=3)
    assert "failed" in done.stdout and "located" in done.stdout
    assert "text.mcap" in done.stderr
    relocalize(folder, "text.mcap text.mcap", code=1)


@pytest.mark.parametrize(
    ("names", "words", "said"),
    [
        ("a.mcap b.mcap", ("--report", "out.html"), "--report"),
        ("a.mcap", ("--every", 3, "--trajectory", "out.tum"), "--trajectory"),
        ("a.mcap", ("--every", 3, "--check", 1, 1, 0), "--check"),
        ("office.yaml", ("--every", 3), "--every"),
    ],
)
def test_what_is_of_one_query_is_refused(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: str, words: Any, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=said):
        relocalize(folder, names, *words)
