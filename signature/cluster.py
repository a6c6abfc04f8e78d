"""A Dask cluster: processes on this machine, or the workers of a scheduler."""

from __future__ import annotations

import contextlib
import logging
import signal
from collections.abc import Iterator
from typing import Any

from pc2grid import extras
from pc2grid.errors import ClusterError

LOCAL = "local"
"""In place of the address of a scheduler: start a cluster of processes on this machine."""
CONNECT_TIMEOUT_S = 10.0
"""How long a scheduler may take to answer, and to have its first worker; chosen by hand."""


@contextlib.contextmanager
def connected(address: str, processes: int) -> Iterator[Any]:
    """A client (`distributed.Client`) of a scheduler that has at least one worker.

    address : of the scheduler, or LOCAL for `processes` processes of this machine with one thread each.

    Raises ClusterError if it does not answer, or if dask is not installed.
    """
    extras.require({"cluster": "a cluster"})
    import distributed

    class Client(distributed.Client):
        """A client that closes itself if it cannot connect.

        Otherwise the garbage collector would close the incomplete client at an arbitrary time. If another
        client starts at that time, each waits for a lock that the other one holds.
        """

        def __init__(self, address: str) -> None:
            try:
                super().__init__(address, timeout=CONNECT_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
            except BaseException:
                self.close()  # type: ignore[no-untyped-call]
                raise

    # The library logs many lines for each lost connection; our error is one line.
    for name in ("distributed", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with contextlib.ExitStack() as stack:
        if address == LOCAL:
            address = stack.enter_context(processes_here(processes)).scheduler_address
        problem = "does not answer"
        try:
            client = stack.enter_context(Client(address))
            problem = "has no workers"
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
        except (OSError, ValueError) as error:
            raise ClusterError(
                f"the scheduler {address} {problem}",
                hint="start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
            ) from error
        yield client


def processes_here(count: int) -> Any:
    """A cluster of `count` processes on this machine.

    A terminal sends Ctrl-C to all processes, but only this one may react, because it ends the others. So
    SIGINT is blocked while the workers are started: they, and the workers that replace them, inherit this.
    """
    from multiprocessing import resource_tracker

    import distributed

    # Started later, the resource tracker would unblock the signal.
    resource_tracker.ensure_running()
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
