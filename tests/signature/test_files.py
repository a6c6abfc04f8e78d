"""From file to file: what is refused before any work, and what a notebook gets back."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import pc2grid
from pc2grid.display import CENTRE_GREEN
from pc2grid.errors import ConfigError, DatabaseError, OutputError
from pc2grid.io.maps import save_map
from pc2grid.observer import Observer
from pc2grid.settings import ReadConfig
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from signature.database import Label, open_database
from signature.sessions import convert, query_config, relocalize
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
