"""What a user reads who mistook one thing for another: the error, and what to type next."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pc2grid.errors import (
    ConfigError,
    DatabaseError,
    LogNotFound,
    MapFileError,
    NoScans,
    NotADatabase,
    NotALog,
    OutputError,
    Pc2GridError,
)
from pc2grid.io.maps import save_map
from pc2grid.model import MISSING_FILES, ReadReport
from pc2grid_cli import console, relocalize
from pc2grid_cli import output as data_loss
from pc2grid_cli.main import REMOVED, app
from signature.database.maintenance import store
from tests.helpers.databases import make_entry
from tests.helpers.recordings import STEP, T0, drive, ros, write_mcap
from tests.helpers.simulated_drives import office


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_mcap(tmp_path / "a.mcap", drive())
    store(tmp_path / "b.submaps", [make_entry("monday")], keep=False)
    save_map(office(), tmp_path / "office")
    (tmp_path / "lost.yaml").write_text((tmp_path / "office.yaml").read_text().replace("office.pgm", "x.pgm"))
    return tmp_path


@pytest.mark.parametrize(
    ("command", "kind", "words", "hint"),
    [
        (
            "relocalize b.submaps -d a.mcap",
            NotALog,
            "b.submaps: a submap database, where a recording or a map is expected",
            "are they swapped? pc2grid relocalize a.mcap -d b.submaps",
        ),
        (
            "convert b.submaps -o c.submaps",
            NotALog,
            "b.submaps: a submap database, not a recording",
            "`pc2grid info b.submaps` shows what is in it",
        ),
        (
            "convert lost.yaml -o c.submaps",
            MapFileError,
            "/x.pgm: cannot read the map's image: No such file or directory",
            "copy it to that place",
        ),
        ("convert office.pgm -o c.submaps", NotALog, "looks like a PGM image", "give the .yaml"),
        ("relocalize ws://localhost:8765 -d b.submaps", LogNotFound, "no such file", "pc2grid watch"),
        ("relocalize - -d b.submaps", LogNotFound, "-: no such file", "pc2grid watch"),
        ("relocalize /dev/null -d b.submaps", LogNotFound, "not a regular file", "pc2grid watch"),
        ("relocalize none.mcap -d b.submaps", LogNotFound, "none.mcap: no such file", "check the path"),
    ],
)
def test_the_error_says_what_to_do(
    command: str, kind: type[Pc2GridError], words: str, hint: str, folder: Path
) -> None:
    error = CliRunner().invoke(app, command.split()).exception
    assert isinstance(error, kind), error
    assert words in error.message
    assert error.hint is not None and hint in error.hint


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What is said of words that are no command."""
    terminal = console.Console()
    code = terminal.run(lambda: app(words, prog_name="pc2grid", standalone_mode=False, obj=terminal))
    assert code == console.USAGE
    return capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(("removed", "instead"), REMOVED.items())
def test_what_was_removed_says_what_to_use(
    removed: str, instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = refused(removed.split()[1:], capsys)
    assert said[0].startswith("pc2grid: error: No such ")
    assert said[1:] == [f"hint: {instead}"]


def test_a_recording_in_place_of_a_database_says_how_to_make_one(folder: Path) -> None:
    error = CliRunner().invoke(app, ["relocalize", "a.mcap", "-d", "a.mcap"]).exception
    assert isinstance(error, NotADatabase) and error.message == "a.mcap: not a pc2grid database"
    assert error.hint == "make one of it: pc2grid convert a.mcap -o a.submaps"
    other = CliRunner().invoke(app, ["relocalize", "a.mcap", "-d", "office.pgm"]).exception
    assert isinstance(other, NotADatabase) and other.hint is not None and "convert LOG -o" in other.hint


def test_depth_images_without_their_camera_info_say_so(folder: Path) -> None:
    to, pixels = ros(), np.full((4, 6), 1000, np.uint16)
    images = [to.image("/camera/depth/image", T0 + i * STEP, pixels, "16UC1") for i in range(3)]
    write_mcap(folder / "d.mcap", images)
    for topic in ((), ("--topic", "/camera/depth/image")):
        error = CliRunner().invoke(app, ["convert", "d.mcap", "-o", "x.submaps", *topic]).exception
        assert isinstance(error, NoScans)
        assert error.message == "d.mcap: /camera/depth/image: a depth image without a CameraInfo topic"
        assert error.hint == "record the camera_info topic next to the image"


def test_scans_out_of_order_get_a_hint(folder: Path) -> None:
    """Their headers count down, while the log is in order; more than wait to be sorted."""
    to = ros()
    scans = [
        to.laser("/scan", T0 - i * STEP, [1.0] * 10)._replace(log_time_ns=T0 + i * STEP) for i in range(400)
    ]
    write_mcap(folder / "s.mcap", scans)
    error = CliRunner().invoke(app, ["convert", "s.mcap", "-o", "x.submaps"]).exception
    assert isinstance(error, Pc2GridError) and "stamp goes back in time" in error.message
    assert error.hint is not None and "must increase" in error.hint and "--start" in error.hint


@pytest.mark.parametrize(
    ("assignment", "hint"),
    [
        ("grid.x=1", "`pc2grid config dump` lists all settings"),
        ("grid.resolution_m=1", "did you mean projection.resolution_m?"),
        ("red.topic=/a", "did you mean read.topic?"),
        ("partition.radius=5", "did you mean partition.radius_m?"),
    ],
)
def test_a_setting_that_is_not_known(assignment: str, hint: str) -> None:
    words = ["convert", "a.mcap", "-o", "b.submaps", "--set", assignment]
    error = CliRunner().invoke(app, words).exception
    assert isinstance(error, ConfigError) and error.hint == hint
    assert error.message == f"--set: unknown setting {assignment.partition('=')[0]}"


def test_the_last_session_is_not_removed_unasked(folder: Path) -> None:
    store(folder / "b.submaps", [make_entry("tuesday", 2)], keep=True)
    remove = ["db", "remove", "b.submaps"]
    before = (folder / "b.submaps").read_bytes()
    for names in (["monday", "tuesday"], ["tuesday", "monday", "monday"]):
        error = CliRunner().invoke(app, [*remove, *names]).exception
        assert isinstance(error, DatabaseError) and "no session would be left" in error.message
        assert error.hint is not None and "--force" in error.hint
        assert (folder / "b.submaps").read_bytes() == before
    assert CliRunner().invoke(app, [*remove, "monday"]).exit_code == 0
    left = (folder / "b.submaps").read_bytes()
    assert isinstance(CliRunner().invoke(app, [*remove, "tuesday"]).exception, DatabaseError)
    assert isinstance(CliRunner().invoke(app, [*remove, "monday"]).exception, DatabaseError)  # is not there
    assert (folder / "b.submaps").read_bytes() == left
    done = CliRunner().invoke(app, [*remove, "tuesday", "--force"])
    assert done.exit_code == 0 and "0 sessions left" in done.stdout


def test_the_help_of_a_group_names_all_its_commands() -> None:
    from typer.main import get_command

    group = get_command(app).commands["compare"]  # type: ignore[attr-defined]
    for name in group.commands:
        assert re.search(rf"\b{name}\b", group.help) or (name == "paper" and "the paper's" in group.help)


def test_another_label_is_named(folder: Path) -> None:
    convert = ["convert", "office.yaml", "-o", "labelled.submaps"]
    assert CliRunner().invoke(app, [*convert, "--building", "fr079", "--floor", "0"]).exit_code == 0
    error = CliRunner().invoke(app, convert).exception
    assert isinstance(error, OutputError)
    assert "exists already, 'office' made with building = 'fr079', not None" in error.message


def test_a_usage_error_is_one_readable_line(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = console.Console()
    code = terminal.run(lambda: app(["simulate", "a.mcap"], standalone_mode=False, obj=terminal))
    assert code == console.USAGE
    line = capsys.readouterr().err.splitlines()[0]
    assert "Choose from: lidar, laser, depth" in line and "\\n" not in line


def test_text_is_calm_and_json_exact(folder: Path) -> None:
    assert CliRunner().invoke(app, ["convert", "office.yaml", "-o", "c.submaps"]).exit_code == 0
    locate = ["relocalize", "office.yaml", "-d", "c.submaps"]
    assert "confidence > 0.99" in CliRunner().invoke(app, locate).stdout
    document = json.loads(CliRunner().invoke(app, [*locate, "--json"]).stdout)
    assert 0.99 < document["confidence"] <= 1.0


# --- What options name for writing is checked before any work; the answer is printed before files are ---


EXPORT, LOCATE = "export none.submaps", "relocalize none.mcap -d none.submaps"


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (f"{EXPORT} --trajectory way.csv", "way.csv: --trajectory does not write the format .csv"),
        (f"{EXPORT} --mcap map.bag", "map.bag: --mcap does not write the format .bag"),
        (f"{EXPORT} --map plan.png", "plan.png: --map writes STEM.yaml and STEM.pgm"),
        (f"{EXPORT} --cloud walls.las", "walls.las: --cloud"),
        (f"{EXPORT} --cloud walls", "(no suffix)"),
        (f"{EXPORT} --graph ways.dot", "ways.dot: --graph"),
        (f"{EXPORT} --plot a.pdf", "a.pdf: --plot"),
        (f"{EXPORT} --report a.pdf", "a.pdf: --report"),
        (f"{EXPORT} --g2o nowhere/a.g2o", "a.g2o: cannot write: no folder nowhere"),
        (f"{EXPORT} --map nowhere/a", "a.yaml: cannot write: no folder nowhere"),
        (f"{EXPORT} --plot taken.png", "taken.png: exists already"),
        (f"{EXPORT} --plot folder", "folder: is a folder"),
        (f"{LOCATE} --trajectory way.csv", "way.csv: --trajectory"),
        (f"{LOCATE} --csv answers.json", "answers.json: --csv does not write the format .json"),
        (f"{LOCATE} -o answer.bag", "answer.bag: --output"),
        (f"{LOCATE} --initialpose pose.png", "pose.png: --initialpose"),
        (f"{LOCATE} --plot nowhere/a.png", "a.png: cannot write: no folder nowhere"),
        ("convert none.mcap -o x.mcap", "x.mcap: a submap database is not written as .mcap"),
        ("convert none.mcap -o nowhere/x.submaps", "cannot write: no folder nowhere"),
        ("convert none.mcap -o /proc/x.submaps", "/proc/x.submaps: cannot write: "),
        ("simulate nowhere/x.mcap --sensor laser", "x.mcap: cannot write: no folder nowhere"),
        ("simulate taken.mcap --sensor laser", "taken.tum: exists already"),
        ("demo -o /proc/demo", "/proc/demo: cannot make this folder: "),
        ("compare sensors part.yaml -o /proc/out", "/proc/out: cannot make this folder: "),
    ],
)
def test_what_cannot_be_written_is_refused_before_any_work(
    command: str, words: str, office_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("taken.png", "taken.tum"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "part.yaml").write_bytes((office_folder / "part.yaml").read_bytes())
    before = sorted(tmp_path.iterdir())
    # The recordings and databases do not exist: whoever looked at them first would say so.
    error = CliRunner().invoke(app, command.split()).exception
    assert isinstance(error, OutputError), error
    assert words in error.message
    assert error.hint
    assert sorted(tmp_path.iterdir()) == before


def test_the_file_of_a_map_may_be_named_instead_of_its_stem(office_folder: Path, tmp_path: Path) -> None:
    for name in ("a.yaml", "b.pgm", "c", "d.5"):
        export = ["export", str(office_folder / "b.submaps"), "--map", str(tmp_path / name)]
        assert CliRunner().invoke(app, export, catch_exceptions=False).exit_code == 0
    stems = ("a", "b", "c", "d.5")
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{s}{e}" for s in stems for e in (".pgm", ".yaml")]


def test_the_answer_is_printed_although_a_picture_cannot_be_written(
    office_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def disk_full(*_: Any) -> None:
        raise OutputError("a.png: cannot write: No space left on device")

    monkeypatch.setattr(relocalize, "_write", disk_full)
    locate = ["relocalize", str(office_folder / "part.yaml"), "-d", str(office_folder / "b.submaps")]
    done = CliRunner().invoke(app, [*locate, "--plot", str(tmp_path / "a.png")])
    assert isinstance(done.exception, OutputError)
    assert done.stdout.startswith("located in office: x ")


def test_the_output_of_a_command_has_the_same_option_everywhere() -> None:
    group: Any = get_command(app)
    folders = [group.commands["demo"]]
    folders += [group.commands["compare"].commands[name] for name in ("paper", "sensors", "recordings")]
    for command in folders:
        (option,) = [param for param in command.command.params if "--output" in param.opts]
        assert {"-o", "--output", "--out"} <= set(option.opts), command.name
    databases = [group.commands["convert"], group.commands["relocalize"]]
    databases += [group.commands["db"].commands[name] for name in ("copy", "merge")]
    for command in databases:
        (option,) = [param for param in command.command.params if "--output" in param.opts]
        assert "-o" in option.opts, command.name


# --- Lost scans: a warning up to a named share, exit code 3 from there on, or with --strict ---


@pytest.mark.parametrize(
    ("report", "lossy", "severe"),
    [
        (ReadReport(scans_read=500), False, False),
        (ReadReport(scans_read=500, scans_skipped={"registration lost": 4}), True, False),
        (ReadReport(scans_read=500, scans_skipped={"registration lost": 4, "no stamp": 1}), True, True),
        (ReadReport(scans_read=500, scans_skipped={MISSING_FILES: 1}), True, True),
        (ReadReport(scans_read=500, bytes_lost=1), True, True),
        (ReadReport(scans_read=0, scans_skipped={"no stamp": 1}), True, True),
        (ReadReport(scans_read=0), False, False),
    ],
)
def test_which_losses_are_severe(report: ReadReport, lossy: bool, severe: bool) -> None:
    assert (report.lossy, report.severe) == (lossy, severe)
    assert data_loss.ends_with_3(report, strict=False) == severe
    assert data_loss.ends_with_3(report, strict=True) == lossy


def test_one_lost_scan_of_150_is_a_warning(tmp_path: Path) -> None:
    ranges = [2.0 + 0.01 * (k % 7) for k in range(315)]
    scans = [ros().laser("/scan", T0 + i * STEP, ranges) for i in range(150)]
    log = write_mcap(tmp_path / "a.mcap", [*scans, ros().laser("/scan", T0, ranges)._replace(
        log_time_ns=T0 + 150 * STEP
    )])  # fmt: skip
    for options, code in (((), 0), (("--strict",), 3)):
        output = tmp_path / f"{code}.submaps"
        done = CliRunner().invoke(app, ["convert", str(log), "-o", str(output), *options])
        assert done.exit_code == code, done.stderr
        assert "warning: a: data was lost: 1 scans skipped" in done.stderr
        assert output.exists()
