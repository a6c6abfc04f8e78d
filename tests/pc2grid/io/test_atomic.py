"""Writers of one file in processes that have the same number, as in two containers that share a folder."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pc2grid.errors import OutputError
from pc2grid.io import atomic
from pc2grid.io.atomic import replace_file, require_writable
from signature.database import open_database

ROOT = Path(__file__).resolve().parents[3]
# Waits with the half-written file until a line comes; what it wrote is complete when it has ended.
WRITER = """
import os, sys
os.getpid = lambda: 1
from pc2grid.io.atomic import replace_file, require_writable
path, content = sys.argv[1:]
require_writable(path, overwrite=True)
with replace_file(path) as temporary, temporary.open("w") as file:
    file.write(content[:3])
    file.flush()
    print("half", flush=True)
    sys.stdin.readline()
    file.write(content[3:])
"""
STORE = """
import os, sys
os.getpid = lambda: 1
from pathlib import Path
from pc2grid_cli.output import check_database
from signature.database.maintenance import store
from tests.helpers.databases import make_entry

database, name = sys.argv[1:]
check_database(database)
print("may be written", flush=True)
flush = os.fsync

def wait(descriptor):  # the copy is complete, but not in its place
    os.fsync = flush
    print("nearly", flush=True)
    sys.stdin.readline()

os.fsync = wait
store(Path(database), [make_entry(name, 1)], keep=True)
"""


class Container:
    """A process that believes to be number 1."""

    def __init__(self, code: str, *arguments: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tools'}"},
        )

    def says(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def ends(self) -> tuple[int, str]:
        _, said = self.process.communicate("go on\n", timeout=120)
        return self.process.returncode, said


def test_two_processes_of_the_same_number_write_the_same_file(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    first = Container(WRITER, target, "first writer")
    assert first.says() == "half"
    second = Container(WRITER, target, "second writer")
    assert second.says() == "half"
    require_writable(target, overwrite=True)  # a third one looks only
    assert second.ends() == (0, "")
    assert target.read_text() == "second writer"
    assert first.ends() == (0, "")
    assert target.read_text() == "first writer"  # the last one stays
    assert list(tmp_path.iterdir()) == [target]


def test_two_processes_of_the_same_number_add_to_the_same_database(tmp_path: Path) -> None:
    """Each looks whether it can write, as `convert --add` does before its work; the other one writes then."""
    target = tmp_path / "b.submaps"
    first = Container(STORE, target, "monday")
    assert (first.says(), first.says()) == ("may be written", "nearly")
    second = Container(STORE, target, "tuesday")
    assert second.says() == "may be written"
    assert first.ends() == (0, "")
    assert second.says() == "nearly"
    assert second.ends() == (0, "")
    with open_database(target) as database:
        assert sorted(info.name for info in database.sessions()) == ["monday", "tuesday"]
    assert list(tmp_path.iterdir()) == [target]


def test_what_a_killed_process_left_is_swept_by_the_next(tmp_path: Path) -> None:
    """Also if its number is in use, as 1 always is."""
    target = tmp_path / "a.txt"
    killed = Container(WRITER, target, "never complete")
    assert killed.says() == "half"
    (left_over,) = tmp_path.iterdir()
    killed.process.kill()
    killed.process.communicate()
    assert left_over.exists()
    with replace_file(target) as temporary:
        assert list(tmp_path.iterdir()) == [temporary]
        temporary.write_text("whole")
    assert list(tmp_path.iterdir()) == [target]


def test_looking_whether_a_file_can_be_written_removes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name that is taken is another one's, whatever it is: the next one is tried."""
    names = iter(["00000000", "00000001", "00000002"])
    monkeypatch.setattr(atomic.secrets, "token_hex", lambda size: next(names))
    mine, link = (tmp_path / f".a.pc2grid-0000000{k}.tmp" for k in range(2))
    mine.write_text("precious")
    (tmp_path / "elsewhere").write_text("as well")
    link.symlink_to("elsewhere")
    require_writable(tmp_path / "a", overwrite=False)
    assert mine.read_text() == "precious" and link.is_symlink()
    assert (tmp_path / "elsewhere").read_text() == "as well"
    assert sorted(tmp_path.iterdir()) == sorted([mine, link, tmp_path / "elsewhere"])


def test_a_file_that_is_swept_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, taken = atomic.fcntl.flock, []

    def flock(descriptor: int, how: int) -> None:
        if not taken:
            taken.extend(tmp_path.iterdir())
            taken[0].unlink()
        plain(descriptor, how)

    monkeypatch.setattr(atomic.fcntl, "flock", flock)
    with replace_file(tmp_path / "a") as temporary:
        assert temporary != taken[0]
        temporary.write_text("whole")
    assert (tmp_path / "a").read_text() == "whole"


def test_threads_write_the_same_file(tmp_path: Path) -> None:
    """Each completely; they are one process."""
    problems: list[BaseException] = []

    def write(content: str) -> None:
        try:
            for _ in range(50):
                with replace_file(tmp_path / "a") as temporary:
                    temporary.write_text(content)
        except BaseException as problem:
            problems.append(problem)

    threads = [threading.Thread(target=write, args=(letter * 1000,)) for letter in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems
    content = (tmp_path / "a").read_text()
    assert len(content) == 1000 and len(set(content)) == 1
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="there is no /proc here")
def test_a_folder_that_exists_is_not_to_be_created() -> None:
    for check in (
        lambda path: require_writable(path, overwrite=False),
        lambda path: replace_file(path).__enter__(),
    ):
        with pytest.raises(OutputError, match=r"/proc/x\.submaps: cannot write") as caught:
            check(Path("/proc/x.submaps"))
        assert caught.value.hint == "choose a folder you may write to"
        with pytest.raises(OutputError, match="no folder /nowhere/here") as caught:
            check(Path("/nowhere/here/x.submaps"))
        assert caught.value.hint == "create the folder first"
