"""Results that are computed once: in processes of their own, and in files that are complete or not there."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pc2grid.io.atomic import replace_file


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    with replace_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


def write_arrays(path: Path, **arrays: Any) -> None:
    """Write an .npz file."""
    with replace_file(path) as draft, draft.open("wb") as file:
        np.savez(file, **arrays)


def in_processes(
    function: Callable[..., Any],
    tasks: Iterable[tuple[Any, ...]],
    *,
    jobs: int | None,
    advance: Callable[[float], None],
) -> list[Any]:
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
    # One thread in each process, because the processes run in parallel; libraries read this when loaded.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    pool = ProcessPoolExecutor(
        count, mp_context=multiprocessing.get_context("spawn"), initializer=cv2.setNumThreads, initargs=(1,)
    )
    try:
        waiting = [pool.submit(function, *arguments) for arguments in given]
        for done, future in enumerate(as_completed(waiting), start=1):
            future.result()
            advance(done / len(waiting))
        return [future.result() for future in waiting]
    finally:
        # Tasks that wait must not start after the user has stopped the program, or after one has failed.
        pool.shutdown(wait=False, cancel_futures=True)
