"""The one runner: commands in processes of their own, tasks in a pool, and results that are kept in a folder.

Commands run as a user runs them, with their processor time. A result that a folder holds already is not
computed again; it is complete or not there.

The number of a release stays the same while the program is developed, so it does not tell whether a result
that was computed before is still what the program would compute. Its sources do.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import multiprocessing
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import cv2

import pc2grid as product
import pc2grid_cli
import signature
from pc2grid import libraries
from pc2grid.errors import ConfigError
from pc2grid.io.atomic import replace_file

FRONT, BACK = Path(product.__file__).parent, Path(signature.__file__).parent
LABORATORY = Path(__file__).parent
"""Folders of sources."""
ROOT = LABORATORY.parents[1]
"""The folder of the packages; `tools/` is below it."""


def digest_of_sources(paths: Iterable[Path]) -> str:
    """Return twelve hexadecimal digits that change with any of these files, and the Python files in these
    folders.

    >>> len(digest_of_sources([FRONT]))
    12
    """
    found = hashlib.sha256()
    for path in paths:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            found.update(file.name.encode() + b"\0")
            found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()[:12]


@cache
def digest_of_product() -> str:
    """Return the same of every source file of the product, and of the catalogue of real recordings."""
    cli, catalogue = Path(pc2grid_cli.__file__).parent, LABORATORY / "recordings/catalogue.py"
    return digest_of_sources((FRONT, BACK, cli, catalogue))


def commit() -> str:
    """Return the commit of the sources, "-dirty" if they differ; outside of a repository the version."""
    describe = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    done = subprocess.run(describe, cwd=ROOT, check=False, capture_output=True, text=True)
    return done.stdout.strip() or product.__version__


T = TypeVar("T")
Key = TypeVar("Key")
Advance = Callable[[float], object]


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    with replace_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def keep(path: Path, made: object) -> None:
    """Write a file that `kept` reads."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as draft:
        draft.write_bytes(pickle.dumps(made))


def kept(path: Path) -> Any:
    """Return what is kept in a file."""
    return pickle.loads(path.read_bytes())


def once(path: Path, make: Callable[[], T]) -> T:
    """Return what `make` returns; it is kept in a file, and read if the file is there."""
    if not path.exists():
        keep(path, make())
    return cast(T, kept(path))


def grouped(pairs: Iterable[tuple[Key, T]]) -> dict[Key, list[T]]:
    """Return the values of each key, in the order in which they come."""
    groups: dict[Key, list[T]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def names_of(files: Sequence[Path]) -> list[str]:
    """Return the names of files without suffixes. Raises ConfigError if two are the same."""
    names = [file.stem for file in files]
    if len(set(names)) != len(names):
        raise ConfigError(f"two files share a name: {', '.join(names)}", hint="rename one of the files")
    return names


def in_processes(
    function: Callable[..., T],
    tasks: Iterable[tuple[Any, ...]],
    *,
    jobs: int | None,
    progress: AbstractContextManager[Advance],
) -> list[T]:
    """Return what a function returns for the arguments of each task, in their order.

    jobs : processes, None: one a core; with one the tasks run in this process. progress : shows the share
        that is done.
    """
    given, count = list(tasks), jobs or os.cpu_count() or 1
    with progress as advance:
        if count == 1 or len(given) < 2:
            found = []
            for arguments in given:
                found.append(function(*arguments))
                advance(len(found) / len(given))
            return found
        libraries.use_one()  # the processes run in parallel; they read it when they load their libraries
        spawn = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=cv2.setNumThreads, initargs=(1,))
        return _run_in(pool, function, given, advance)


def _run_in(
    pool: Executor, function: Callable[..., T], tasks: Iterable[tuple[Any, ...]], advance: Advance
) -> list[T]:
    """Return the same, of processes or threads that are given; they end."""
    waiting = [pool.submit(function, *arguments) for arguments in tasks]
    try:
        for done, future in enumerate(as_completed(waiting), start=1):
            future.result()
            advance(done / len(waiting))
        return [future.result() for future in waiting]
    finally:
        # Tasks that wait must not start after the user has stopped the program, or after one has failed.
        pool.shutdown(wait=False, cancel_futures=True)


_CLI = "from pc2grid_cli.main import main; main()"
_ANSWERED = (0, 3, 4)
"""Exit codes of a command that did its work: done, with loss of data, without a confident answer."""
_STOPPED = (130, 143)
"""Exit codes of a command that was interrupted or asked to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """What became of one command.

    code : its exit code, negative if a signal ended it. cpu_s : processor time, user and system, of all its
        processes.
    document : the JSON document on its standard output; None if there is none. error : the last line of its
        standard error, if it did not do its work.
    """

    code: int
    cpu_s: float
    document: Any
    error: str = ""

    @property
    def failed(self) -> bool:
        """Return whether there is no result."""
        return self.code not in _ANSWERED or self.document is None

    @property
    def result(self) -> Any:
        """Return the document of a command that did its work; else None."""
        return None if self.failed else self.document


def pc2grid(*arguments: str | Path) -> Finished:
    """Run `pc2grid` with these arguments; after half an hour of elapsed time it is stopped."""
    return run(sys.executable, "-c", _CLI, *arguments, limit_s=1800.0)


def run(*command: str | Path, limit_s: float = math.inf) -> Finished:
    """Run a command that prints a JSON document; its paths are absolute."""
    # Byte code is kept, as it is where pc2grid is installed.
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tools"))),
    }
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        # `python -c` imports from the current folder first.
        child = subprocess.Popen(
            list(map(str, command)),
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env=environment,
        )
        try:
            used = _wait(child, time.monotonic() + limit_s)
        except BaseException:
            child.kill()
            child.wait()
            raise
        out.seek(0)
        err.seek(0)
        document, complaint = _parsed(out.read()), err.read().decode(errors="replace")
    code, cpu_s = child.returncode, used.ru_utime + used.ru_stime
    done = Finished(code=code, cpu_s=cpu_s, document=document)
    return Finished(**{**asdict(done), "error": _error(code, complaint)}) if done.failed else done


def _wait(child: subprocess.Popen[bytes], end_s: float) -> resource.struct_rusage:
    """Wait for a process, and end it after `end_s` of the monotonic clock; return what it has used."""
    # `wait4` alone tells the time of this child, and not of all that ended so far.
    while True:
        pid, status, used = os.wait4(child.pid, os.WNOHANG)
        if pid:
            child.returncode = os.waitstatus_to_exitcode(status)
            return used
        if time.monotonic() > end_s:
            child.kill()
        time.sleep(0.02)


def _parsed(text: bytes) -> Any:
    """Return a JSON document, or several of them, one a line, as a list; None if it is neither."""
    for parse in (json.loads, lambda lines: [json.loads(line) for line in lines.splitlines()] or None):
        with contextlib.suppress(ValueError):
            return parse(text)
    return None


def _error(code: int, complaint: str) -> str:
    """Return why a command failed: the error that it names, or its last line."""
    lines = [line for line in complaint.splitlines() if line.strip()] or ["nothing was printed"]
    said = next((line for line in lines if "error:" in line), lines[-1])
    return f"ended by signal {-code}" if code < 0 else said


NOT_RUN = "was not run"
"""The error of a command that was not run, because the run ended early."""


def kept_result(file: Path) -> Finished:
    """Return the result that is kept in a file; without the file, one with the error `NOT_RUN`."""
    if not file.exists():
        return Finished(code=1, cpu_s=0.0, document=None, error=NOT_RUN)
    return Finished(**json.loads(file.read_text()))


@dataclass(frozen=True, slots=True)
class Task:
    """One command: where its result is kept, what is done, and a guess of its time that orders the tasks."""

    file: Path
    do: Callable[[], Finished]
    weight: float = 0.0


def run_tasks(tasks: Sequence[Task], jobs: int, advance: Advance) -> None:
    """Run the tasks whose result is not there, the longest first. advance : called with how many are done."""
    waiting = sorted((task for task in tasks if not task.file.exists()), key=lambda task: -task.weight)
    there = len(tasks) - len(waiting)
    given = [(task,) for task in waiting]
    _run_in(ThreadPoolExecutor(jobs), _do, given, lambda share: advance(there + share * len(waiting)))


def _do(task: Task) -> None:
    task.file.parent.mkdir(parents=True, exist_ok=True)
    done = task.do()
    if done.code not in _STOPPED:  # else the next run does it
        write_text(task.file, json.dumps(asdict(done)))
