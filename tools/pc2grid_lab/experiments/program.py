"""Which program computed a stored result.

The number of a release stays the same while the program is developed, so it does not tell whether a result
that was computed before is still what the program would compute. Its sources do.

Results that are computed once: in processes of their own, and in files that are complete or not there.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import subprocess
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

import pc2grid
import pc2grid_cli
import signature
from pc2grid import libraries as threads
from pc2grid.io.atomic import replace_file

FRONT, BACK = Path(pc2grid.__file__).parent, Path(signature.__file__).parent
LABORATORY = Path(__file__).parents[1]
"""Folders of sources."""
ROOT = LABORATORY.parents[1]
"""The folder of the packages; `tools/` is below it."""


def digest_of_sources(paths: Iterable[Path]) -> str:
    """Twelve hexadecimal digits that change with any of these files, and the Python files in these folders.

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
    """The same of every source file of the product, and of the catalogue of real recordings."""
    cli, catalogue = Path(pc2grid_cli.__file__).parent, LABORATORY / "experiments/recordings/catalogue.py"
    return digest_of_sources((FRONT, BACK, cli, catalogue))


def commit() -> str:
    """The commit of the sources, "-dirty" if they differ from it; outside of a repository the version."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--exclude=*"],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip() or pc2grid.__version__


T = TypeVar("T")
Advance = Callable[[float], object]


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    with replace_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def once(path: Path, make: Callable[[], T]) -> T:
    """What `make` returns; it is kept in a file, and read if the file is there."""
    if not path.exists():
        made = pickle.dumps(make())
        path.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(path) as draft:
            draft.write_bytes(made)
    found: T = pickle.loads(path.read_bytes())
    return found


def write_arrays(path: Path, **arrays: Any) -> None:
    """Write an .npz file."""
    with replace_file(path) as draft, draft.open("wb") as file:
        np.savez(file, **arrays)


def in_processes(
    function: Callable[..., T], tasks: Iterable[tuple[Any, ...]], *, jobs: int | None, advance: Advance
) -> list[T]:
    """What a function returns for the arguments of each task, in their order.

    jobs : processes, None: one a core; with one the tasks run in this process. advance : called with the
        share that is done.
    """
    given, count = list(tasks), jobs or os.cpu_count() or 1
    if count == 1 or len(given) < 2:
        found = []
        for arguments in given:
            found.append(function(*arguments))
            advance(len(found) / len(given))
        return found
    threads.use_one()  # the processes run in parallel; they read it when they load their libraries
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=cv2.setNumThreads, initargs=(1,))
    return run_in(pool, function, given, advance)


def run_in(
    pool: Executor, function: Callable[..., T], tasks: Iterable[tuple[Any, ...]], advance: Advance
) -> list[T]:
    """The same in processes or threads that are given, which it ends."""
    waiting = [pool.submit(function, *arguments) for arguments in tasks]
    try:
        for done, future in enumerate(as_completed(waiting), start=1):
            future.result()
            advance(done / len(waiting))
        return [future.result() for future in waiting]
    finally:
        # Tasks that wait must not start after the user has stopped the program, or after one has failed.
        pool.shutdown(wait=False, cancel_futures=True)
