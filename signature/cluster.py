"""Many recordings into one database: a task each, here or on a Dask cluster, handed back in their order.

Recordings share nothing, so they are mapped on their own, wherever a worker is free; what comes back is
stored by one process, in the order asked for. So the database is the same whoever did the work.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pc2grid
from pc2grid.errors import ClusterError, DatabaseError
from pc2grid.model import RegisteredScan
from signature.build import build_session, describe_all, digest_of, provenance
from signature.config import Config
from signature.database.protocol import Entry, Label, Provenance

LOCAL = "local"
"""Instead of a scheduler's address: a cluster of processes on this machine."""
CONNECT_TIMEOUT_S = 10.0


Progress = Callable[[str], contextlib.AbstractContextManager[Callable[[float], None]]]
"""Begins something of that name; what it gives is told the share that is done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One recording or map to convert: what `signature.build.build_session` wants to know.

    stored : what made the session of this name that is in the database already and shall stay.
    """

    path: Path
    name: str
    config: Config
    start_s: float = 0.0
    duration_s: float | None = None
    recover: bool = False
    label: Label = field(default_factory=Label)
    stored: Provenance | None = None
    version: str = pc2grid.__version__

    def made_from(self, digest: str) -> Provenance:
        """What its session will say that it came from, if the file has this digest."""
        from pc2grid.io.nav2_map import is_map_file

        start_s, duration_s = (0.0, None) if is_map_file(self.path) else (self.start_s, self.duration_s)
        return provenance(
            self.path, digest, self.config, start_s=start_s, duration_s=duration_s, label=self.label
        )


Watch = Callable[[Job, RegisteredScan], None]
"""Is shown each scan of a job's recording where tracking puts it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of a job.

    entry : to be stored; None if it is stored already, or if it failed.
    error : why it failed.
    """

    job: Job
    entry: Entry | None = None
    error: Exception | None = None


def convert(
    job: Job,
    progress: Progress | None = None,
    note: Callable[[str], None] | None = None,
    watch: Watch | None = None,
) -> Entry | None:
    """Do a job: everything there is to store of it, or None if it is stored already.

    Raises as `build_session`; DatabaseError if the stored session was made from another file.
    """
    if job.version != pc2grid.__version__:
        raise ClusterError(
            f"a worker has pc2grid {pc2grid.__version__}, this is {job.version}",
            hint="install the same version everywhere",
        )
    if job.stored is not None:
        if digest_of(job.path, job.config) == job.stored.digest:
            return None
        raise DatabaseError(
            f"{job.path}: the database holds a session {job.name!r} made from another file",
            hint="--force replaces it; --name gives this one another name",
        )
    progress = progress or _in_silence
    with progress(f"map {job.path.name}") as update:
        session_map, origin = build_session(
            job.path,
            job.name,
            job.config,
            start_s=job.start_s,
            duration_s=job.duration_s,
            recover=job.recover,
            label=job.label,
            progress=update,
            note=note,
            watch=None if watch is None else functools.partial(watch, job),
        )
    with progress("describe") as update:
        return session_map, describe_all(session_map, job.config, update), origin


@contextlib.contextmanager
def _in_silence(what: str) -> Iterator[Callable[[float], None]]:
    yield lambda share: None


def here(
    jobs: Sequence[Job], progress: Progress, note: Callable[[str], None], watch: Watch | None = None
) -> Generator[Outcome, None, None]:
    """Do jobs one after the other in this process."""
    for job in jobs:
        try:
            entry = convert(job, progress, note, watch)
        except Exception as error:
            yield Outcome(job=job, error=error)
        else:
            yield Outcome(job=job, entry=entry)


def on_cluster(
    jobs: Sequence[Job], address: str, processes: int, tell: Callable[[str], None]
) -> Generator[Outcome, None, None]:
    """Do jobs on the workers of a Dask scheduler, as many at once as there are; yields in the jobs' order.

    address : of the scheduler, or LOCAL for `processes` processes of this machine, one thread each. Workers
        read `job.path` themselves: relative paths are made absolute, and must name the same file there.
    tell : takes a sentence when a worker is lost. Its job starts over on another one.

    Raises ClusterError if there is no cluster (any more); what was yielded by then is done.
    """
    with _connected(address, processes) as client:
        names: dict[str, str] = {}
        futures = []
        for number, job in enumerate(jobs):
            key = f"pc2grid-{number:06d}-{job.name}"
            names[key] = job.name
            futures.append(client.submit(_attempt, _absolute(job), key=key, pure=False))
        client.subscribe_topic("all", _LostWorkers(names, tell))
        for job in jobs:
            yield _outcome(job, futures.pop(0))


def _attempt(job: Job) -> Outcome:
    """On a worker: a failure is a result too, so that it is not tried again."""
    try:
        return Outcome(job=job, entry=convert(job))
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
            hint="what was stored is whole; the same command goes on from there",
        ) from error
    return replace(outcome, job=job)


class _LostWorkers:
    """Hears what the scheduler says of its workers, and tells when one is lost with a job of ours."""

    def __init__(self, names: dict[str, str], tell: Callable[[str], None]) -> None:
        self._names = names
        self._tell = tell

    def __call__(self, event: tuple[float, Any]) -> None:
        message = event[1]
        if not isinstance(message, dict) or message.get("action") != "remove-worker":
            return
        lost = [*message.get("processing-tasks", ()), *message.get("lost-computed-tasks", ())]
        for key in lost:
            if key in self._names:
                self._tell(f"worker {message['worker']} was lost; {self._names[key]} starts over on another")


@contextlib.contextmanager
def _connected(address: str, processes: int) -> Iterator[Any]:
    """A client of a cluster that has workers."""
    try:
        import distributed
    except ImportError as error:
        raise ClusterError(
            f"a cluster needs an extra that is not installed ({error})", hint="pip install 'pc2grid[cluster]'"
        ) from None

    class Client(distributed.Client):
        """Closes itself if it cannot connect.

        Left half made, one is closed by the garbage collector, wherever that happens to run: while another
        client starts, both wait for one lock for ever.
        """

        def __init__(self, address: str) -> None:
            try:
                super().__init__(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
            except BaseException:
                self.close()  # type: ignore[no-untyped-call]
                raise

    # Its own complaints about lost connections are many lines each; ours is one.
    for name in ("distributed", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with contextlib.ExitStack() as stack:
        if address == LOCAL:
            address = stack.enter_context(_processes(processes)).scheduler_address
        what = "does not answer"
        try:
            client = stack.enter_context(Client(address))
            what = "has no workers"
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"the scheduler {address} {what}",
                hint="start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
            ) from error
        yield client


def _processes(count: int) -> Any:
    """A cluster of processes on this machine.

    Ctrl-C goes to all processes of a terminal, but is for the one that ends the others: they, and those
    that replace them, inherit that it is blocked.
    """
    from multiprocessing import resource_tracker

    import distributed

    resource_tracker.ensure_running()  # else it starts in between, and unblocks the signal when it has
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        make: Any = distributed.LocalCluster  # untyped
        return make(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
