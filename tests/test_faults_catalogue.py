"""The catalogue of faults: what goes wrong with inputs, and what `pc2grid` answers.

Each case is a command on files that a function makes: its exit code (0 done, 1 failed, 2 usage, 3 done with
loss), the class of the error, words of the message, and that nothing is left behind or changed except a whole
database where one was asked for. `same`: the map, the trajectory and the signatures are those of the clean
recording, to the last bit. Most cases stand in the tests of what reads or decides, where the mark
`fault(number)` assigns a test to its case. The last test checks that no number is missing:

 1 missing, folder, no permission      17 a type in two schema records    33 odd stamps
 2 zero bytes                          18 another type on the topic       34 gap in the log
 3 magic only                          19 another definition of the type  35 frame not in tf, or changing
 4 another kind of file                20 messages cut short              36 tf missing, circular, two parents
 5 truncated                           21 NaN and inf points              37 depth images
 6 recorder killed                     22 big-endian cloud                38 registration diverges
 7 flipped bit                         23 padded rows                     39 disk full, read-only
 8 no checksums                        24 data shorter than declared      40 kill -9
 9 summary damaged                     25 odd fields                      41 Ctrl-C, SIGTERM, closed pipe
10 unknown compression                 26 other datatypes                 42 rerun with other settings
11 decompression bomb                  27 scan without points             43 damaged or foreign database
12 absurd length                       28 all points out of range         44 database of another version
13 no such topic                       29 huge coordinates                45 readers and writers at once
14 no scans in the log                 30 degenerate geometry             46 hostile maps, settings and names
15 several topics with scans           31 no per-point times
16 topic without messages              32 per-point times of any unit
"""

import os
import re
import shlex
import struct
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from pc2grid import errors
from pc2grid.errors import Pc2GridError
from pc2grid.io.export import write_cloud
from pc2grid_cli import console
from signature.database import open_database
from signature.database.maintenance import check, store
from tests.helpers.building_clouds import rooms_cloud, turned
from tests.helpers.databases import make_entry
from tests.helpers.memory import Peak
from tests.helpers.nav2_map import map_of
from tests.helpers.recordings import (
    STEP,
    T0,
    Message,
    drive,
    raw_log,
    read,
    ros,
    write_bag,
    write_mcap,
    write_rosbag2,
)

CONVERT = "convert log.mcap -o x.submaps"
CLOUD = "sensor_msgs/msg/PointCloud2"
SCANS = 12
Make = Callable[[Path], str | list[Message] | None]


# --- a small recording --------------------------------------------------------------------------------


def planar_scan(x_m: float) -> np.ndarray:
    """(1080, 3) float32: the walls of a room of 8 x 6 m, seen from (x_m, 0)."""
    angle = np.linspace(-3.1, 3.1, 360)
    c, s = np.cos(angle), np.sin(angle)
    range_m = np.minimum(np.maximum((5 - x_m) / c, (-3 - x_m) / c), np.maximum(4 / s, -2 / s))
    ring = np.column_stack((range_m * c, range_m * s))
    return np.vstack([np.column_stack((ring, np.full(360, z))) for z in (-0.2, 0.1, 0.4)]).astype("f4")


def cloud(
    i: int, points: np.ndarray | None = None, *, frame: str = "lidar", stamp: int | None = None
) -> Message:
    """Scan i."""
    at, seen = T0 + i * STEP, planar_scan(0.1 * i + 0.2) if points is None else points
    message = ros().cloud("/points", at if stamp is None else stamp, seen, frame)
    return message._replace(log_time_ns=at)


MOUNT = ros().tf(T0, "base_link", "lidar", 0.25, topic="/tf_static")
ODOMETRY = [ros().odometry("/odom", T0 + i * STEP, 0.1 * i) for i in range(SCANS)]
CLOUDS = [cloud(i) for i in range(SCANS)]


def recording(
    clouds: Iterable[Message] = CLOUDS, *others: Message, mount: Iterable[Message] = (MOUNT,)
) -> list[Message]:
    """All messages by the time of recording."""
    return sorted([*mount, *ODOMETRY, *clouds, *others], key=lambda m: m.log_time_ns)


def log(folder: Path, messages: Iterable[Message] | None = None, **options: Any) -> bytes:
    """Write log.mcap, in several chunks."""
    options = {"chunk_size": 20_000, **options}
    return write_mcap(
        folder / "log.mcap", recording() if messages is None else messages, **options
    ).read_bytes()


def changed(change: Callable[[int], Message | None]) -> list[Message]:
    """The recording with other clouds; None keeps the usual one."""
    return recording([change(i) or CLOUDS[i] for i in range(SCANS)])


# --- the cases ----------------------------------------------------------------------------------------


class Case(NamedTuple):
    """What must happen when `make` has filled a folder, and the command that it returns, or else `convert`,
    is run there with `flags`. If it returns messages, they are written to log.mcap."""

    number: int
    code: int
    error: type[Pc2GridError] | None
    words: tuple[str, ...]
    same: bool
    flags: str
    name: str
    make: Make


CASES: list[Case] = []


def fault(
    number: int,
    code: int,
    error: type[Pc2GridError] | None,
    *words: str,
    same: bool = False,
    flags: str = "",
    name: str = "",
) -> Callable[[Make], Make]:
    def add(make: Make) -> Make:
        CASES.append(Case(number, code, error, words, same, flags, name or make.__name__, make))
        return make

    return add


@fault(1, 1, errors.LogNotFound, "log.mcap: no such file")
def missing(folder: Path) -> str:
    return CONVERT


@fault(1, 1, errors.LogNotFound, "rooms: a folder without a recording")
def folder_without_recording(folder: Path) -> str:
    (folder / "rooms").mkdir()
    return "convert rooms -o x.submaps"


@fault(1, 0, None, same=True)
def folder_with_a_recording(folder: Path) -> str:
    log(write_rosbag2(folder / "rooms", recording(), "mcap"))
    (folder / "rooms/log.mcap").rename(folder / "rooms/rooms.mcap")
    return "convert rooms -o x.submaps --name log"


@fault(2, 1, errors.LogTruncated, "log.mcap: empty file")
def zero_bytes(folder: Path) -> None:
    (folder / "log.mcap").touch()


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 4096\n"


@fault(4, 0, None, same=True)
def bag_that_is_called_mcap(folder: Path) -> None:
    """The name of a file does not matter."""
    to = ros("ros1")
    again = [to.tf(T0, "base_link", "lidar", 0.25, topic="/tf_static")]
    for i in range(SCANS):
        again.append(to.odometry("/odom", T0 + i * STEP, 0.1 * i))
        again.append(to.cloud("/points", T0 + i * STEP, planar_scan(0.1 * i + 0.2)))
    write_bag(folder / "a.bag", again).rename(folder / "log.mcap")


@fault(5, 3, None, "log: data was lost", "bytes unreadable", flags="--recover")
@fault(5, 1, errors.LogTruncated, "log.mcap", "readable", "--recover")
def truncated(folder: Path) -> None:
    whole = log(folder)
    (folder / "log.mcap").write_bytes(whole[: int(0.6 * len(whole))])


@fault(10, 1, errors.UnsupportedSchema, "log.mcap", "compressed with 'brot'")
def unknown_compression(folder: Path) -> None:
    whole = log(folder).replace(b"\x04\0\0\0zstd", b"\x04\0\0\0brot")
    (folder / "log.mcap").write_bytes(whole)


@fault(11, 1, errors.LimitExceeded, "limit", "read.max_chunk_bytes")
def bomb(folder: Path) -> None:
    """A chunk of zeros: 16 kB that expand to 512 MiB, as its fields say."""
    import zstandard

    whole = log(folder, chunk_size=1 << 20)
    at = whole.index(b"\x04\0\0\0zstd") - 37
    assert whole[at] == 6
    length = int.from_bytes(whole[at + 1 : at + 9], "little")
    packer, zeros, packed = zstandard.ZstdCompressor().compressobj(512 << 20), bytes(1 << 20), bytearray()
    for _ in range(512):
        packed += packer.compress(zeros)
    packed += packer.flush()
    body = whole[at + 9 : at + 25] + struct.pack("<QI", 512 << 20, 0) + b"\x04\0\0\0zstd"
    chunk = b"\x06" + struct.pack("<Q", len(body) + 8 + len(packed)) + body
    (folder / "log.mcap").write_bytes(
        whole[:at] + chunk + struct.pack("<Q", len(packed)) + packed + whole[at + 9 + length :]
    )


@fault(13, 1, errors.TopicError, "no topic /pionts", "did you mean /points?", "/points (sensor_msgs/Point")
def no_such_topic(folder: Path) -> str:
    log(folder)
    return CONVERT + " --topic /pionts"


fault(
    14, 1, errors.NoScans, "no topic with scans", "/odom (nav_msgs/Odometry)", "scans are PointCloud2",
    name="no scans",
)(lambda _: recording([]))  # fmt: skip


@fault(14, 1, errors.NoScans, "livox_ros_driver/CustomMsg", "with xfer_format 0 the livox driver publishes")
def scans_of_a_type_of_their_driver(folder: Path) -> None:
    records = [("/livox/lidar", "livox_ros_driver/msg/CustomMsg", "ros2msg", b"uint8 line", b"\0\1\0\0\1")]
    raw_log(folder / "log.mcap", records)


@fault(14, 1, errors.NoScans, "/stereo/image (sensor_msgs/Image) holds depth images", "--topic /stereo/image")
def depth_images_that_are_not_called_so(folder: Path) -> list[Message]:
    images = [ros().image("/stereo/image", T0 + i, np.full((6, 8), 900, "<u2"), "16UC1") for i in range(3)]
    colours = ros().image("/left/image", T0, np.zeros((6, 8), np.uint8), "mono8")
    return [ros().camera("/stereo/camera_info", T0, 8, 6, 10.0), colours, *images]


@fault(16, 1, errors.NoScans, "/points (sensor_msgs/PointCloud2)", "no message in the log")
def topic_without_messages(folder: Path) -> None:
    raw_log(folder / "log.mcap", [("/points", CLOUD, "ros2msg", ros().schema(CLOUDS[0].type), b"")])


@fault(18, 1, errors.UnsupportedSchema, "/points: is of type std_msgs/String", "scans are PointCloud2")
def another_type(folder: Path) -> str:
    raw_log(folder / "log.mcap", [("/points", "std_msgs/msg/String", "ros2msg", b"string data", b"\0\1\0\0")])
    return CONVERT + " --topic /points"


fault(
    20, 3, None, "1 scans skipped (the message is no whole sensor_msgs/PointCloud2)",
    name="one message cut short",
)(lambda _: changed(lambda i: CLOUDS[i]._replace(data=CLOUDS[i].data[:-50]) if i == 5 else None))  # fmt: skip
fault(
    20, 1, errors.LogCorrupt, "/points: 4 of 12 scans are unreadable", "no whole sensor_msgs/PointCloud2",
    name="many messages cut short",
)(lambda _: changed(lambda i: CLOUDS[i]._replace(data=CLOUDS[i].data[:-50]) if i > 7 else None))  # fmt: skip


fault(
    29, 1, errors.PointCloudError, "every point is farther than 1000 m", "a global frame such as UTM",
    name="all scans in a global frame",
)(lambda _: changed(lambda i: cloud(i, planar_scan(0.1 * i) + np.float32([4e5, 5e6, 0]))))  # fmt: skip
fault(
    29, 0, None, same=True, name="one outlier",
)(
    lambda _: changed(lambda i: cloud(i, np.vstack((planar_scan(0.1 * i + 0.2), [[1e30, -1e30, 1e7]]))))
)  # fmt: skip


@fault(30, 0, None, "house.ply: it looks upside down", "--set read.up=-z")
def building_upside_down(folder: Path) -> str:
    write_cloud(folder / "house.ply", turned(rooms_cloud(), (1.0, 0.0, 0.0), 180.0))
    return "convert house.ply -o x.submaps"


fault(
    30, 0, None, "log: 12 lidar scans", "0 submaps", name="all points the same",
)(lambda _: changed(lambda i: cloud(i, np.full((500, 3), 2.0))))  # fmt: skip


fault(
    33, 0, None, "the time of recording is used instead", same=True, name="all stamps zero",
)(lambda _: changed(lambda i: cloud(i, stamp=0)))  # fmt: skip


fault(
    35, 1, errors.FrameError, "frame (empty)", "frames in the log: base_link, lidar", name="frame empty",
)(lambda _: changed(lambda i: cloud(i, frame="")))  # fmt: skip


@fault(36, 0, None, "frame lidar has two parents", "the latest counts", same=True)
def two_parents(folder: Path) -> list[Message]:
    wrong = ros().tf(T0 - 1, "mast", "lidar", 0.7, topic="/tf_static")
    return recording(CLOUDS, wrong)


@fault(38, 3, None, "registration was lost for 5 of 12 scans, first 0.7 s after", "they are not in the map")
def carried_off(folder: Path) -> str:
    """A robot is in another place from one scan to the next, and there is no odometry.

    Its lidar stands 0.3 m above the base: three rings are too few for a sensor in the hand.
    """
    rng = np.random.default_rng(38)
    elsewhere = rng.uniform(5, 9, (800, 3)).astype("f4")
    on_wheels = ros().tf(T0, "base_link", "lidar", 0.25, z_m=0.3, topic="/tf_static")
    clouds = [cloud(i, elsewhere + np.float32(0.5 * i)) if i > 6 else CLOUDS[i] for i in range(SCANS)]
    log(folder, recording(clouds, mount=[on_wheels]))
    return CONVERT + " --odometry none"


# --- faults 42 to 44: databases -----------------------------------------------------------------------


def database(change: Callable[[bytes], bytes], command: str) -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        store(folder / "x.submaps", [make_entry()], keep=False)
        (folder / "x.submaps").write_bytes(change((folder / "x.submaps").read_bytes()))
        log(folder)
        return command

    make.__name__ = command
    return make


def header(at: int, value: int) -> Callable[[bytes], bytes]:
    return lambda data: data[:at] + value.to_bytes(4, "big") + data[at + 4 :]


USES = ["db info x.submaps", "relocalize log.mcap --database x.submaps", "export x.submaps --map m"]
for _command in (*USES, CONVERT + " --add"):
    fault(43, 1, errors.DatabaseCorrupt, "x.submaps", "truncated")(database(lambda d: d[:-5000], _command))
    fault(44, 1, errors.DatabaseVersion, "database format 8; this pc2grid reads format 1", "a newer pc2grid")(
        database(header(60, 8), _command)
    )
for _change, _words in (
    (lambda d: bytes(reversed(d)), "x.submaps: not a pc2grid database"),
    (header(68, 0), "another program's SQLite file"),
    (lambda d: b"", "x.submaps: empty file"),
):
    fault(43, 1, errors.NotADatabase, _words)(database(_change, USES[1]))
fault(42, 1, errors.OutputError, "x.submaps: exists already and holds 'monday' instead of 'log'", "--force")(
    database(bytes, CONVERT)
)


# --- fault 46: maps, settings, names ----------------------------------------------------------


def plan(pixels: bytes = b"P5 40 40 255\n" + b"\xfe" * 1600, /, **keys: str) -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        map_of(folder, pixels, "m.pgm", **keys)
        return "convert m.yaml -o x.submaps"

    make.__name__ = " ".join(keys) or "pointer"
    return make


fault(46, 0, None, "m: 4 m2 free")(plan(resolution="5e-2"))
for _words, _keys in (
    ("none.pgm: cannot read the map's image", {"image": "../none.pgm"}),
    ("m.yaml: not readable as YAML", {"image": "!!python/object/apply:os.system ['touch pwned']"}),
    ("m.yaml: not readable as YAML", {"a": "&a [*a]\n\timage:"}),
    ("m.yaml: larger than 65536 bytes", {"more": "# " * 40_000}),
):
    fault(46, 1, errors.MapFileError, _words)(plan(**_keys))
fault(46, 1, errors.MapFileError, "m.pgm: a Git LFS pointer", "git lfs pull")(plan(POINTER))


@pytest.mark.parametrize("name", ["m.yaml", "m.ply", "m.stl", "clouds/0.pcd", "m.submaps"])
@pytest.mark.fault(4)
def test_pointers_of_git_in_place_of_files(tmp_path: Path, name: str, run: Callable[..., Any]) -> None:
    (tmp_path / "clouds").mkdir()
    (tmp_path / name).write_bytes(POINTER)
    code, _, said = run(f"info {name.split('/')[0]}", tmp_path)
    assert "git lfs pull" in said
    assert code == (0 if name.startswith("clouds") else 1)


@fault(46, 2, errors.ConfigError, "bad.toml", "not TOML")
def settings_that_are_none(folder: Path) -> str:
    log(folder)
    (folder / "bad.toml").write_bytes(b"\x80\x04 a pickle, of all things")
    return CONVERT + " --config bad.toml"


@fault(46, 0, None, same=True)
def odd_names(folder: Path) -> str:
    log(folder)
    name = "a b\n'\"?#%20é.mcap"
    (folder / "log.mcap").rename(folder / name)
    return f"convert {shlex.quote(name)} -o x.submaps --name log"


@fault(46, 0, None, same=True)
def name_that_is_no_text(folder: Path) -> str:
    log(folder)
    (folder / "log.mcap").rename(folder / os.fsdecode(b"\xff\xfe.mcap"))
    return f"convert {os.fsdecode(bytes([255, 254]))}.mcap -o x.submaps --name log"


@fault(46, 0, None, r"\udcff\udcfe: 12 lidar scans")
def session_named_after_it(folder: Path) -> str:
    return name_that_is_no_text(folder).replace(" --name log", "")


# --- running them -------------------------------------------------------------------------------------


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[[str, Path], tuple[int, BaseException | None, str]]:
    """Run a command in a folder, within this process: exit code, error, and everything printed."""
    from pc2grid_cli.main import main

    plain = console.Console.report_error

    def run(command: str, folder: Path) -> tuple[int, BaseException | None, str]:
        raised: list[BaseException] = []

        def noted(terminal: console.Console, error: BaseException) -> int:
            raised.append(error)
            return plain(terminal, error)

        monkeypatch.setattr(console.Console, "report_error", noted)
        monkeypatch.setattr(sys, "argv", ["pc2grid", *shlex.split(command)])
        monkeypatch.chdir(folder)
        monkeypatch.setenv("PC2GRID_CONFIG", "")
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        said = capfd.readouterr()
        return ended.value.code, raised[0] if raised else None, said.out + said.err

    return run


def content(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def session_of(database: Path) -> list[bytes]:
    """Everything in its one session except where that came from."""
    with open_database(database) as opened:
        (info,) = opened.sessions()
        table, trajectory = opened.signatures(), opened.trajectory(info.name)
        grids = [opened.grid(info.name), *(submap.grid for submap in opened.submaps(info.name))]
        arrays = [table.boundary, table.freespace, table.symmetry, table.center_m, trajectory.T_session_base]
        return [
            info.name.encode(),
            repr([(grid.origin_m, grid.resolution_m, grid.cells.shape) for grid in grids]).encode(),
            *(grid.cells.tobytes() for grid in grids),
            *(np.ascontiguousarray(array).tobytes() for array in (*arrays, trajectory.stamps_ns)),
        ]


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """The map of the undamaged recording."""
    from signature.config import Config
    from signature.sessions import add_session, build_session

    folder = tmp_path_factory.mktemp("clean")
    log(folder)
    session, origin = build_session(folder / "log.mcap", "log", Config())
    assert not session.report.lossy
    add_session(folder / "x.submaps", session, Config(), origin)
    return session_of(folder / "x.submaps")


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.number} {case.name}")
def test_fault(case: Case, tmp_path: Path, clean: list[bytes], run: Callable[..., Any]) -> None:
    made = case.make(tmp_path)
    if isinstance(made, list):
        log(tmp_path, made)
    command = f"{made if isinstance(made, str) else CONVERT} {case.flags}"
    before = content(tmp_path)
    peak = Peak()
    code, error, said = run(command, tmp_path)
    assert (code, type(error)) == (case.code, case.error or type(None)), said
    for words in case.words:
        assert words in said, said
    assert "Traceback" not in said
    left = content(tmp_path)
    if case.error is None:
        assert check(tmp_path / "x.submaps") == ()
        assert (session_of(tmp_path / "x.submaps") == clean) or not case.same
        assert left.keys() - before.keys() == {"x.submaps"}
        del left["x.submaps"]
    else:
        lines = [line for line in said.splitlines() if not line.startswith("pc2grid: warning")]
        assert len(lines) <= 2
        assert lines[0].startswith("pc2grid: error: ")
        assert all(line.startswith("hint: ") for line in lines[1:])
    assert left == before
    assert peak.grown_bytes() < 300 << 20


@pytest.mark.fault(46)
def test_names_that_a_terminal_would_obey(tmp_path: Path, run: Callable[..., Any]) -> None:
    to = ros()
    clear = "\x1b[2J\n\x07"
    mount = to.tf(T0, "base_link", f"li{clear}dar", 0.25, topic="/tf_static")
    clouds = [cloud(i, frame=f"li{clear}dar") for i in range(SCANS)]
    log(tmp_path, recording([c._replace(topic=f"/points{clear}") for c in clouds], mount=[mount]))
    for command, shown in (
        ("info log.mcap", r"/points\x1b[2J\n\x07"),
        (
            f"convert log.mcap -o x.submaps --name {shlex.quote(f'a{clear}b')}",
            r"a\x1b[2J\n\x07b: 12 lidar scans",
        ),
        ("db info x.submaps", r"a\x1b[2J\n\x07b (lidar)"),
    ):
        code, _, said = run(command, tmp_path)
        assert code == 0
        assert shown in said
        assert "\x1b" not in said
        assert "\x07" not in said


@pytest.mark.fault(5)
def test_a_cut_at_every_boundary_of_a_record(tmp_path: Path) -> None:
    """A cut between two records looks like a killed recorder, and is warned of; any other cut is refused."""
    whole = write_mcap(tmp_path / "whole.mcap", drive(), chunk_size=400).read_bytes()
    scans = [scan.points_m.tobytes() for scan in read(tmp_path / "whole.mcap")[0]]
    boundaries, at = [], 8
    while at < len(whole) - 8:
        at += 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
        boundaries.append(at)
    assert len(boundaries) > 40
    path = tmp_path / "cut.mcap"
    outcomes = {"whole": 0, "part": 0, "refused": 0}
    for cut in sorted({b + d for b in boundaries for d in (-1, 0, 1)}):
        path.write_bytes(whole[:cut])
        try:
            found, report = read(path)
        except Pc2GridError as error:
            assert "cut.mcap" in error.message
            outcomes["refused"] += 1
        else:
            points = [scan.points_m.tobytes() for scan in found]
            assert points == scans[: len(points)]
            assert report.warnings or points == scans
            outcomes["whole" if points == scans else "part"] += 1
        try:
            found, report = read(path, recover=True)
        except Pc2GridError:
            continue
        points = [scan.points_m.tobytes() for scan in found]
        assert points == scans[: len(points)]
        assert report.warnings or points == scans
    assert min(outcomes.values()) > 5, outcomes


NUMBERED = r"^(?:@pytest\.mark\.|@| *)(?:fault|refused)\(\s*(\d+)"


def test_every_case_of_the_catalogue_has_a_test() -> None:
    marked = {
        int(number)
        for path in Path(__file__).parent.rglob("test_*.py")
        for number in re.findall(NUMBERED, path.read_text(), re.MULTILINE)
    }
    assert sorted(set(range(1, 47)) - marked) == []
    listed = {int(number) for number in re.findall(r"(?:^ ?|  )(\d+) [a-zA-Z]", __doc__ or "", re.MULTILINE)}
    assert listed == set(range(1, 47))
