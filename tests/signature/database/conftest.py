"""Databases of two sessions, made once for each engine."""

from pathlib import Path

import pytest

from signature.database import maintenance
from tests.helpers import postgresql
from tests.helpers.databases import MONDAY, TUESDAY


@pytest.fixture(params=["sqlite", "postgres"])
def empty(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """Where there is no database yet, on each engine."""
    return tmp_path / "x.submaps" if request.param == "sqlite" else postgresql.new_database()


@pytest.fixture(scope="session")
def two(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a file with two sessions."""
    file = tmp_path_factory.mktemp("two") / "x.submaps"
    maintenance.store(file, [MONDAY, TUESDAY], keep=False)
    return file.read_bytes()


@pytest.fixture(scope="session")
def two_on_a_server() -> str:
    url = postgresql.new_database()
    maintenance.store(url, [MONDAY, TUESDAY], keep=False)
    return url


@pytest.fixture
def path(two: bytes, tmp_path: Path) -> Path:
    """A file of two sessions, alone in its folder."""
    file = tmp_path / "x.submaps"
    file.write_bytes(two)
    return file


@pytest.fixture
def url(two_on_a_server: str) -> str:
    """Two sessions on a server."""
    return postgresql.new_database(like=two_on_a_server)


@pytest.fixture(params=["path", "url"])
def place(request: pytest.FixtureRequest) -> str | Path:
    """A database of two sessions, on each engine."""
    found: str | Path = request.getfixturevalue(request.param)
    return found
