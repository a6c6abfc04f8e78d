"""Converts many recordings for one database: a job for each, in this process or on a Dask cluster.

Recordings are independent of each other, so each is mapped wherever a worker is free. One process stores the
results, in the order of the jobs. So the database has the same bytes wherever the jobs ran.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pc2grid._version import __version__
from pc2grid.errors import ClusterError, DatabaseError
from pc2grid.mapping.drawn_map import is_drawn_map
from pc2grid.observer import Observer
from pc2grid.time_span import TimeSpan
from signature.cluster import connected
from signature.config import Config
from signature.database.protocol import Entry, Label, Provenance
from signature.sessions import build_sessions, describe_all, digest_of, provenance


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One recording or map to convert: the arguments of `signature.sessions.build_sessions`.

    stored : provenance of the session of this name that the database holds already and that shall stay; None
        if there is no such session.
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
        """The provenance that the session of this job will have if its file has this digest."""
        span = TimeSpan() if is_drawn_map(self.path) else self.span
        return provenance(self.path, digest, self.config, span=span, label=self.label)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The result of a job.

    entries : what is to be stored, a session for each part of the recording that hangs together; empty if it
        is stored already, or if the job failed.
    error : why the job failed; None if it did not.
    """

    job: Job
    entries: tuple[Entry, ...] = ()
    error: Exception | None = None


def convert(job: Job, observer: Observer = Observer()) -> tuple[Entry, ...]:
    """Do a job: everything there is to store of it, nothing if it is stored already.

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


def on_cluster(
    jobs: Sequence[Job], address: str, processes: int, observer: Observer = Observer()
) -> Generator[Outcome, None, None]:
    """Do jobs on the workers of a Dask scheduler, as many at once as there are workers.

    The outcomes are yielded in the order of the jobs.

    address : of the scheduler, or LOCAL for `processes` processes of this machine with one thread each. The
        workers read `job.path` themselves. Relative paths are made absolute; a path must name the same file
        there.
    observer : gets the progress, and a warning when a worker is lost. Its job starts again on another worker.

    Raises ClusterError if the cluster cannot be reached or goes away; the jobs yielded until then are done.
    """
    with connected(address, processes) as client:
        names: dict[str, str] = {}
        futures = []
        for number, job in enumerate(jobs):
            key = f"pc2grid-{number:06d}-{job.name}"
            names[key] = job.name
            futures.append(client.submit(_attempt, _absolute(job), key=key, pure=False))
        client.subscribe_topic("all", _LostWorkers(names, observer.on_warning))
        for done, job in enumerate(jobs, start=1):
            yield _outcome(job, futures.pop(0))
            observer.on_progress(done / len(jobs))


def _attempt(job: Job, observer: Observer = Observer()) -> Outcome:
    """Do a job. Its error becomes part of the result, so that a cluster does not try it again."""
    try:
        return Outcome(job=job, entries=convert(job, observer))
    except Exception as error:
        return Outcome(job=job, error=error)


def _absolute(job: Job) -> Job:
    return replace(job, path=job.path.absolute())


def _outcome(job: Job, future: Any) -> Outcome:
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    try:
        outcome: Outcome = future.result()
    except KilledWorker as error:
        many = f"{error.allowed_failures + 1} workers died on it, one after the other"
        hint = "if memory ran out: fewer workers at once, or a shorter part of it"
        return Outcome(job=job, error=ClusterError(f"{job.path}: {many}", hint=hint))
    except (FutureCancelledError, OSError) as error:
        raise ClusterError(
            "the scheduler went away",
            hint="what was stored is whole; the same command continues from there",
        ) from error
    return replace(outcome, job=job)


class _LostWorkers:
    """Handles events of the scheduler: reports workers that were lost while they had one of our jobs.

    names : names of our jobs by their keys on the cluster. report : takes a sentence for each lost job.
    """

    def __init__(self, names: dict[str, str], report: Callable[[str], None]) -> None:
        self._names = names
        self._report = report

    def __call__(self, event: tuple[float, Any]) -> None:
        message = event[1]
        if not isinstance(message, dict) or message.get("action") != "remove-worker":
            return
        lost = [*message.get("processing-tasks", ()), *message.get("lost-computed-tasks", ())]
        for key in lost:
            if key in self._names:
                self._report(
                    f"worker {message['worker']} was lost; {self._names[key]} starts over on another"
                )
