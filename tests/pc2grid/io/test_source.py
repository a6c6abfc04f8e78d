"""Errors of the libraries that read recordings."""

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pc2grid.errors import DatabaseError, LogCorrupt, PointCloudError
from pc2grid.io.source import guarded, guarded_stream


class Content:
    """What was read before the error."""


def failing(content: Content) -> Iterator[int]:
    yield 1
    raise ValueError(f"a decoder that does not like {type(content).__name__}")


def test_items_before_an_error_arrive_and_the_error_names_the_recording() -> None:
    found: list[int] = []
    with pytest.raises(LogCorrupt, match=r"a\.bag: damaged \(ValueError: a decoder") as raised:
        found.extend(guarded_stream(Path("a.bag"), failing(Content())))
    assert found == [1]
    assert isinstance(raised.value.__cause__, ValueError)


def test_a_stream_ends_and_may_hold_anything() -> None:
    assert list(guarded_stream(Path("a.bag"), iter([None, 0, False]))) == [None, 0, False]


def test_what_was_read_is_free_once_the_error_is_handled() -> None:
    """A damaged chunk may be of 256 MB: it must not wait for the collector of cycles."""

    def failed() -> weakref.ref[Content]:
        content = Content()
        try:
            guarded(Path("a.bag"), lambda: list(failing(content)))
        except LogCorrupt:
            return weakref.ref(content)
        raise AssertionError

    gc.disable()
    try:
        assert failed()() is None
    finally:
        gc.enable()


def test_what_others_raise_becomes_ours_but_for_memory() -> None:
    path = Path("log.mcap")

    def raising(error: BaseException) -> Any:
        def action() -> Any:
            raise error

        return action

    def stream(error: BaseException) -> Any:
        yield 1
        raise error

    for error, words in (
        (PermissionError(13, "Permission denied"), "log.mcap: cannot be read: Permission denied"),
        (KeyError("x\n\n y"), "log.mcap: damaged .KeyError: 'x"),
        (PointCloudError("odd"), "^log.mcap: odd$"),
        (PointCloudError("log.mcap: odd"), "^log.mcap: odd$"),
    ):
        with pytest.raises((LogCorrupt, PointCloudError), match=words):
            guarded(path, raising(error))
        with pytest.raises((LogCorrupt, PointCloudError), match=words):
            list(guarded_stream(path, stream(error)))
    strange = DatabaseError("busy")
    with pytest.raises(DatabaseError) as caught:
        guarded(path, raising(strange))
    assert caught.value is strange
    with pytest.raises(MemoryError):
        guarded(path, raising(MemoryError()))
    with pytest.raises(MemoryError):
        list(guarded_stream(path, stream(MemoryError())))
