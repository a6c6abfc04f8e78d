"""Where `db join` and `convert --join` compare sessions: in this process, or in several (--jobs, --dask)."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from pc2grid import extras
from signature.cluster import LOCAL
from signature.database.postgres.server import is_url
from signature.localization.joining.comparing import Compare, comparing_in_processes


def comparing(database: str, dask: str | None, jobs: int | None) -> AbstractContextManager[Compare | None]:
    """What compares the sessions of a database; None for this process, without --dask and --jobs."""
    if dask is None and jobs is None:
        return nullcontext()
    extras.require({"cluster": "--dask" if jobs is None else "--jobs"})
    place = database if is_url(database) else str(Path(database).absolute())
    return comparing_in_processes(place, dask or LOCAL, jobs or os.cpu_count() or 1)
