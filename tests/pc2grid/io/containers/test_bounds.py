"""A file that refuses to read more at once than is allowed, or than there is."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated
from pc2grid.io.containers.bounds import BoundedFile
from tests.helpers.memory import bounded_memory


@pytest.fixture
def file(tmp_path: Path) -> BoundedFile:
    path = tmp_path / "a"
    path.write_bytes(bytes(range(100)))
    return BoundedFile(io.FileIO(path), most_bytes=40)


def test_what_is_allowed_is_read(file: BoundedFile) -> None:
    assert file.read(40) == bytes(range(40))
    file.seek(95)
    assert file.read(5) == bytes(range(95, 100))


def test_more_than_the_limit_is_refused(file: BoundedFile) -> None:
    with pytest.raises(LimitExceeded, match=r"a record has 41 bytes; the limit is 40 .*max_record_bytes"):
        file.read(41)


def test_the_end_of_the_file_is_the_end_of_no_record(file: BoundedFile) -> None:
    file.seek(95)
    for size in (6, 101, 1 << 62):
        with bounded_memory(100 << 20), pytest.raises(LogTruncated, match="ends within"):
            file.read(size)


@pytest.mark.parametrize("size", [-1, -5, None])
def test_a_length_that_is_none_is_damage(file: BoundedFile, size: int | None) -> None:
    with pytest.raises(LogCorrupt, match="where a record should begin"):
        file.read(size)
