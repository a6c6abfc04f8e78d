"""From file to file: what is refused before any work, and what a notebook gets back."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import pc2grid
from pc2grid.display import CENTRE_GREEN
from pc2grid.errors import ConfigError, DatabaseError, OutputError
from pc2grid.geometry import SE2
from pc2grid.io.maps import save_map
from pc2grid.matching.score import Fit
from pc2grid.model import OccupancyGrid
from pc2grid.observer import Observer
from pc2grid.settings import ReadConfig
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from signature.database import Label, open_database
from signature.database.maintenance import store
from signature.localization.answer import Answer
from signature.localization.hypotheses import Hypothesis
from signature.localization.posterior import NO_EVIDENCE
from signature.sessions import convert, query_config, relocalize
from tests.helpers.databases import make_entry
from tests.helpers.shared_folders import shared_folder
from tests.helpers.simulated_drives import cut, office


def names(path: Path) -> list[str]:
    with open_database(path) as database:
        return [session.name for session in database.sessions()]


@shared_folder()
def building(folder: Path) -> None:
    """The folder of an office plan, a part of it, and the database of the plan."""
    save_map(office(), folder / "plan")
    save_map(cut(office(), 4.0, 3.0, 15.0, 12.0), folder / "part")
    made = convert(folder / "plan.yaml", folder / "plan.submaps", label=Label(floor="2"))
    assert (made.session, made.sensor) == ("plan", "map") and len(made.submaps) > 10


def test_a_map_is_found_in_a_map(building: Path) -> None:
    answer = relocalize(building / "part.yaml", building / "plan.submaps")
    assert answer.status == "located" and answer.label.floor == "2"
    assert answer.T_map_base is not None
    assert (round(answer.T_map_base.x, 1), round(answer.T_map_base.y, 1)) == (4.0, 3.0)
    picture = answer._repr_png_()
    assert picture is not None and "data:image/png" in answer._repr_html_()
    image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR).astype(int)
    green = np.argwhere(np.abs(image - CENTRE_GREEN).max(axis=2) < 8)
    height, width = image.shape[:2]
    # The part that was asked for is 11 m x 9 m of the office, of 20 m x 15 m.
    assert 0.3 < np.ptp(green[:, 0]) / height < 0.8 and 0.3 < np.ptp(green[:, 1]) / width < 0.8


def test_what_is_doubted_of_a_map_is_said_to_who_looks_in_it(building: Path, tmp_path: Path) -> None:
    save_map(replace(office(), cells=np.where(office().occupied, 0, office().cells)), tmp_path / "empty")
    said: list[str] = []

    class Told(Observer):
        def on_warning(self, text: str) -> None:
            said.append(text)

    answer = relocalize(building / "part.yaml", tmp_path / "empty.yaml", observer=Told())
    assert answer.status == "not_found"
    assert len(said) == 1 and "empty.yaml: no cell is occupied" in said[0]


def test_an_answer_is_drawn_saved_and_shown_as_a_page(building: Path, tmp_path: Path) -> None:
    answer = relocalize(building / "part.yaml", building / "plan.submaps")
    figure = answer.plot()
    assert "located in plan" in figure.axes[0].get_title(loc="left")
    formatters = pytest.importorskip("IPython.core.formatters", reason="open3d brings it")
    shown, _ = formatters.DisplayFormatter().format(figure)
    assert shown["image/png"].startswith(b"\x89PNG")
    answer.save(tmp_path / "answer.png")
    answer.save(tmp_path / "answer.json")
    answer.report(tmp_path / "answer.html")
    assert cv2.imread(str(tmp_path / "answer.png")) is not None
    assert json.loads((tmp_path / "answer.json").read_text())["status"] == "located"
    assert '"part.yaml"' in (tmp_path / "answer.html").read_text()
    for write, name in ((answer.save, "answer.png"), (answer.report, "answer.html")):
        with pytest.raises(OutputError, match=r"exists already \(overwrite=True"):
            write(tmp_path / name)
    answer.save(tmp_path / "answer.png", overwrite=True)
    with pytest.raises(OutputError, match=r"\.json or \.png"):
        answer.save(tmp_path / "answer.txt")


def test_a_map_has_no_robot_whose_pose_could_be_known(building: Path) -> None:
    near = pc2grid.Prior.around(4.0, 3.0, radius_m=2.0)
    with pytest.raises(ConfigError, match="no robot in a map"):
        relocalize(building / "part.yaml", building / "plan.submaps", prior=near)


def test_what_exists_is_kept_unless_one_says_so(building: Path, tmp_path: Path) -> None:
    plan, target = building / "plan.yaml", tmp_path / "all.submaps"
    target.write_bytes((building / "plan.submaps").read_bytes())
    before = target.read_bytes()
    with pytest.raises(OutputError, match=r"exists already.*overwrite=True.*add=True"):
        convert(tmp_path / "never looked at", target)
    with pytest.raises(DatabaseError, match="plan"):  # another session of that name: it has no label
        convert(plan, target, add=True)
    assert target.read_bytes() == before
    convert(plan, target, name="again", add=True)
    assert names(target) == ["plan", "again"]
    convert(plan, target, name="alone", overwrite=True)
    assert names(target) == ["alone"]


def test_a_database_that_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        convert(tmp_path / "never looked at", tmp_path / "missing" / "x.submaps")


def test_a_query_is_drawn_as_the_database_and_read_as_one_says(building: Path) -> None:
    asked = Config(read=ReadConfig(topic="/scan"), partition=pc2grid.Config.paper().partition)
    with open_database(building / "plan.submaps") as database:
        settings = query_config(database, asked)
        assert settings.partition == database.config().partition != asked.partition
    assert settings.read.topic == "/scan"


@pytest.mark.parametrize(("terminal", "shown"), [("1", True), ("0", False)])
def test_python_shows_progress_where_somebody_looks(
    building: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    terminal: str,
    shown: bool,
) -> None:
    recording = tmp_path / "drive.mcap"
    config = SimulationConfig(length_m=1.0, seed=1, clutter=0, start_m=(10.0, 7.0))
    simulate_session(recording, sensor="laser", grid=office(), config=config)
    monkeypatch.setenv("TTY_COMPATIBLE", terminal)  # what rich takes for a terminal
    pc2grid.convert(recording, tmp_path / "drive.submaps")
    pc2grid.relocalize(recording, building / "plan.submaps")
    told = capfd.readouterr()
    assert told.out == ""
    assert ("%" in told.err and "locate" in told.err) == shown


# --- Answers, signatures and databases in a notebook: one short line each, and a table ---


LONGEST_LINE = 200
SEEN = OccupancyGrid(cells=np.zeros((4, 4), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))


def hypothesis(x: float, session: int, score: float) -> Hypothesis:
    fit = Fit(
        T_map_query=SE2(x, 2.0 / 3.0, 0.1),
        forward=score,
        backward=score,
        overlap=0.9,
        compared=90.0,
        looked_at=100,
        score=score,
        covariance=np.eye(3),
    )
    return Hypothesis(session_index=session, row=-1, fit=fit)


def answer(status: str, confidence: float) -> Answer:
    best, other = hypothesis(4.0, 1, 0.8), hypothesis(9.0, 0, 0.3)
    return Answer(
        status=status,  # type: ignore[arg-type]
        stamp_ns=0,
        confidence=confidence,
        hypotheses=() if status == "not_found" else (best, other),
        places=() if status == "not_found" else (0, 1),
        history=(),
        T_odom_base=SE2(1.0, 0.0, 0.0),
        path_m=3.25,
        sessions=("monday", "tuesday <x>"),
        labels=(Label(), Label()),
        submap_ids=() if status == "not_found" else (-1, -1),
        evidence=NO_EVIDENCE,
        local_map=SEEN,
    )


@pytest.mark.parametrize(
    ("status", "confidence", "words"),
    [
        ("located", 0.9999, "in 'tuesday <x>' at x 5.00 m, y 0.77 m, yaw 5.7 deg, confidence > 0.99, after"),
        ("ambiguous", 0.4, "Answer(ambiguous, 2 places, confidence 0.40, after 3.2 m)"),
        ("not_found", 0.0, "Answer(not_found, 0 places, confidence < 0.01, after 3.2 m)"),
    ],
)
def test_an_answer_is_one_short_line(status: str, confidence: float, words: str) -> None:
    text = repr(answer(status, confidence))
    assert words in text and len(text) < LONGEST_LINE and "\n" not in text


def test_the_table_of_an_answer_names_the_places_that_fit() -> None:
    page = answer("located", 0.95)._repr_html_()
    assert "located, confidence 0.95" in page and page.count("the answer") == 1
    assert "tuesday &lt;x&gt;" in page and "<x>" not in page
    assert page.index("x 5.00 m") < page.index("the answer") < page.index("monday")
    assert "the answer" not in answer("ambiguous", 0.4)._repr_html_()
    assert answer("not_found", 0.0)._repr_html_().startswith("<table><caption>not found")


def test_signatures_and_databases_are_one_short_line(tmp_path: Path) -> None:
    path = tmp_path / "building.submaps"
    entry = make_entry("monday")
    store(path, [entry, make_entry("<b>", seed=1)], keep=False)
    with open_database(path) as database:
        table, page = database.signatures(), database._repr_html_()  # type: ignore[attr-defined]
        infos = database.sessions()
        for thing in (entry[1][0], table, *infos, infos[0].provenance, database):
            text = repr(thing)
            assert text.startswith(f"{type(thing).__name__}(") and len(text) < LONGEST_LINE
            assert "\n" not in text
    assert repr(table) == f"SignatureTable({len(table)} submaps of 2 sessions)"
    assert "monday" in page and "&lt;b&gt;" in page and "building.submaps" in page
    assert "SubmapDatabase(" in repr(database), "also when it is closed"
