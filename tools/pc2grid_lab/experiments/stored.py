"""Results that are computed once: in processes of their own, and in files that are complete or not there."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from pc2grid import threads
from pc2grid.io.atomic import replace_file

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
