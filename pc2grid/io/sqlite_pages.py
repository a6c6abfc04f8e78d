"""The rows of an SQLite file, page by page, without the tree above them.

SQLite finds a row from the root downwards, so one damaged page hides all below it. The pages at the bottom
say themselves what they are (https://www.sqlite.org/fileformat2.html), and each is read on its own here.
Nothing is written, not even beside the file: of a write-ahead log what was committed is read over the pages.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

Value = int | float | str | bytes | None

MAGIC = b"SQLite format 3\0"
_LEAF, _INNER_OF_TABLE = 0x0D, 0x05
# Inner pages of tables and indexes, and the bottom of indexes: no row is lost with them.
_INNER, _INDEX_LEAF = (0x02, _INNER_OF_TABLE), 0x0A
_OF_INDEX = (0x02, _INDEX_LEAF)
_INT_SIZES = (0, 1, 2, 3, 4, 6, 8)
_WAL_MAGIC = {0x377F0682: "<", 0x377F0683: ">"}
_WAL_HEAD, _FRAME_HEAD = 32, 24
_LOCK_BYTE = 1 << 30


class BrokenRow(ValueError):
    """A row that is not whole."""


class Place(NamedTuple):
    """Where a row begins: the number of its page (from 1), and of its cell there."""

    page: int
    cell: int


class Row(NamedTuple):
    """A row of some table.

    values : its columns; the one that stands for the rowid is None.
    """

    rowid: int
    values: tuple[Value, ...]


class SqlitePages:
    """An SQLite file as pages.

    count : whole pages there are. bytes_missing : of those behind them that its header asks for, or of a
    piece of one.
    wal_pages : how many were read from the write-ahead log. wal_bytes_lost : how much of that is damaged.

    Raises ValueError if the header does not even say how large a page is.
    """

    def __init__(self, path: Path, most_bytes: int) -> None:
        self._most = most_bytes
        self._stream: BinaryIO = path.open("rb")
        head = self._stream.read(100)
        self.page_size = int.from_bytes(head[16:18], "big")
        if self.page_size == 1:
            self.page_size = 65536  # which two bytes cannot say
        if len(head) < 100 or self.page_size < 512 or self.page_size & (self.page_size - 1):
            self._stream.close()
            raise ValueError(f"its pages are said to have {self.page_size} bytes")
        self._usable = self.page_size - head[20]
        self.count, cut_off = divmod(path.stat().st_size, self.page_size)
        # The count is only valid if it was written by the change that was counted last.
        wanted = int.from_bytes(head[28:32], "big") if head[24:28] == head[92:96] else 0
        self.bytes_missing = max(wanted - self.count, 0) * self.page_size or cut_off
        self._wal: BinaryIO | None = None
        self._wal_at: dict[int, int] = {}
        self.wal_bytes_lost = 0
        wal = path.with_name(path.name + "-wal")
        if wal.is_file():
            self._wal = wal.open("rb")
            self._wal_at, pages, self.wal_bytes_lost = _committed(self._wal, self.page_size)
            self.count = max(self.count, pages)
        self.wal_pages = len(self._wal_at)
        self._used, self._of_table = bytearray(self.count + 1), bytearray(self.count + 1)

    def close(self) -> None:
        """Close the files."""
        self._stream.close()
        if self._wal is not None:
            self._wal.close()

    def places(self) -> Iterator[Place]:
        """Where rows should be; those that are free are left out."""
        free = self._free()
        for number in range(2, self.count + 1):  # the first describes the tables: none of their rows is there
            page = self._page(number)
            if number in free:
                continue
            if page[:1] == bytes([_INNER_OF_TABLE]):
                self._note_children(page)
            if page[:1] != bytes([_LEAF]):
                continue
            cells = int.from_bytes(page[3:5], "big")
            for cell in range(min(cells, self._usable // 4)):
                yield Place(number, cell)

    def row(self, place: Place) -> Row:
        """The row at a place. Raises BrokenRow if it is not whole, or larger than allowed."""
        return self._read(place)[0]

    def take(self, place: Place) -> Row:
        """The same for the first time: its pages are noted as used, and must not have been.

        Raises BrokenRow.
        """
        row, chain = self._read(place)
        if any(self._used[number] for number in chain):
            raise BrokenRow("two rows share a page")
        for number in (place.page, *chain):
            self._used[number] = 1
        return row

    def unused(self) -> int:
        """How many pages belong to no row that was taken, and are not free or above the rows either.

        To be asked when all `places` were seen.
        """
        known = self._free() | self._maps() | {1, _LOCK_BYTE // self.page_size + 1}
        pages = (n for n in range(2, self.count + 1) if n not in known and not self._used[n])
        return sum(not self._is_rowless(self._page(n), bool(self._of_table[n])) for n in pages)

    def _note_children(self, page: bytes) -> None:
        """A page further up in a table says which pages belong to it: no index may stand there."""
        cells = min(int.from_bytes(page[3:5], "big"), (self._usable - 12) // 2)
        for at in (8, *struct.unpack_from(f">{cells}H", page, 12)):
            child = int.from_bytes(page[at : at + 4], "big")
            if child <= self.count:
                self._of_table[child] = 1

    def _is_rowless(self, page: bytes, of_table: bool) -> bool:
        """Whether there is nothing on a page that would be missed."""
        if of_table and page[0] in _OF_INDEX:
            return False
        if page[0] in _INNER:
            return 1 < int.from_bytes(page[8:12], "big") <= self.count  # its last child
        # With no row on it, SQLite says that the rows begin where the page ends; for 65536 it writes 0.
        empty = bytes([_LEAF, 0, 0, 0, 0]) + (self._usable & 0xFFFF).to_bytes(2, "big") + b"\0"
        return page[0] == _INDEX_LEAF or page[:8] == empty

    def _page(self, number: int) -> bytes:
        if number in self._wal_at:
            assert self._wal is not None
            self._wal.seek(self._wal_at[number])
            return self._wal.read(self.page_size)
        self._stream.seek((number - 1) * self.page_size)
        return self._stream.read(self.page_size)

    def _free(self) -> set[int]:
        """Pages of deleted rows: what stands in them is not to come back."""
        free: set[int] = set()
        trunk = int.from_bytes(self._page(1)[32:36], "big")
        while 0 < trunk <= self.count and trunk not in free:
            page = self._page(trunk)
            free.add(trunk)
            listed = min(int.from_bytes(page[4:8], "big"), self._usable // 4 - 2)
            free.update(struct.unpack_from(f">{listed}I", page, 8))
            trunk = int.from_bytes(page[:4], "big")
        return free

    def _maps(self) -> set[int]:
        """Pages that say whose child each page is; only files that shrink by themselves have them."""
        if not int.from_bytes(self._page(1)[52:56], "big"):
            return set()
        return set(range(2, self.count + 1, self._usable // 5 + 1))

    def _read(self, place: Place) -> tuple[Row, list[int]]:
        page = self._page(place.page)
        at = int.from_bytes(page[8 + 2 * place.cell : 10 + 2 * place.cell], "big")
        size, at = _varint(page, at)
        rowid, at = _varint(page, at)
        if size > self._most:
            raise BrokenRow(f"a row of {size} bytes; the limit is {self._most}")
        local = self._local(size)
        parts, chain = [page[at : at + local]], list[int]()
        if at + local + (4 if local < size else 0) > self._usable:
            raise BrokenRow("a row leaves its page")
        missing = size - local
        next_page = int.from_bytes(page[at + local : at + local + 4], "big") if missing else 0
        while missing > 0:
            if not 1 < next_page <= self.count or len(chain) * (self._usable - 4) > size:
                raise BrokenRow("a row goes on where there is no page")
            chain.append(next_page)
            page = self._page(next_page)
            next_page = int.from_bytes(page[:4], "big")
            parts.append(page[4 : min(4 + missing, self._usable)])
            missing -= len(parts[-1])
        if next_page or len(set(chain)) < len(chain):
            raise BrokenRow("a row is longer than it says")
        return Row(_signed(rowid, 8), _values(b"".join(parts))), chain

    def _local(self, size: int) -> int:
        """How much of a row of `size` bytes stands on its own page."""
        most = self._usable - 35
        if size <= most:
            return size
        least = (self._usable - 12) * 32 // 255 - 23
        rest = least + (size - least) % (self._usable - 4)
        return rest if rest <= most else least


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of one to nine bytes, and where it ends."""
    value = 0
    for i in range(9):
        if at + i >= len(data):
            raise BrokenRow("a row ends within a number")
        byte = data[at + i]
        if i == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + i + 1
    raise AssertionError


def _signed(value: int, size: int) -> int:
    return value - (1 << 8 * size) if value >> (8 * size - 1) else value


def _values(record: bytes) -> tuple[Value, ...]:
    """The columns of a record: their types in front, one behind the other."""
    head_size, at = _varint(record, 0)
    if head_size > len(record):
        raise BrokenRow("the head of a row is longer than the row")
    body, values = head_size, list[Value]()
    while at < head_size:
        kind, at = _varint(record, at)
        size = _INT_SIZES[kind] if kind < 7 else 8 if kind == 7 else max(kind - 12, 0) // 2
        raw = record[body : body + size]
        if len(raw) < size or kind in (10, 11):
            raise BrokenRow("a row is shorter than its columns")
        body += size
        if kind == 0:
            values.append(None)
        elif kind < 7:
            values.append(int.from_bytes(raw, "big", signed=True))
        elif kind == 7:
            values.append(float(struct.unpack(">d", raw)[0]))
        elif kind < 10:
            values.append(kind - 8)
        elif kind % 2:
            values.append(_text(raw))
        else:
            values.append(raw)
    if at != head_size or body != len(record):
        raise BrokenRow("a row is not as long as its columns")
    return tuple(values)


def _text(raw: bytes) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        raise BrokenRow("a text is none") from None


class _Log(NamedTuple):
    """Where a write-ahead log holds the newest version of each page, and how many the file then has.

    lost : bytes of it that cannot be believed.
    """

    places: dict[int, int]
    pages: int
    lost: int


def _committed(wal: BinaryIO, page_size: int) -> _Log:
    """As in SQLite, what counts are frames whose checksums are right, up to the last that ends a change."""
    size = wal.seek(0, 2)
    wal.seek(0)
    head = wal.read(_WAL_HEAD)
    order = _WAL_MAGIC.get(int.from_bytes(head[:4], "big"))
    if order is None or len(head) < _WAL_HEAD or int.from_bytes(head[8:12], "big") != page_size:
        return _Log({}, 0, 0)
    sums = _checksum(head[:24], order, (0, 0))
    if sums != struct.unpack(">II", head[24:32]):
        return _Log({}, 0, size)
    done: dict[int, int] = {}
    pages, end, lost = 0, _WAL_HEAD, 0
    pending: dict[int, int] = {}
    while True:
        at = wal.tell() + _FRAME_HEAD
        frame, page = wal.read(_FRAME_HEAD), wal.read(page_size)
        if len(page) < page_size or frame[8:16] != head[16:24]:
            break  # the end, or what an earlier log left there
        sums = _checksum(page, order, _checksum(frame[:8], order, sums))
        if sums != struct.unpack(">II", frame[16:24]):
            lost = size - end
            break
        pending[int.from_bytes(frame[:4], "big")] = at
        after = int.from_bytes(frame[4:8], "big")
        if after:
            done |= pending
            pages, end, pending = after, wal.tell(), {}
    return _Log(done, pages, lost)


def _checksum(data: bytes, order: str, sums: tuple[int, int]) -> tuple[int, int]:
    a, b = sums
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for x, y in zip(words[::2], words[1::2], strict=True):
        a = (a + x + b) & 0xFFFFFFFF
        b = (b + y + a) & 0xFFFFFFFF
    return a, b
