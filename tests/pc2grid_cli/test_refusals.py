"""What a user reads who typed what cannot be done: the error, and what to type next."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from pc2grid.errors import (
    ConfigError,
    DatabaseError,
    FrameError,
    LogNotFound,
    LogTruncated,
    MapFileError,
    NoScans,
    NotADatabase,
    NotALog,
    OutputError,
    Pc2GridError,
    TopicError,
)
from pc2grid.model import MISSING_FILES, ReadReport
from pc2grid_cli import console, output as data_loss, relocalize
from pc2grid_cli.main import app
from signature.database.maintenance import store
from tests.helpers.databases import make_entry
from tests.helpers.recordings import STEP, T0, drive, ros, write_mcap
from tests.helpers.shared_folders import shared_folder


@shared_folder("office_folder")
def desk(folder: Path) -> None:
    """The office, and files of every other kind: a.mcap (a lidar), monday.submaps, maps without an image or
    keys, text, an empty file, files and folders in the way of outputs."""
    write_mcap(folder / "a.mcap", drive())
    store(folder / "monday.submaps", [make_entry("monday")], keep=False)
    (folder / "lost.yaml").write_text((folder / "office.yaml").read_text().replace("office.pgm", "x.pgm"))
    (folder / "bad.yaml").write_text("resolution: 0.05\norigin: [0, 0, 0]\n")
    (folder / "text.mcap").write_text("this is not a recording, nor = [ TOML\n")
    (folder / "taken.submaps").write_text("something else\n")
    for name in ("empty.mcap", "taken.png", "taken.tum"):
        (folder / name).touch()
    (folder / "folder").mkdir()


EXPORT, LOCATE, WATCH = "export none.submaps", "relocalize none.mcap -d none.submaps", "watch -d b.submaps"
MAKE, FIND = "convert drive.mcap -o x.submaps", "relocalize drive.mcap -d b.submaps"
# fmt: off
REFUSED: list[tuple[str, int, type[Exception] | None, tuple[str, ...]]] = [
    # one thing mistaken for another
    ("relocalize b.submaps -d a.mcap", 1, NotALog, (
        "b.submaps: a submap database, where a recording or a map is expected",
        "hint: are they swapped? pc2grid relocalize a.mcap -d b.submaps")),
    ("convert b.submaps -o c.submaps", 1, NotALog, (
        "b.submaps: a submap database, not a recording", "`pc2grid info b.submaps` shows what is in it")),
    ("convert lost.yaml -o c.submaps", 1, MapFileError, (
        "/x.pgm: cannot read the map's image: No such file or directory", "copy it to that place")),
    ("convert office.pgm -o c.submaps", 1, NotALog, ("looks like a PGM image", "give the .yaml")),
    ("relocalize ws://localhost:8765 -d b.submaps", 1, LogNotFound, ("no such file", "pc2grid watch")),
    ("relocalize - -d b.submaps", 1, LogNotFound, ("-: no such file", "pc2grid watch")),
    ("relocalize /dev/null -d b.submaps", 1, LogNotFound, ("not a regular file", "pc2grid watch")),
    ("relocalize none.mcap -d b.submaps", 1, LogNotFound, ("none.mcap: no such file", "check the path")),
    ("relocalize a.mcap -d a.mcap", 1, NotADatabase, (
        "error: a.mcap: not a pc2grid database\n",
        "hint: make one of it: pc2grid convert a.mcap -o a.submaps\n")),
    ("relocalize a.mcap -d office.pgm", 1, NotADatabase, ("convert LOG -o",)),
    # what is not there, or not what its name says
    ("convert none.mcap -o x.submaps", 1, LogNotFound, ("none.mcap",)),
    ("convert text.mcap -o x.submaps", 1, NotALog, ("text.mcap",)),
    ("convert empty.mcap -o x.submaps", 1, LogTruncated, ("empty.mcap", "empty")),
    ("convert folder -o x.submaps", 1, LogNotFound, ("folder",)),
    ("convert none.yaml -o x.submaps", 1, MapFileError, ("none.yaml",)),
    ("convert bad.yaml -o x.submaps", 1, MapFileError, ("bad.yaml", "image")),
    ("convert office.yaml office.yaml -o x.submaps", 2, ConfigError, ("'office'",)),
    ("relocalize drive.mcap --database none.submaps", 1, NotADatabase, ("none.submaps", "pc2grid convert")),
    ("relocalize drive.mcap --database text.mcap", 1, NotADatabase, ("text.mcap: not a pc2grid database",)),
    ("relocalize drive.mcap --database empty.mcap", 1, NotADatabase, ("empty.mcap: empty file",)),
    ("relocalize drive.mcap --database mongodb://h/d", 1, DatabaseError, ("mongodb://",)),
    ("export none.submaps --map m", 1, NotADatabase, ("none.submaps",)),
    ("db check text.mcap", 1, NotADatabase, ("not a pc2grid database",)),
    ("db info .", 1, NotADatabase, ("folder",)),
    ("db merge none.submaps -o y.submaps", 1, NotADatabase, ("none.submaps",)),
    ("db copy none.submaps -o y.submaps", 1, NotADatabase, ("none.submaps",)),
    # options
    (f"{MAKE} --topic /scam", 1, TopicError, ("/scam", "/scan")),
    (f"{MAKE} --start 1e6", 1, NoScans, ("no scan", "the log lasts")),
    (f"{MAKE} --set partition.radios_m=5", 2, ConfigError, ("partition.radius_m",)),
    (f"{MAKE} --set partition.radius_m=-5", 2, ConfigError, ("partition.radius_m", "greater")),
    (f"{MAKE} --set radius_m", 2, ConfigError, ("section.key=value",)),
    (f"{MAKE} --set grid.x=1", 2, ConfigError, (
        "--set: unknown setting grid.x\n", "hint: `pc2grid config dump` lists all settings\n")),
    (f"{MAKE} --set grid.resolution_m=1", 2, ConfigError, (
        "--set: unknown setting grid.resolution_m\n", "hint: did you mean projection.resolution_m?\n")),
    (f"{MAKE} --set red.topic=/a", 2, ConfigError, (
        "--set: unknown setting red.topic\n", "hint: did you mean read.topic?\n")),
    (f"{MAKE} --set partition.radius=5", 2, ConfigError, (
        "--set: unknown setting partition.radius\n", "hint: did you mean partition.radius_m?\n")),
    (f"{MAKE} --config none.toml", 2, ConfigError, ("none.toml", "no such file")),
    (f"{MAKE} --config text.mcap", 2, ConfigError, ("text.mcap", "not TOML")),
    ("convert", 2, None, ("--help",)),
    ("convert drive.mcap", 2, None, ("output",)),
    ("nonsense", 2, None, ("nonsense",)),
    ("simulate a.mcap", 2, None, ("Choose from: lidar, laser, depth",)),
    ("export none.submaps", 2, ConfigError, ("nothing to export",)),
    # what cannot be written: known before any work, as the recordings and databases do not exist
    (f"{EXPORT} --trajectory way.csv", 1, OutputError, (
        "way.csv: --trajectory does not write the format .csv",)),
    (f"{EXPORT} --mcap map.bag", 1, OutputError, ("map.bag: --mcap does not write the format .bag",)),
    (f"{EXPORT} --map plan.png", 1, OutputError, ("plan.png: --map writes STEM.yaml and STEM.pgm",)),
    (f"{EXPORT} --cloud walls.las", 1, OutputError, ("walls.las: --cloud",)),
    (f"{EXPORT} --cloud walls", 1, OutputError, ("(no suffix)",)),
    (f"{EXPORT} --graph ways.dot", 1, OutputError, ("ways.dot: --graph",)),
    (f"{EXPORT} --plot a.pdf", 1, OutputError, ("a.pdf: --plot",)),
    (f"{EXPORT} --report a.pdf", 1, OutputError, ("a.pdf: --report",)),
    (f"{EXPORT} --g2o nowhere/a.g2o", 1, OutputError, ("a.g2o: cannot write: no folder nowhere",)),
    (f"{EXPORT} --map nowhere/a", 1, OutputError, ("a.yaml: cannot write: no folder nowhere",)),
    (f"{EXPORT} --map office", 1, OutputError, ("office.yaml: exists already", "--force")),
    (f"{EXPORT} --plot taken.png", 1, OutputError, ("taken.png: exists already",)),
    (f"{EXPORT} --plot folder", 1, OutputError, ("folder: is a folder",)),
    (f"{LOCATE} --trajectory way.csv", 1, OutputError, ("way.csv: --trajectory",)),
    (f"{LOCATE} --csv answers.json", 1, OutputError, (
        "answers.json: --csv does not write the format .json",)),
    (f"{LOCATE} -o answer.bag", 1, OutputError, ("answer.bag: --output",)),
    (f"{LOCATE} --initialpose pose.png", 1, OutputError, ("pose.png: --initialpose",)),
    (f"{LOCATE} --plot nowhere/a.png", 1, OutputError, ("a.png: cannot write: no folder nowhere",)),
    ("convert none.mcap -o x.mcap", 1, OutputError, (
        "x.mcap: a submap database is not written as .mcap",)),
    ("convert none.mcap -o nowhere/x.submaps", 1, OutputError, ("cannot write: no folder nowhere",)),
    ("convert none.mcap -o /proc/x.submaps", 1, OutputError, ("/proc/x.submaps: cannot write: ",)),
    ("simulate nowhere/x.mcap --sensor laser", 1, OutputError, ("x.mcap: cannot write: no folder nowhere",)),
    ("simulate taken.mcap --sensor laser", 1, OutputError, ("taken.tum: exists already",)),
    ("demo -o /proc/demo", 1, OutputError, ("/proc/demo: cannot make this folder: ",)),
    ("compare sensors part.yaml -o /proc/out", 1, OutputError, ("/proc/out: cannot make this folder: ",)),
    ("convert drive.mcap -o taken.submaps", 1, OutputError, ("taken.submaps", "exists", "--force")),
    ("convert drive.mcap -o office.pgm", 1, OutputError, ("office.pgm", "office.submaps")),
    # what is known of the pose
    (f"{FIND} --near 1 1 0", 2, ConfigError, ("radius > 0",)),
    (f"{FIND} --near 1 1 nan", 2, ConfigError, ("radius > 0",)),
    (f"{FIND} --near 1 1", 2, None, ("3 arguments",)),
    (f"{FIND} --near 1 1 1 --check 1 1 0", 2, ConfigError, ("do not go together",)),
    (f"{FIND} --near 1 1 1 --session attic", 2, ConfigError, ("there is: office",)),
    (f"{FIND} --session office", 2, ConfigError, ("--near X Y RADIUS",)),
    (f"{FIND} --near-pose none.json", 2, ConfigError, ("none.json",)),
    (f"{FIND} --near-pose office.yaml", 2, ConfigError, ("not a PoseWithCovarianceStamped",)),
    (f"{FIND} --near-pose /scan", 1, TopicError, ("holds no pose",)),
    (f"{FIND} --near-pose /odom", 1, FrameError, ("frame odom",)),
    (f"{FIND} --check 1 nan 0", 2, ConfigError, ("--check",)),
    (f"{FIND} --check 1 1 0 --plot out.png", 2, ConfigError, ("--plot",)),
    ("relocalize office.yaml -d b.submaps --near 1 1 1", 2, ConfigError, ("no robot in a map",)),
    # what is of one query, of a robot, or of a recording
    ("relocalize drive.mcap drive.mcap -d b.submaps --report out.html", 2, ConfigError, ("--report",)),
    (f"{FIND} --every 3 --initialpose out.json", 2, ConfigError, ("--initialpose",)),
    (f"{FIND} --every 3 --check 1 1 0", 2, ConfigError, ("--check",)),
    ("relocalize office.yaml -d b.submaps --every 3", 2, ConfigError, ("--every",)),
    (f"{WATCH} rosbridge://robot", 1, LogNotFound, ("rosbridge:// cannot be followed", "hint: ")),
    (f"{WATCH} zenoh://robot:7447", 1, LogNotFound, ("zenoh:// cannot be followed", "hint: ")),
    (f"{WATCH} -", 1, LogNotFound, ("standard input cannot be followed", "hint: ")),
    (f"{WATCH} drive.mcap --publish tf", 2, ConfigError, ("takes no messages", "hint: ")),
    (f"{WATCH} drive.mcap --topic /points", 1, TopicError, ("no topic /points", "hint: ")),
    (f"{WATCH} b.submaps", 1, NotALog, ("not a recording", "hint: ")),
    (f"{WATCH} drive.mcap --first --check-topic /tf", 2, ConfigError, (
        "--check-topic goes on until it is stopped", "hint: ")),
    (f"{WATCH} ws://robot:1 --first --publish tf", 2, ConfigError, (
        "--publish tf goes on until it is stopped", "hint: ")),
    (f"{WATCH} drive.mcap --real-time --publish tf", 2, ConfigError, ("takes no messages", "hint: ")),
]
# fmt: on


def files(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of change of all that is in a folder."""
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in folder.rglob("*")}


@pytest.mark.parametrize(("command", "code", "error", "words"), REFUSED)
def test_a_refusal_is_one_line_and_one_of_advice_and_leaves_nothing(
    command: str,
    code: int,
    error: type[Exception] | None,
    words: tuple[str, ...],
    desk: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    raised: list[BaseException] = []
    report = console.Console.report_error
    monkeypatch.setattr(
        console.Console, "report_error", lambda self, e: (raised.append(e), report(self, e))[1]
    )
    monkeypatch.setenv("PC2GRID_CONFIG", "")
    monkeypatch.chdir(desk)
    before = files(desk)
    terminal = console.Console()
    found = terminal.run(
        lambda: app(command.split(), prog_name="pc2grid", standalone_mode=False, obj=terminal)
    )
    out, err = capsys.readouterr()
    assert (found, out) == (code, "")
    said = [line for line in err.splitlines(keepends=True) if not line.startswith("pc2grid: warning")]
    if command == "convert":  # without a word, the help is printed
        assert words[0] in err
    else:
        assert said[0].startswith("pc2grid: error: ") and "\\n" not in said[0]
        assert len(said) <= 2 and all(line.startswith("hint: ") for line in said[1:])
        assert len(said) == 2 or error is not OutputError
        assert all(word in "".join(said) for word in words), err
    assert error is None or type(raised[0]) is error
    assert files(desk) == before


def test_scans_out_of_order_get_a_hint(tmp_path: Path) -> None:
    """Their headers count down, while the log is in order; more than wait to be sorted."""
    to = ros()
    scans = [
        to.laser("/scan", T0 - i * STEP, [1.0] * 10)._replace(log_time_ns=T0 + i * STEP) for i in range(400)
    ]
    write_mcap(tmp_path / "s.mcap", scans)
    error = CliRunner().invoke(app, f"convert {tmp_path}/s.mcap -o {tmp_path}/x.submaps".split()).exception
    assert isinstance(error, Pc2GridError) and "stamp goes back in time" in error.message
    assert error.hint is not None and "must increase" in error.hint and "--start" in error.hint


def test_the_last_session_is_not_removed_unasked(tmp_path: Path) -> None:
    database = tmp_path / "b.submaps"
    store(database, [make_entry("monday"), make_entry("tuesday", 2)], keep=False)

    def refused(*names: str) -> DatabaseError:
        before = database.read_bytes()
        error = CliRunner().invoke(app, ["db", "remove", str(database), *names]).exception
        assert isinstance(error, DatabaseError) and database.read_bytes() == before
        return error

    for names in (["monday", "tuesday"], ["tuesday", "monday", "monday"]):
        error = refused(*names)
        assert "no session would be left" in error.message
        assert error.hint is not None and "--force" in error.hint
    assert CliRunner().invoke(app, ["db", "remove", str(database), "monday"]).exit_code == 0
    refused("tuesday")
    refused("monday")  # is not there
    done = CliRunner().invoke(app, ["db", "remove", str(database), "tuesday", "--force"])
    assert done.exit_code == 0 and "0 sessions left" in done.stdout


def test_the_help_of_a_group_names_all_its_commands() -> None:
    group: Any = get_command(app).commands["compare"]
    for name in group.commands:
        assert re.search(rf"\b{name}\b", group.help) or (name == "paper" and "the paper's" in group.help)


def test_another_label_is_named(office_folder: Path, tmp_path: Path) -> None:
    convert = f"convert {office_folder}/office.yaml -o {tmp_path}/labelled.submaps".split()
    assert CliRunner().invoke(app, [*convert, "--building", "fr079", "--floor", "0"]).exit_code == 0
    error = CliRunner().invoke(app, convert).exception
    assert isinstance(error, OutputError)
    assert "exists already, 'office' made with building = 'fr079', not None" in error.message


def test_text_is_calm_and_json_exact(office_folder: Path) -> None:
    locate = f"relocalize {office_folder}/part.yaml -d {office_folder}/b.submaps".split()
    assert "confidence > 0.99" in CliRunner().invoke(app, locate).stdout
    document = json.loads(CliRunner().invoke(app, [*locate, "--json"]).stdout)
    assert 0.99 < document["confidence"] <= 1.0


# --- What options name for writing is checked before any work; the answer is printed before files are ---


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
