"""Frozen types as a JSON document and named arrays, and back.

`encode` follows the fields of a dataclass, by their declared types. Numbers, text, tuples,
mappings, settings and further dataclasses are written into the document. Arrays leave it and are named by
their path, such as `grid.cells`. Two kinds of tuples become arrays as well: one of enum members is stored as
their indices, and one of dataclasses that hold arrays column by column, `loops.information` for all loops.

`decode` trusts nothing: a field that is missing or unknown, a value of another type or outside its plausible
range (`validation.number`), an array of another type, shape or length raises ValueError that names it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import json
import math
import struct
import types
import typing
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, Union

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import hand_over
from pc2grid.errors import DatabaseCorrupt
from signature.database import validation
from signature.database.protocol import Problem

Array = NDArray[Any]
Value = int | float | str | bytes | None
T = TypeVar("T")

SALVAGE = "`pc2grid db check` lists all damage, `pc2grid db copy --recover` keeps what is whole"
MOST_BYTES = 1_200_000_000
"""Largest array that is read: the steps of 100 million points in space, 50,000 m2 at 5 cm."""
UNCOMPRESSED = {"compress": False}
"""Metadata of a field whose arrays are stored as they are, because a search reads all of them."""
_ARRAY = "array"
"""What the document has in place of an array."""
_ZLIB_LEVEL = 6
"""zlib's own default; a part of the format only in that equal sessions give equal bytes."""
_DTYPES = {
    name: np.dtype(name).newbyteorder("<")
    for name in ("bool", "int8", "uint8", "int32", "int64", "float32", "float64")
}
_OF_COLUMN = {bool: np.dtype(np.bool_), int: np.dtype(np.int64), float: np.dtype(np.float64)}


class Packed(NamedTuple):
    """An array as it is stored: name of its type, its extents as a JSON list, its bytes."""

    dtype: str
    shape: str
    data: bytes


# --- values -------------------------------------------------------------------------------------------


def to_json(document: Any) -> str:
    """Canonical JSON: equal content, equal bytes."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def clean(word: str) -> str:
    """Text as it can be stored: bytes of a name that are not valid UTF-8 become escapes such as `\\xff`."""
    return word.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def encode(kind: Any, value: Any, path: str, arrays: dict[str, Array]) -> Any:
    """The document of a value that is declared as `kind`; its arrays are added to `arrays`, by their path."""
    return _coding(kind).encode(value, path, arrays)


def decode(kind: Any, content: Any, path: str, arrays: dict[str, Array]) -> Any:
    """The inverse of `encode`, which takes what it uses from `arrays`.

    Raises ValueError for what `encode` does not make.
    """
    return _coding(kind).decode(content, path, arrays)


class _Coding(Protocol):
    """How values of one type are stored; `decode` is the inverse of `encode`."""

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any: ...

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any: ...


@functools.cache
def _coding(kind: Any) -> _Coding:
    """How values of a type are stored: what follows from the type is found out once."""
    if (bare := _without_none(kind)) is not kind:
        return _OrNone(_coding(bare))
    if kind in _SCALARS:
        return _Scalar(kind)
    if (dtype := _dtype_of(kind)) is not None:
        return _Array(dtype)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return _coding_of_tuple(arguments)
    if _is_a(origin, Mapping):
        return _Mapping(_coding(arguments[1]))
    if _is_dataclass(kind):
        return _Instance(kind)
    return _Settings(kind)


def _coding_of_tuple(arguments: tuple[Any, ...]) -> _Coding:
    if arguments[-1] is not ...:
        return _Items(tuple(map(_coding, arguments)))
    if _is_enum(arguments[0]):
        return _Members(arguments[0])
    if _holds_arrays(arguments[0]):
        return _Rows(arguments[0])
    return _Items((_coding(arguments[0]),), repeated=True)


@dataclass(frozen=True)
class _OrNone:
    some: _Coding

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        return None if value is None else self.some.encode(value, path, arrays)

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        return None if content is None else self.some.decode(content, path, arrays)


@dataclass(frozen=True)
class _Scalar:
    kind: Any

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        return clean(value) if self.kind is str else self.kind(value)

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        return _SCALARS[self.kind](content, path.rpartition(".")[2])


@dataclass(frozen=True)
class _Array:
    dtype: np.dtype[Any]

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        arrays[path] = np.ascontiguousarray(value, self.dtype)
        return _ARRAY

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        _expect(content == _ARRAY, path, content, "an array")
        return _taken(arrays, path, self.dtype)


@dataclass(frozen=True)
class _Members:
    """A tuple of enum members: the array of their indices."""

    kind: Any

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        arrays[path] = _indices(self.kind, value)
        return _ARRAY

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        _expect(content == _ARRAY, path, content, "an array")
        return tuple(_members(self.kind, _taken(arrays, path, np.dtype(np.uint8)), path))


@dataclass(frozen=True)
class _Rows:
    """A tuple of dataclasses that hold arrays: one array for each of their fields."""

    kind: Any

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        _encode_columns(self.kind, value, path, arrays)
        return len(value)

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        return tuple(_decode_columns(self.kind, validation.count(content, path), path, arrays))


@dataclass(frozen=True)
class _Items:
    """Any other tuple: of one type each, or, `repeated`, any number of the first type."""

    items: tuple[_Coding, ...]
    repeated: bool = False

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        return [item.encode(one, path, arrays) for item, one in zip(self._of(value), value, strict=True)]

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        _expect(isinstance(content, list), path, content, "a list")
        items = self._of(content)
        _expect(len(items) == len(content), path, content, f"{len(items)} values")
        return tuple(item.decode(one, path, arrays) for item, one in zip(items, content, strict=True))

    def _of(self, values: Sequence[Any]) -> tuple[_Coding, ...]:
        return self.items * len(values) if self.repeated else self.items


@dataclass(frozen=True)
class _Mapping:
    value: _Coding

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        return {clean(key): self.value.encode(item, path, arrays) for key, item in value.items()}

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        _expect(isinstance(content, dict), path, content, "an object")
        return {key: self.value.decode(item, _join(path, key), arrays) for key, item in content.items()}


class _Instance:
    """An instance of a dataclass: its fields by name."""

    def __init__(self, kind: Any) -> None:
        self._kind = kind
        self._fields = {name: _coding(field) for name, field in fields_of(kind).items()}
        # A field that was added to a stored type is None, or holds nothing, in the sessions of before.
        without: dict[Any, Any] = {None: None, (): []}
        self._added = {
            field.name: without[field.default]
            for field in dataclasses.fields(kind)
            if field.default in without
        }

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        return {
            name: field.encode(getattr(value, name), _join(path, name), arrays)
            for name, field in self._fields.items()
        }

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        _expect(isinstance(content, dict), path, content, "an object")
        content = self._added | content
        if odd := sorted(map(str, content.keys() ^ self._fields.keys())):
            raise ValueError(f"{path}: {'has no' if odd[0] in self._fields else 'unknown'} {odd[0]}")
        return self._kind(
            **{
                name: field.decode(content[name], _join(path, name), arrays)
                for name, field in self._fields.items()
            }
        )


@dataclass(frozen=True)
class _Settings:
    kind: Any

    def encode(self, value: Any, path: str, arrays: dict[str, Array]) -> Any:
        return value.model_dump(mode="json")

    def decode(self, content: Any, path: str, arrays: dict[str, Array]) -> Any:
        return _settings(self.kind, json.dumps(content, sort_keys=True))


def _whole(value: Any, name: str) -> int:
    return validation.stamp(value, name) if name.endswith("_ns") else validation.count(value, name)


_SCALARS: dict[Any, Callable[[Any, str], Any]] = {
    bool: validation.flag,
    str: validation.text,
    float: lambda value, name: float(validation.number(value, name)),
    int: _whole,
}


def _taken(arrays: dict[str, Array], path: str, dtype: np.dtype[Any]) -> Array:
    """The array of a path. Raises ValueError if there is none, or one of another type."""
    if path not in arrays:
        raise ValueError(f"{path} is missing")
    array = arrays.pop(path)
    if array.dtype != dtype:
        raise ValueError(f"{path} is of {array.dtype} instead of {dtype}")
    return array


@functools.cache
def fields_of(kind: Any) -> dict[str, Any]:
    """Name -> type of the fields of a dataclass."""
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


@functools.lru_cache(maxsize=64)
def _settings(kind: Any, text: str) -> Any:
    """Cached: most sessions of a database have the same settings."""
    return kind.model_validate_json(text)


def _encode_columns(kind: Any, rows: tuple[Any, ...], path: str, arrays: dict[str, Array]) -> None:
    for name, field in fields_of(kind).items():
        column, at = [getattr(row, name) for row in rows], _join(path, name)
        if _is_dataclass(field):
            _encode_columns(field, tuple(column), at, arrays)
        elif _is_enum(field):
            arrays[at] = _indices(field, column)
        else:
            arrays[at] = np.array(column, _dtype_of(field) or _OF_COLUMN[field])


def _decode_columns(kind: Any, count: int, path: str, arrays: dict[str, Array]) -> list[Any]:
    columns = []
    for name, field in fields_of(kind).items():
        at = _join(path, name)
        if _is_dataclass(field):
            columns.append(_decode_columns(field, count, at, arrays))
            continue
        is_enum, dtype = _is_enum(field), _dtype_of(field)
        array = _taken(arrays, at, np.dtype(np.uint8) if is_enum else dtype or _OF_COLUMN[field])
        if len(array) != count or (dtype is None and array.ndim != 1):
            raise ValueError(f"{at} has the shape {array.shape} where {count} were stored")
        columns.append(
            _members(field, array, at) if is_enum else array.tolist() if dtype is None else list(array)
        )
    names = fields_of(kind)
    return [kind(**dict(zip(names, row, strict=True))) for row in zip(*columns, strict=True)]


def _indices(kind: Any, members: Iterable[enum.Enum]) -> Array:
    order = list(kind)
    return np.array([order.index(member) for member in members], np.uint8)


def _members(kind: Any, indices: Array, path: str) -> list[Any]:
    order = list(kind)
    if indices.ndim != 1 or (indices >= len(order)).any():
        raise ValueError(f"{path}: an unknown {kind.__name__.lower()}")
    return [order[index] for index in indices.tolist()]


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _expect(right: bool, path: str, content: Any, what: str) -> None:
    if not right:
        raise ValueError(f"{path} is {validation.shown(content)} instead of {what}")


@functools.cache
def _without_none(kind: Any) -> Any:
    """`X` of `X | None`, else the type itself."""
    if typing.get_origin(kind) in (Union, types.UnionType):
        (kind,) = (part for part in typing.get_args(kind) if part is not type(None))
    return kind


@functools.cache
def _dtype_of(kind: Any) -> np.dtype[Any] | None:
    """The type of the entries of an array type, None for other types."""
    if typing.get_origin(kind) is not np.ndarray:
        return None
    dtype: np.dtype[Any] = np.dtype(typing.get_args(typing.get_args(kind)[1])[0])
    return dtype


def _is_a(kind: Any, base: type) -> bool:
    return isinstance(kind, type) and issubclass(kind, base)


def _is_dataclass(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind)


def _is_enum(kind: Any) -> bool:
    return _is_a(kind, enum.Enum)


@functools.cache
def _holds_arrays(kind: Any) -> bool:
    return _is_dataclass(kind) and any(
        _dtype_of(field) is not None or _holds_arrays(field) for field in fields_of(kind).values()
    )


# --- arrays to bytes ----------------------------------------------------------------------------------


def pack(array: Array, *, compress: bool = True) -> Packed:
    """Little-endian bytes of an array of one or more axes, or what zlib makes of them if that is shorter.

    For zlib the first axis becomes the last, and the bytes of the entries are sorted by their significance:
    of poses, points and paths, most components then change slowly or not at all.
    """
    name = array.dtype.name
    data = np.ascontiguousarray(array, _DTYPES[name]).tobytes()
    if compress:
        turned = np.ascontiguousarray(np.moveaxis(array, 0, -1), _DTYPES[name]).reshape(-1)
        planes = turned.view(np.uint8).reshape(-1, array.itemsize).T.tobytes()
        smaller = zlib.compress(planes, _ZLIB_LEVEL)
        if len(smaller) < len(data):
            return Packed(name, to_json(array.shape), smaller)
    return Packed(name, to_json(array.shape), data)


def unpack(packed: Packed) -> Array:
    """The array back, read-only. Raises ValueError if type, shape, length or numbers are impossible.

    Never expands to more than the shape says.
    """
    dtype = _DTYPES.get(validation.text(packed.dtype, "dtype"))
    shape = json.loads(validation.text(packed.shape, "shape"))
    if dtype is None or not isinstance(shape, list) or not shape:
        raise ValueError(f"an array of {packed.dtype} and the shape {packed.shape}")
    size = math.prod(validation.count(extent, "shape") for extent in shape) * dtype.itemsize
    if size > MOST_BYTES:
        raise ValueError(f"an array of {size} bytes, more than {MOST_BYTES}")
    if not isinstance(packed.data, bytes) or len(packed.data) > size:
        raise ValueError(f"{len(packed.data)} bytes where {packed.shape} of {packed.dtype} needs {size}")
    whole = len(packed.data) == size
    array = (
        np.frombuffer(packed.data, dtype).reshape(shape) if whole else _expanded(packed.data, dtype, shape)
    )
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("an entry that is neither true nor false")
    if dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError("a number that is not finite")
    return array


def _expanded(data: bytes, dtype: np.dtype[Any], shape: list[int]) -> Array:
    """What `pack` compressed, in the order it had before."""
    planes = np.frombuffer(_inflate(data, math.prod(shape) * dtype.itemsize), np.uint8)
    entries = np.ascontiguousarray(planes.reshape(dtype.itemsize, -1).T).reshape(-1).view(dtype)
    return hand_over(np.ascontiguousarray(np.moveaxis(entries.reshape(*shape[1:], shape[0]), -1, 0)))


def _inflate(data: bytes, size: int) -> bytes:
    """Decompress exactly `size` bytes; never allocates more than that."""
    inflate = zlib.decompressobj()
    try:
        # max_length 0 would mean "no limit" to zlib.
        raw = inflate.decompress(data, size + 1)
    except zlib.error as error:
        raise ValueError(f"compressed data: {error}") from None
    if len(raw) != size or not inflate.eof or inflate.unused_data:
        raise ValueError(f"compressed data does not hold the {size} bytes it should")
    return raw


# --- checksums and damage -----------------------------------------------------------------------------


def row_crc(values: Iterable[Value]) -> int:
    """crc32 of a row's values, with their types and lengths, so that no two rows look alike by shifting."""
    crc = 0
    for value in values:
        if value is None:
            head, body = b"n", b""
        elif isinstance(value, bytes):
            head, body = b"b" + struct.pack("<q", len(value)), value
        elif isinstance(value, str):
            body = value.encode("utf-8", "surrogatepass")
            head = b"s" + struct.pack("<q", len(body))
        elif isinstance(value, float):
            head, body = b"f", struct.pack("<d", value + 0.0)  # SQLite keeps no sign of zero
        else:
            head, body = b"i", struct.pack("<q", value)
        crc = zlib.crc32(body, zlib.crc32(head, crc))
    return crc


class DatabaseDamage(DatabaseCorrupt):
    """DatabaseDamage at a known place: in which database, where in it, and what."""

    def __init__(self, location: Path | str, where: str, what: str) -> None:
        super().__init__(f"{location}: damaged: {where}: {what}", hint=SALVAGE)
        self.problem = Problem(where, what)


@contextlib.contextmanager
def explained(location: Path | str, where: str) -> Iterator[None]:
    """Turn every exception that decoding damaged content can raise into DatabaseDamage."""
    try:
        yield
    except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, RecursionError) as error:
        # The message of our own ValueErrors is complete; others are understood only with their type.
        what = str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"
        raise DatabaseDamage(location, where, what) from error
