"""Errors of the libraries that read recordings."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest

from pc2grid.errors import LogCorrupt
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
