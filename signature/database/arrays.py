"""Arrays as bytes, a checksum for every row, and damage that is said by name.

A part of a session is one `.npz`: its arrays in numpy's own format (`numpy.lib.format`), and its document as
the bytes of its JSON. Whatever it claims, no more than `MOST_BYTES` are unpacked.
"""

from __future__ import annotations

import contextlib
import enum
import io
import json
import re
import threading
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pc2grid.errors import DatabaseCorrupt, Pc2GridError
from signature.database.protocol import Problem

Array = NDArray[Any]

SALVAGE = "`pc2grid db check` lists all damage, `pc2grid db copy --recover` keeps what is whole"
MOST_BYTES = 1_200_000_000
"""Largest part that is read: the steps of 100 million points in space, 50,000 m2 at 5 cm."""
_DOCUMENT = "document"
"""The array with the bytes of the document."""
_HEADERS = threading.Lock()
"""One thread at a time reads headers of arrays."""
_NO_UTF8 = re.compile("[\udc80-\udcff]")
"""Bytes of a name that are no UTF-8, as Python reads them (`surrogateescape`)."""


def clean(word: str) -> str:
    r"""Text as it can be stored: bytes of a name that are not valid UTF-8 become escapes such as `\xff`."""
    return _NO_UTF8.sub(lambda found: rf"\x{ord(found[0]) - 0xDC00:02x}", word)


def to_json(document: Any) -> str:
    """Canonical JSON: equal content, equal bytes. Raises ValueError for a number that is not finite."""

    def plain(value: Any) -> Any:
        return value.value if isinstance(value, enum.Enum) else value.tolist()

    text = json.dumps(
        document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False, default=plain
    )
    return _NO_UTF8.sub(lambda found: rf"\\x{ord(found[0]) - 0xDC00:02x}", text)


def pack(document: Any, arrays: Mapping[str, Array], *, compress: bool = True) -> bytes:
    """A document and its arrays as the bytes of an `.npz`. Equal content, equal bytes."""
    stream, text = io.BytesIO(), np.frombuffer(to_json(document).encode(), np.uint8)
    save: Any = np.savez_compressed if compress else np.savez
    save(stream, **{_DOCUMENT: text, **arrays})
    return stream.getvalue()


def unpack(data: bytes) -> tuple[Any, dict[str, Array]]:
    """What was packed. Raises ValueError, BadZipFile and others for other bytes."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        size = sum(member.file_size for member in file.infolist())
    if size > MOST_BYTES:
        raise ValueError(f"{size} bytes, more than {MOST_BYTES}")
    # numpy parses the header of each array by `ast`, which before Python 3.11.9 must not run in two threads
    # at once ("AST constructor recursion depth mismatch", python/cpython#106905).
    with _HEADERS, np.load(io.BytesIO(data)) as members:
        arrays = dict(members)
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name}: a number that is not finite")
    return json.loads(arrays.pop(_DOCUMENT).tobytes()), arrays


def row_crc(values: Iterable[Any]) -> int:
    """crc32 of a row's values, with their types and lengths, so that no two rows look alike by shifting."""
    crc = 0
    for value in values:
        body = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogatepass")
        crc = zlib.crc32(body, zlib.crc32(f"{type(value).__name__} {len(body)} ".encode(), crc))
    return crc


class DatabaseDamage(DatabaseCorrupt):
    """Damage at a known place: in which database, where in it, and what."""

    def __init__(self, location: Path | str, where: str, what: str) -> None:
        super().__init__(f"{location}: damaged: {where}: {what}", hint=SALVAGE)
        self.problem = Problem(where, what)


@contextlib.contextmanager
def explained(location: Path | str, where: str) -> Iterator[None]:
    """Turn every exception that decoding damaged content can raise into DatabaseDamage."""
    try:
        yield
    except Pc2GridError:
        raise
    except Exception as error:
        # The message of our own ValueErrors is complete; others are understood only with their type.
        what = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            what = ": ".join((*[".".join(map(str, first["loc"]))] * bool(first["loc"]), first["msg"]))
        raise DatabaseDamage(location, where, what) from error
