"""A file that refuses to read more at once than is allowed, or than there is."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated
from pc2grid.io.containers.mcap import BoundedFile


@pytest.fixture
def file(tmp_path: Path) -> BoundedFile:
    path = tmp_path / "a"
    path.write_bytes(bytes(range(100)))
    return BoundedFile(io.FileIO(path), most_bytes=40)


def test_what_is_allowed_is_read_and_no_more(file: BoundedFile) -> None:
    assert file.read(40) == bytes(range(40))
    with pytest.raises(LimitExceeded, match=r"a record has 41 bytes; the limit is 40 .*max_record_bytes"):
        file.read(41)
    file.seek(95)
    with pytest.raises(LogTruncated, match="ends within"):
        file.read(6)
    assert file.read(5) == bytes(range(95, 100))


@pytest.mark.parametrize("size", [-1, -5, None])
def test_a_length_that_is_none_is_damage(file: BoundedFile, size: int | None) -> None:
    with pytest.raises(LogCorrupt, match="where a record should begin"):
        file.read(size)
