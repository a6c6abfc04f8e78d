"""Interrupted at any moment, a database is the old one or the new one, and the next run finishes the work.

`PC2GRID_FUZZ=N` makes the random tests long.
"""

import dataclasses
import errno
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.errors import LogNotFound, MapFileError, NotADatabase, OutputError
from pc2grid.io.export import LogWriter
from pc2grid.io.maps import load_map, save_map
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import write_kitti, write_tum
from pc2grid.model import Trajectory
from pc2grid.simulate import SimulationConfig, simulate_session
from pc2grid_cli.main import app
from signature.database import open_database
from signature.database.maintenance import store
from tests.helpers.databases import MONDAY, assert_holds, make_entry
from tests.helpers.rooms import small_house
from tests.helpers.shared_folders import shared_folder

ROOT = Path(__file__).resolve().parents[3]
FUZZ = int(os.environ.get("PC2GRID_FUZZ", "0"))
WRITER = tuple(str(ROOT / name) for name in ("signature/database/", "pc2grid/io/atomic.py"))


@shared_folder()
def inputs(folder: Path) -> None:
    """A folder with a map, a laser recording of a few metres, and the databases of both."""
    save_map(small_house(), folder / "house")
    config = SimulationConfig(length_m=1.5, seed=5, clutter=0)
    simulate_session(folder / "drive.mcap", sensor="laser", grid=small_house(), config=config)
    for source, made in (("drive.mcap", "drive.submaps"), ("house.yaml", "house.submaps")):
        done = Convert(folder / source, "-o", made, cwd=folder).wait()
        assert done == 0
    shutil.copyfile(folder / "drive.submaps", folder / "both.submaps")
    assert Convert(folder / "house.yaml", "-o", "both.submaps", "--add", cwd=folder).wait() == 0


# A server that has the libraries loaded forks each of them, so that kills meet the work and not the start.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        "pc2grid_cli.main",
        "signature.session.build",
        "pc2grid.estimation.tracker",
        "pc2grid.submaps.submaps",
        "pc2grid.io.containers.mcap",
        "signature.sessions",
        "signature.paper",
        "signature.database.sqlite",
        "signature.database.maintenance",
        "pydantic",
        "kiss_icp.kiss_icp",
        "rich.progress",
    ]
)


def _main(arguments: list[str], cwd: str, said: str, before: str, limit_bytes: int | None) -> None:
    from pc2grid_cli.main import main

    signal.signal(signal.SIGINT, signal.default_int_handler)  # the server ignores Ctrl-C
    os.chdir(cwd)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(os.open(said, os.O_WRONLY), 2)
    if limit_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))
    exec(before, {})
    sys.argv = ["pc2grid", "convert", *arguments]
    main()


class Convert:
    """`pc2grid convert` on its way.

    before : code to run first. limit_bytes : the largest file that it may write.
    """

    def __init__(
        self, *arguments: object, cwd: Path, before: str = "", limit_bytes: int | None = None
    ) -> None:
        self._said = tempfile.NamedTemporaryFile()  # noqa: SIM115 - closed with this object
        rest = (str(cwd), self._said.name, before, limit_bytes)
        self.process = SERVER.Process(target=_main, args=([str(a) for a in arguments], *rest))
        self.process.start()

    def wait(self) -> int:
        """Its exit code; negative for the signal that ended it."""
        self.process.join(120)
        assert self.process.exitcode is not None
        return self.process.exitcode

    def said(self) -> str:
        return Path(self._said.name).read_text()


def in_child(body: Callable[[], object]) -> tuple[int, str]:
    """Run in a forked process: its exit status by `waitpid`, and the traceback if it raised."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            body()
            code = 0
        except BaseException:
            os.write(writing, traceback.format_exc().encode()[-4000:])
        finally:
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        said = pipe.read()
    return os.waitpid(child, 0)[1], said


# --- fault 40: kill -9 --------------------------------------------------------------------------------


@pytest.mark.fault(40)
@pytest.mark.nightly
@pytest.mark.parametrize("part", range(4 if FUZZ else 1))
@pytest.mark.parametrize("adding", [False, True])
def test_fuzz_kill_at_random_moments_of_convert(
    inputs: Path, tmp_path: Path, part: int, adding: bool
) -> None:
    """Every second one while the temporary file is there, the others anywhere from the start."""
    rng, output = np.random.default_rng([40, part]), tmp_path / "x.submaps"
    source = inputs / ("drive.mcap" if FUZZ and not adding else "house.yaml")
    old = (inputs / "drive.submaps").read_bytes() if adding else b""
    new = (inputs / ("both.submaps" if adding else f"{source.stem}.submaps")).read_bytes()
    usual_s = 1.0
    killed = turn = 0
    while killed < (min(FUZZ, 200) // 4 or 5):  # those that were done before they were hit do not count
        turn += 1
        if adding:
            output.write_bytes(old)
        convert = Convert(source, "-o", output, *["--add"] * adding, cwd=tmp_path)
        if turn % 2:
            while convert.process.is_alive() and len(list(tmp_path.iterdir())) <= adding:
                time.sleep(0.002)
            time.sleep(float(rng.uniform(0, 0.01)))
        else:
            time.sleep(float(rng.uniform(0.0, usual_s)))
        convert.process.kill()
        killed += convert.wait() == -signal.SIGKILL
        assert (output.read_bytes() if output.exists() else b"") in (old, new)
        begin = time.monotonic()
        rerun = Convert(source, "-o", output, "--add" if adding else "--force", cwd=tmp_path)
        assert rerun.wait() == 0, rerun.said()
        usual_s = time.monotonic() - begin
        assert output.read_bytes() == new
        assert list(tmp_path.iterdir()) == [output]
        output.unlink()
    assert turn < 3 * killed + 10


@pytest.mark.fault(40)
def test_fuzz_kill_at_every_line_of_the_writer(tmp_path: Path) -> None:
    """Exact where the clock is not: a forked writer kills itself before the N-th line it would run."""
    path = tmp_path / "x.submaps"
    store(path, [MONDAY], keep=False)
    old = path.read_bytes()
    added = make_entry("tuesday", 1)
    store(path, [added], keep=True)
    new = path.read_bytes()

    def die_before_line(number: int) -> tuple[int, str]:
        seen = 0

        def trace(frame: FrameType, event: str, argument: Any) -> Any:
            nonlocal seen
            if not frame.f_code.co_filename.startswith(WRITER):
                return None
            if event == "line":
                seen += 1
                if seen == number:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace

        def body() -> None:
            sys.settrace(trace)
            store(path, [added], keep=True)

        return in_child(body)

    rng = np.random.default_rng(41)
    states = {"old": 0, "new": 0}
    number = 1
    while True:
        path.write_bytes(old)
        status, said = die_before_line(number)
        if status == 0:
            break
        assert os.WIFSIGNALED(status), said
        assert path.read_bytes() in (old, new)
        states["old" if path.read_bytes() == old else "new"] += 1
        store(path, [added], keep=True)
        assert path.read_bytes() == new
        assert list(tmp_path.iterdir()) == [path]
        number += 1 if FUZZ else int(rng.integers(8, 41))
    assert path.read_bytes() == new
    assert number > 100
    assert states["old"] > 5
    if FUZZ:
        assert states["new"] > 0


# --- fault 41: signals --------------------------------------------------------------------------------


@pytest.mark.fault(41)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_in_the_middle_of_writing(inputs: Path, tmp_path: Path, number: int, code: int) -> None:
    output = tmp_path / "x.submaps"
    shutil.copyfile(inputs / "drive.submaps", output)
    at_the_second_row = (
        "import os\n"
        "from signature.database import maintenance\n"
        "plain, calls = maintenance._insert, []\n"
        "def insert(*arguments):\n"
        f"    calls.append(1); len(calls) == 2 and os.kill(os.getpid(), {int(number)})\n"
        "    return plain(*arguments)\n"
        "maintenance._insert = insert\n"
    )
    process = Convert(inputs / "house.yaml", "-o", output, "--add", cwd=tmp_path, before=at_the_second_row)
    found, said = process.wait(), process.said()
    assert found == code, said
    assert "Traceback" not in said
    assert ("interrupted: each file is complete, or as it was before" in said) == (number == signal.SIGINT)
    assert output.read_bytes() == (inputs / "drive.submaps").read_bytes()
    assert list(tmp_path.iterdir()) == [output]
    assert Convert(inputs / "house.yaml", "-o", output, "--add", cwd=tmp_path).wait() == 0
    assert output.read_bytes() == (inputs / "both.submaps").read_bytes()


@pytest.mark.fault(41)
def test_reader_that_has_seen_enough_is_no_error(inputs: Path) -> None:
    """Like `| head` that ends at once: the output is never read."""
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-c", "from pc2grid_cli.main import main; main()", "db", "check", "both.submaps"],
        cwd=inputs, stdout=writing, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"},
    )  # fmt: skip
    os.close(writing)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, "")


# --- fault 39: what the system refuses ----------------------------------------------------------------


@pytest.mark.fault(39)
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_fail_the_nth_call_of_a_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    path = tmp_path / "x.submaps"
    store(path, [MONDAY], keep=False)
    old = path.read_bytes()
    store(path, [make_entry("tuesday", 1)], keep=True)
    new = path.read_bytes()
    outcomes: list[str] = []
    reached = fail_at = 0

    def failing(name: str) -> Callable[..., Any]:
        plain = getattr(os, name)

        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal reached
            reached += 1
            if reached == fail_at:
                outcomes.append(name)
                raise OSError(number, os.strerror(number))
            return plain(*arguments, **options)

        return call

    for name in ("open", "fsync", "replace", "ftruncate", "pwrite", "sendfile", "copy_file_range"):
        if hasattr(os, name):
            monkeypatch.setattr(os, name, failing(name))
    refused = set()
    while True:
        path.write_bytes(old)
        reached, fail_at = 0, fail_at + 1
        try:
            store(path, [make_entry("tuesday", 1)], keep=True)
        except OutputError as error:
            assert path.read_bytes() == old
            assert str(path) in error.message
            assert os.strerror(number) in error.message
            assert error.hint
            refused.add(outcomes[-1])
        else:
            # Neither the holder's name nor the flushing of the folder's entry is worth a failure.
            assert path.read_bytes() == new
        assert list(tmp_path.iterdir()) == [path]
        if reached < fail_at:
            break
    assert refused >= {"open", "fsync", "replace"}


@pytest.mark.fault(39)
def test_disk_full_at_every_page_of_a_write(tmp_path: Path) -> None:
    """A limit on the size of files stops SQLite's own writing, from the first page to the last."""
    path = tmp_path / "x.submaps"
    store(path, [MONDAY], keep=False)
    old = path.read_bytes()
    added = make_entry("tuesday", 1)
    store(path, [added], keep=True)
    new = path.read_bytes()

    def write_with(limit: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        with pytest.raises(OutputError, match="cannot write") as caught:
            store(path, [added], keep=True)
        assert str(path) in caught.value.message
        assert caught.value.hint

    path.write_bytes(old)
    for limit in [0, 100, *range(4096, len(new), 4096), len(new) - 1]:
        status, said = in_child(lambda limit=limit: write_with(limit))
        assert status == 0, said
        assert path.read_bytes() == old
        assert list(tmp_path.iterdir()) == [path]
    store(path, [added], keep=True)
    assert path.read_bytes() == new


def write_cloud_log(path: Path) -> None:
    with LogWriter.to(path, overwrite=True) as out:
        out.point_cloud("/points", 10**18, "lidar", np.random.default_rng(1).random((500, 3), np.float32))


EXPORTS: dict[str, Callable[[Path], object]] = {
    "a.tum": lambda path: write_tum(path, TRAJECTORY),
    "a.kitti": lambda path: write_kitti(path, TRAJECTORY),
    "a.mcap": write_cloud_log,
    "a.pgm": lambda path: save_map(small_house(), path.with_suffix("")),
    "a.png": lambda path: save_map(small_house(), path.with_suffix(""), image_format="png"),
}
TRAJECTORY = Trajectory(stamps_ns=np.arange(200), T_session_base=np.stack([np.eye(4)] * 200))


@pytest.mark.fault(39)
@pytest.mark.parametrize("name", EXPORTS)
@pytest.mark.parametrize("there", ["nothing", "an old one"])
def test_disk_full_while_exporting(tmp_path: Path, name: str, there: str) -> None:
    path = tmp_path / name
    EXPORTS[name](path)
    size = path.stat().st_size
    for file in tmp_path.iterdir():
        file.unlink()
    if there == "an old one":
        path.write_bytes(b"old")
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}

    def export(limit: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        with pytest.raises(OutputError, match=f"{name}: cannot write: File too large") as caught:
            EXPORTS[name](path)
        assert caught.value.hint

    for limit in (0, 1, size // 2, size - 1):
        status, said = in_child(lambda limit=limit: export(limit))
        assert status == 0, said
        assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.fault(39)
def test_map_and_image_change_together(tmp_path: Path, monkeypatch) -> None:
    house = small_house()
    save_map(house, tmp_path / "a")
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}

    def full(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    other = dataclasses.replace(house, cells=np.full_like(house.cells, 100))
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match=r"a\.yaml: cannot write: No space left"):
        save_map(other, tmp_path / "a")
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.fault(39)
def test_disk_full_is_one_line_and_exit_1(inputs: Path, tmp_path: Path) -> None:
    process = Convert(inputs / "house.yaml", "-o", "x.submaps", cwd=tmp_path, limit_bytes=8192)
    code, said = process.wait(), process.said()
    assert code == 1, said
    lines = said.splitlines()
    assert lines[0].startswith("pc2grid: error: x.submaps: cannot write")
    assert lines[1].startswith("hint: ")
    assert len(lines) == 2
    assert list(tmp_path.iterdir()) == []


SMALL_DISK = """
import subprocess, sys
from pathlib import Path
from pc2grid.errors import OutputError
from signature.database.maintenance import store
from tests.helpers.databases import MONDAY, make_entry

disk, path = Path(sys.argv[1]), Path(sys.argv[1]) / "x.submaps"
mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk]
if subprocess.run(mount, capture_output=True).returncode:
    sys.exit(77)
store(path, [MONDAY], keep=False)
old, outcomes = path.read_bytes(), []
for pages in range(len(old) // 4096, 4 * len(old) // 4096):
    path.write_bytes(old)
    subprocess.run(["mount", "-o", f"remount,size={4 * pages}k", disk], check=True)
    try:
        store(path, [make_entry("tuesday", 1)], keep=True)
        outcomes.append("new")
    except OutputError as error:
        assert str(path) in error.message and "cannot write" in error.message, error
        assert error.hint == "free some space, or write to another disk", error
        assert path.read_bytes() == old
        outcomes.append("old")
    assert list(disk.iterdir()) == [path], list(disk.iterdir())
assert outcomes == sorted(outcomes, reverse=True) and {*outcomes} == {"old", "new"}, outcomes
"""


@pytest.mark.fault(39)
def test_disk_that_is_really_full(tmp_path: Path) -> None:
    """A disk of memory, in a name space of its own, from room for nothing more to room enough."""
    command = ["unshare", "--user", "--map-root-user", "--mount", sys.executable, "-c", SMALL_DISK, tmp_path]
    if shutil.which("unshare") is None or shutil.which("mount") is None:
        pytest.skip("no unshare or mount in this system")
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip("this system lets nobody mount a disk of memory")
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []


def as_nobody(body: Callable[[], object]) -> None:
    """Run the body without root's privileges to read and write what it likes."""

    def run() -> None:
        if os.geteuid() == 0:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
        body()

    status, said = in_child(run)
    assert status == 0, said


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that any user may enter; those of pytest are for the one who runs it."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


@pytest.mark.fault(1)
def test_log_that_may_not_be_read(open_folder: Path) -> None:
    path = open_folder / "log.mcap"
    path.write_bytes(b"secret")
    path.chmod(0)

    def body() -> None:
        with pytest.raises(LogNotFound, match=r"log\.mcap: Permission denied"):
            open_log(path)
        with pytest.raises(NotADatabase, match=r"log\.mcap: cannot be read: Permission denied"):
            open_database(path)
        with pytest.raises(MapFileError, match=r"log\.mcap: Permission denied"):
            load_map(path)

    as_nobody(body)
    assert list(open_folder.iterdir()) == [path]


@pytest.mark.fault(39)
def test_folder_that_refuses(open_folder: Path) -> None:
    path, file = open_folder / "x.submaps", open_folder / "file"
    store(path, [MONDAY], keep=False)
    file.write_text("mine")
    before = path.read_bytes()

    def body() -> None:
        with pytest.raises(OutputError, match=r"new\.submaps: cannot write: Permission denied") as caught:
            store(open_folder / "new.submaps", [make_entry()], keep=False)
        assert caught.value.hint
        with pytest.raises(OutputError, match=r"x\.submaps: cannot write: Permission denied"):
            store(path, [make_entry("tuesday", 1)], keep=True)
        with open_database(path) as database:
            assert_holds(database, MONDAY)

    open_folder.chmod(0o555)
    as_nobody(body)
    with pytest.raises(OutputError, match="Not a directory"):
        store(file / "new.submaps", [make_entry()], keep=False)
    open_folder.chmod(0o755)
    with pytest.raises(OutputError, match="folder"):
        store(open_folder, [make_entry()], keep=False)
    assert path.read_bytes() == before
    assert sorted(open_folder.iterdir()) == [file, path]


def test_symbolic_link_is_followed(tmp_path: Path) -> None:
    path, link = tmp_path / "x.submaps", tmp_path / "link.submaps"
    link.symlink_to(path.name)
    store(link, [MONDAY], keep=False)
    store(link, [make_entry("tuesday", 1)], keep=True)
    assert link.is_symlink()
    with open_database(path) as database:
        assert [info.name for info in database.sessions()] == ["monday", "tuesday"]
    assert sorted(tmp_path.iterdir()) == [link, path]


# --- fault 42: not the run that was interrupted -------------------------------------------------------


@pytest.mark.fault(42)
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("drive.mcap", "made from the same input with the same settings"),
        ("drive.mcap --set partition.radius_m=3.5", "made with partition.radius_m = 5.0, not 3.5"),
        ("drive.mcap --start 0.5", "made with start = 0.0, not 0.5"),
        ("house.yaml", "holds 'drive' instead of 'house'"),
        ("house.yaml --name drive", "made from a file 'drive.mcap' with other content"),
    ],
)
def test_another_run_onto_the_same_file_is_refused_with_the_difference(
    inputs: Path, arguments: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, folder = (inputs / "drive.submaps").read_bytes(), sorted(inputs.iterdir())
    monkeypatch.chdir(inputs)
    error = CliRunner().invoke(app, ["convert", *arguments.split(), "-o", "drive.submaps"]).exception
    assert isinstance(error, OutputError), error
    assert error.message.startswith("drive.submaps: exists already") and words in error.message
    assert error.hint is not None and "--force" in error.hint
    assert (inputs / "drive.submaps").read_bytes() == before
    assert sorted(inputs.iterdir()) == folder
