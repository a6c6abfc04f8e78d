"""Conversion of many recordings for one database: a job for each, here, in several processes, or on a
cluster.

Recordings are independent of each other, so each is mapped wherever a worker is free. One process stores the
results, in the order of the jobs. So the database has the same bytes wherever the jobs ran.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from pc2grid._version import __version__
from pc2grid.errors import ClusterError, DatabaseError
from pc2grid.grids.drawn import is_drawn_map
from pc2grid.libraries import require
from pc2grid.observer import Observer, TimeSpan
from signature.config import Config
from signature.database.protocol import CONNECT_TIMEOUT_S, Entry, Label, Provenance
from signature.sessions import build_sessions, describe_all, digest_of, provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One recording or map to convert: the arguments of `signature.sessions.build_sessions`.

    stored : provenance of the session of this name that is in the database already and shall stay; None if
        there is no such session.
    version : of the pc2grid that made the job; a worker must have the same.
    """

    path: Path
    name: str
    config: Config
    span: TimeSpan = TimeSpan()
    recover: bool = False
    label: Label = field(default_factory=Label)
    stored: Provenance | None = None
    version: str = __version__

    def made_from(self, digest: str) -> Provenance:
        """Return the provenance that the session of this job will have if its file has this digest."""
        span = TimeSpan() if is_drawn_map(self.path) else self.span
        return provenance(self.path, digest, self.config, span=span, label=self.label)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The result of a job.

    entries : the sessions to be stored, one for each part of the recording; empty if it is stored already, or
        if the job failed.
    error : why the job failed; None if it did not.
    """

    job: Job
    entries: tuple[Entry, ...] = ()
    error: Exception | None = None


Submit = Callable[..., Any]
"""Lets a worker call a function with arguments; what it returns has the `result`."""


def convert(job: Job, observer: Observer = Observer()) -> tuple[Entry, ...]:
    """Do a job; returns its sessions to be stored, none if it is stored already.

    Raises the errors of `build_sessions`; ClusterError if the job was made by another version of pc2grid;
    DatabaseError if the stored session was made from another file.
    """
    if job.version != __version__:
        raise ClusterError(
            f"a worker has pc2grid {__version__}, this is {job.version}",
            hint="install the same version everywhere",
        )
    if job.stored is not None:
        if digest_of(job.path, job.config) == job.stored.digest:
            return ()
        raise DatabaseError(
            f"{job.path}: the database holds a session {job.name!r} made from another file",
            hint="--force replaces it; --name gives this one another name",
        )
    maps, origin = build_sessions(
        job.path,
        job.name,
        job.config,
        span=job.span,
        recover=job.recover,
        label=job.label,
        observer=observer,
    )
    with observer.step("describe"):
        return tuple((part, describe_all(part, job.config, observer), origin) for part in maps)


def here(jobs: Sequence[Job], observer: Observer = Observer()) -> Generator[Outcome, None, None]:
    """Do jobs one after the other in this process."""
    for job in jobs:
        yield _attempt(job, observer)


def at_once(
    jobs: Sequence[Job], workers: contextlib.AbstractContextManager[Submit], observer: Observer = Observer()
) -> Generator[Outcome, None, None]:
    """Do as many jobs at once as there are workers; the outcomes are yielded in the order of the jobs.

    workers : `processes_here` or `on_cluster`. They read the recordings themselves: a path must name the same
        file there. observer : gets the progress.

    Raises ClusterError if the workers cannot be reached or go away; the jobs yielded until then are done.
    """
    with workers as submit:
        futures = [submit(_attempt, replace(job, path=job.path.absolute())) for job in jobs]
        for done, job in enumerate(jobs, start=1):
            yield _outcome(job, futures.pop(0))
            observer.on_progress(done / len(jobs))


@contextlib.contextmanager
def processes_here(count: int) -> Iterator[Submit]:
    """Start processes on this machine, and end them afterwards.

    A terminal sends Ctrl-C to all processes, but only this one may react, because it ends the others. So they
    are started while SIGINT is blocked, and inherit this.
    """
    resource_tracker.ensure_running()  # started later, it would unblock the signal
    others = multiprocessing.active_children()
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_end_with_parent)

    def submit(action: Callable[..., Any], *values: Any) -> Any:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return pool.submit(action, *values)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield submit
    finally:
        for process in multiprocessing.active_children():
            if process not in others:
                process.terminate()
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def on_cluster(address: str) -> Iterator[Submit]:
    """Connect to the workers of a Dask scheduler. It starts a job again that a worker died on.

    Raises ClusterError if it does not answer, or if dask is not installed.
    """
    require({"cluster": "a cluster"})
    import distributed

    class Client(distributed.Client):
        """A client that closes itself if it cannot connect.

        Otherwise the garbage collector would close the incomplete client at an arbitrary time. If another
        client starts at that time, each waits for a lock that the other one holds.
        """

        def __init__(self) -> None:
            try:
                super().__init__(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
            except BaseException:
                self.close()  # type: ignore[no-untyped-call]
                raise

    # The library logs many lines for each lost connection; our error is one line.
    for name in ("distributed", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with contextlib.ExitStack() as stack:
        problem = "does not answer"
        try:
            client = stack.enter_context(Client())
            problem = "has no workers"
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"the scheduler {address} {problem}",
                hint="start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
            ) from error
        yield functools.partial(client.submit, pure=False)


def _end_with_parent() -> None:
    """End this process when the one that started it is killed: nobody else would."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _attempt(job: Job, observer: Observer = Observer()) -> Outcome:
    """Do a job. Its error becomes part of the result, so that a cluster does not try it again."""
    try:
        return Outcome(job=job, entries=convert(job, observer))
    except Exception as error:
        return Outcome(job=job, error=error)


def _outcome(job: Job, future: Any) -> Outcome:
    """Return the result of a worker for a job; the job's own error is a part of it.

    Raises ClusterError for every other error: the worker, or the way to it, is gone.
    """
    try:
        outcome: Outcome = future.result()
    except Exception as error:
        raise ClusterError(
            f"a worker was lost; {job.path} and what follows it is not stored: {type(error).__name__}",
            hint="the same command continues from there; if memory ran out, with fewer workers",
        ) from error
    return replace(outcome, job=job)
