"""Many recordings at once: what a cluster makes is what one process makes, and what is done stays done."""

import gc
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import ClusterError, ConfigError
from pc2grid.io.maps import save_map
from pc2grid.model import OccupancyGrid, part_name
from pc2grid_cli.main import app
from signature import conversion_jobs
from signature.config import Config
from signature.conversion_jobs import Job, Outcome, at_once, on_cluster
from signature.database import maintenance, open_database
from signature.sessions import build_sessions
from tests.helpers import postgresql
from tests.helpers.interruptible import interruptible
from tests.helpers.shared_folders import shared_folder

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")
NAMES = ("kitchen", "hall", "cellar", "attic")


@shared_folder()
def folder(folder: Path) -> None:
    """Maps of a few rooms, whole.submaps of them, and a file that is not a map."""
    for number, name in enumerate(NAMES):
        cells = np.zeros((70, 80 + 10 * number), np.int8)
        cells[:3], cells[-3:], cells[:, :3], cells[:, -3:] = 100, 100, 100, 100
        cells[30:33, : 20 + 10 * number] = 100
        save_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)), folder / name)
    (folder / "ruin.yaml").write_text("resolution: 0.05\norigin: [0, 0, 0]\n")
    assert run("convert", *inputs(folder, *NAMES), "-o", folder / "whole.submaps") == 0


@pytest.fixture(scope="module")
def processes() -> Iterator[Any]:
    """A scheduler with two workers of one thread each."""
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as made:
        yield made


def job(folder: Path, name: str) -> Job:
    return Job(path=folder / f"{name}.yaml", name=name, config=Config())


def run(*arguments: object) -> int:
    """The program, in this process."""
    code = app([str(argument) for argument in arguments], prog_name="pc2grid", standalone_mode=False)
    return code or 0


def inputs(folder: Path, *names: str) -> list[Path]:
    return [folder / f"{name}.yaml" for name in names]


def test_the_cluster_makes_the_same_bytes(
    folder: Path, processes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    together, address = tmp_path / "together.submaps", processes.scheduler_address
    assert run("convert", *inputs(folder, *NAMES), "-o", together, "--dask", address) == 0
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()[:4]] == list(NAMES)
    assert (folder / "whole.submaps").read_bytes() == together.read_bytes()


def test_what_is_stored_is_not_done_again(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, database = folder / "whole.submaps", tmp_path / "x.submaps"
    assert run("convert", *inputs(folder, *NAMES[:2]), "-o", database) == 0
    built: list[str] = []

    def noted(path: Path, *rest: Any, **more: Any) -> Any:
        built.append(path.stem)
        return build_sessions(path, *rest, **more)

    monkeypatch.setattr(conversion_jobs, "build_sessions", noted)
    capsys.readouterr()
    assert run("convert", *inputs(folder, *NAMES), "-o", database, "--json") == 0
    out, err = capsys.readouterr()
    assert built == list(NAMES[2:])
    assert json.loads(out)["unchanged"] == list(NAMES[:2])
    assert "kitchen: stored already" in err
    assert database.read_bytes() == whole.read_bytes()


def test_the_parts_of_a_recording_are_stored_together(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A session for each part of a recording; all are known again by the name of the first."""

    def divided(path: Path, name: str, config: Config, **more: Any) -> Any:
        (whole,), origin = build_sessions(path, name, config, **more)
        return tuple(replace(whole, session=part_name(name, k)) for k in range(2)), origin

    monkeypatch.setattr(conversion_jobs, "build_sessions", divided)
    database = tmp_path / "x.submaps"
    assert run("convert", *inputs(folder, *NAMES[:2]), "-o", database) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:4]] == ["kitchen", "kitchen#2", "hall", "hall#2"]
    before = database.read_bytes()
    assert run("convert", *inputs(folder, *NAMES[:2]), "-o", database, "--json") == 0
    assert json.loads(capsys.readouterr().out)["unchanged"] == list(NAMES[:2])
    assert database.read_bytes() == before
    monkeypatch.undo()
    assert run("convert", *inputs(folder, NAMES[0]), "-o", database, "--add", "--force") == 0
    with open_database(database) as opened:
        assert sorted(info.name for info in opened.sessions()) == ["hall", "hall#2", "kitchen"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--set", "partition.radius_m=4"], r"partition\.radius_m = 5\.0, not 4\.0"),
        (["--building", "B"], "building = None, not 'B'"),
    ],
)
def test_other_settings_are_refused_before_any_work(
    folder: Path, tmp_path: Path, change: list[str], words: str
) -> None:
    database = tmp_path / "x.submaps"
    assert run("convert", *inputs(folder, *NAMES[:2]), "-o", database) == 0
    before = database.read_bytes()
    for more in ([], ["--add"]):
        with pytest.raises(Exception, match=words):
            run("convert", *inputs(folder, *NAMES), "-o", database, *change, *more)
    with pytest.raises(Exception, match="holds 'hall', 'kitchen' instead of 'hall', 'cellar'"):
        run("convert", *inputs(folder, "hall", "cellar"), "-o", database)
    assert database.read_bytes() == before


def test_changed_input_is_named_and_the_others_are_done(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copies = [tmp_path / path.name for path in inputs(folder, *NAMES)]
    for name in NAMES:
        for suffix in (".yaml", ".pgm"):
            (tmp_path / f"{name}{suffix}").write_bytes((folder / f"{name}{suffix}").read_bytes())
    database = tmp_path / "x.submaps"
    assert run("convert", *copies[:2], "-o", database) == 0
    with copies[0].open("a") as file:
        file.write("# touched\n")
    capsys.readouterr()
    assert run("convert", *copies, "-o", database) == 3
    err = capsys.readouterr().err
    assert "session 'kitchen' made from another file" in err
    assert f"1 of 4 failed: {copies[0]}" in err
    with open_database(database) as opened:
        assert tuple(info.name for info in opened.sessions()) == NAMES


def test_one_failure_is_named_and_the_others_go_on(
    folder: Path, processes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some = inputs(folder, "kitchen", "ruin", "hall")
    for number, more in enumerate(([], ["--dask", processes.scheduler_address], ["--jobs", "2"])):
        database = tmp_path / f"{number}.submaps"
        assert run("convert", *some, "-o", database, *more, "--json") == 3
        out, err = capsys.readouterr()
        assert json.loads(out)["failed"] == [str(folder / "ruin.yaml")]
        assert [session["session"] for session in json.loads(out)["sessions"]] == ["kitchen", "hall"]
        assert "ruin.yaml" in err
        assert "image" in err
        assert "Traceback" not in err
    made = {(tmp_path / f"{number}.submaps").read_bytes() for number in range(3)}
    assert len(made) == 1
    bad = [*inputs(folder, "ruin"), folder / "none.mcap"]
    assert run("convert", *bad, "-o", tmp_path / "none.submaps") == 1
    assert not (tmp_path / "none.submaps").exists()


def test_a_killed_worker_of_a_cluster_costs_only_what_it_had_in_hand(folder: Path, processes: Any) -> None:
    """Stopped first, so that it has a job in hand for sure when it is killed."""
    pids = [nanny.pid for nanny in processes.workers.values()]
    os.kill(pids[0], signal.SIGSTOP)
    killer = threading.Timer(1.0, os.kill, (pids[0], signal.SIGKILL))
    killer.start()
    try:
        workers = on_cluster(processes.scheduler_address)
        outcomes = list(at_once([job(folder, name) for name in NAMES], workers))
    finally:
        killer.join()
    assert [outcome.job.name for outcome in outcomes] == list(NAMES)
    for outcome in outcomes:
        assert outcome.error is None
        (entry,) = outcome.entries
        assert entry[0].session == outcome.job.name
        assert len(entry[1]) == len(entry[0].submaps) > 0


def test_processes_end_with_the_one_that_started_them() -> None:
    code = (
        "from signature.conversion_jobs import processes_here\nimport os, signal\n"
        "if __name__ == '__main__':\n"
        "    with processes_here(1) as submit:\n"
        "        print(submit(os.getpid).result(), flush=True)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    worker = int(done.stdout)
    for _ in range(200):
        if not Path(f"/proc/{worker}").exists():
            return
        time.sleep(0.05)
    raise AssertionError(f"{worker} is still there")


def test_a_worker_of_another_version_is_refused(folder: Path) -> None:
    other = Job(path=folder / "hall.yaml", name="hall", config=Config(), version="0.0.1")
    outcome: Outcome = conversion_jobs._attempt(other)
    assert isinstance(outcome.error, ClusterError)
    assert "this is 0.0.1" in str(outcome.error)


def test_no_scheduler_and_no_workers(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversion_jobs, "CONNECT_TIMEOUT_S", 0.5)
    jobs = [job(folder, "hall")]
    for address in ("tcp://127.0.0.1:1", "nonsense://x", "tcp://nowhere.invalid:8786"):
        with pytest.raises(ClusterError, match="does not answer") as caught:
            list(at_once(jobs, on_cluster(address)))
        assert address in str(caught.value)
        # type(): a dead weak proxy of another library raises when isinstance looks at its class.
        clients = [thing for thing in gc.get_objects() if issubclass(type(thing), distributed.Client)]
        assert all(client.status == "closed" for client in clients if str(client._start_arg) == address)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        pytest.raises(ClusterError, match="has no workers"),
    ):
        list(at_once(jobs, on_cluster(empty.scheduler_address)))


def test_without_the_extra_it_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['distributed'] = None\n"
        "from signature.conversion_jobs import at_once, on_cluster\n"
        "list(at_once([], on_cluster('tcp://h:1')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "ClusterError" in done.stderr
    assert "pip install dask distributed" in done.stderr


def test_an_interrupted_conversion_keeps_finished_jobs_and_continues(folder: Path, tmp_path: Path) -> None:
    """Ctrl-C reaches all processes of a terminal; nothing but one line comes of it."""
    whole, database, asleep = folder / "whole.submaps", tmp_path / "x.submaps", tmp_path / "asleep"
    code = (
        "import pathlib, signature.conversion_jobs as c, time, sys\n"
        f"done = iter([lambda: None, lambda: (pathlib.Path({str(asleep)!r}).touch(), time.sleep(300))])\n"
        "from signature.database import maintenance\n"
        "store = maintenance.store\n"
        "maintenance.store = lambda *a, **k: (store(*a, **k), next(done)(), None)[0]\n"
        "from pc2grid_cli.main import main; main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "convert", *inputs(folder, *NAMES), "-o", database, "--jobs", "1"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=interruptible,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    while not asleep.exists():
        assert process.poll() is None
        time.sleep(0.05)
    with open_database(database) as opened:
        assert len(opened.sessions()) == 2
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    progress = re.compile(r"pc2grid: .*: \d+%|pc2grid: compiling")  # with and without the time that is left
    lines = [line for line in err.splitlines() if not progress.match(line)]
    assert all(line.startswith("pc2grid: ") for line in lines), err
    assert "of 4 are stored; the same command continues from there" in lines[0]
    assert run("convert", *inputs(folder, *NAMES), "-o", database) == 0
    assert database.read_bytes() == whole.read_bytes()


def test_convert_export_and_maintain_a_fleets_database(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands that take a file take the URL of a server, and never show its password."""
    url, database = postgresql.new_database(), tmp_path / "x.submaps"
    secret = url.replace("postgres:@", "postgres:s3cret@")
    assert run("convert", *inputs(folder, *NAMES[:2]), "-o", secret, "--building", "b") == 0
    assert run("convert", *inputs(folder, *NAMES), "-o", secret, "--building", "b", "--json") == 0
    assert run("convert", *inputs(folder, *NAMES), "-o", database, "--building", "b") == 0
    assert run("db", "info", secret) == 0
    assert run("db", "check", secret) == 0
    assert run("db", "copy", secret, "-o", tmp_path / "copy.submaps") == 0
    assert run("db", "merge", secret, database, "-o", tmp_path / "merged.submaps") == 0
    assert run("export", secret, "--session", "hall", "--map", tmp_path / "out") == 0
    assert run("relocalize", folder / "attic.yaml", "-d", secret, "--building", "b", "--json") in (0, 4)
    with pytest.raises(Exception, match="exists already"):
        run("db", "copy", database, "-o", secret)
    out, err = capsys.readouterr()
    assert "s3cret" not in out + err
    assert "hall: stored already" in err
    assert "sound" in out
    assert (tmp_path / "out.pgm").read_bytes() == (folder / "hall.pgm").read_bytes()
    with open_database(url) as there, open_database(tmp_path / "copy.submaps") as copy:
        assert [info.provenance for info in copy.sessions()] == [info.provenance for info in there.sessions()]
        assert maintenance.check(tmp_path / "merged.submaps") == ()


@pytest.mark.parametrize("words", [["--dask", "local"], ["--dask", "tcp://h:1", "--jobs", "2"]])
def test_dask_is_a_cluster_and_jobs_are_processes(folder: Path, tmp_path: Path, words: list[str]) -> None:
    with pytest.raises(ConfigError, match="names the scheduler") as refused:
        run("convert", *inputs(folder, "hall"), "-o", tmp_path / "x.submaps", *words)
    assert "--jobs N" in str(refused.value.hint)
