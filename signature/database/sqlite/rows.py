"""Rows of a SQLite file: written with their checksum, and read with whether they match it."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.model import Submap
from signature.database import serialize, validation
from signature.database.serialize import Row
from signature.database.sqlite import schema
from signature.describe import Signature


def insert(connection: sqlite3.Connection, table: str, row: Row) -> None:
    """Add a row with its checksum."""
    columns = schema.COLUMNS[table]
    values = [row[column] for column in columns]
    marks = ", ".join("?" * (len(columns) + 1))
    connection.execute(
        f"INSERT INTO {table} ({', '.join(columns)}, crc32) VALUES ({marks})",
        [*values, serialize.row_crc(values)],
    )


def query(
    connection: sqlite3.Connection, path: Path, statement: str, *values: Any
) -> Iterator[tuple[Any, ...]]:
    """The rows of a statement. Raises DatabaseCorrupt where SQLite finds the file damaged."""
    with explained(path, "file"):
        # `yield from` would close the cursor of an unfinished generator, perhaps after the connection.
        for row in connection.execute(statement, values):  # noqa: UP028
            yield row


def select(
    connection: sqlite3.Connection, path: Path, table: str, where: str = "1", *values: Any
) -> Iterator[tuple[Row, bool]]:
    """Rows of a table, each with whether it matches its checksum. Raises DatabaseCorrupt as `query`."""
    columns = schema.COLUMNS[table]
    order = "submap_id" if table == "submap" else columns[0]
    statement = f"SELECT {', '.join(columns)}, crc32 FROM {table} WHERE {where} ORDER BY {order}"
    with explained(path, table):
        for *row, crc in connection.execute(statement, values):
            yield dict(zip(columns, row, strict=True)), serialize.row_crc(row) == crc


@contextlib.contextmanager
def explained(path: Path, where: str) -> Iterator[None]:
    """Turn an error of SQLite, or of decoding, into DatabaseCorrupt.

    Not sqlite3.ProgrammingError: the use of a closed database is a mistake of the caller, not damage.
    """
    with serialize.explained(path, where):
        try:
            yield
        except sqlite3.ProgrammingError:
            raise
        except sqlite3.Error as error:
            raise serialize.corrupt(path, where, f"{type(error).__name__}: {error}") from error


def signature_row(submaps: Sequence[Submap], signatures: Sequence[Signature]) -> Row:
    """All signatures of a session as one row: a search reads them all, and reads them in one piece."""

    def stack(name: str, width: int) -> Any:
        arrays = [getattr(signature, name) for signature in signatures]
        return np.stack(arrays) if arrays else np.empty((0, width), np.float32)

    boundary, freespace, centers_m = (
        stack("boundary", 0),
        stack("freespace", 0),
        [s.center_m for s in submaps],
    )
    return {
        "count": len(submaps),
        "boundary_bins": boundary.shape[1],
        "freespace_bins": freespace.shape[1],
        "submap_id": serialize.pack_array(np.array([s.submap_id for s in submaps], np.int32), "<i4"),
        "center_m": serialize.pack_array(np.array(centers_m, np.float64).reshape(-1, 2), "<f8"),
        "boundary": serialize.pack_array(boundary, "<f4"),
        "freespace": serialize.pack_array(freespace, "<f4"),
        "symmetry": serialize.pack_array(stack("symmetry", 2), "<f4"),
    }


def read_signature_arrays(row: Row) -> dict[str, Any]:
    """The arrays of a signature row by the names of SignatureTable. Raises ValueError if implausible."""
    n = row["count"]
    arrays: dict[str, Any] = {
        "submap_id": serialize.unpack_array(row["submap_id"], "<i4", (n,)),
        "center_m": serialize.unpack_array(row["center_m"], "<f8", (n, 2)),
        "boundary": serialize.unpack_raw(row["boundary"], "<f4", (n, row["boundary_bins"])),
        "freespace": serialize.unpack_raw(row["freespace"], "<f4", (n, row["freespace_bins"])),
        "symmetry": serialize.unpack_array(row["symmetry"], "<f4", (n, 2)),
    }
    for name in ("boundary", "freespace"):
        validation.check_histograms(arrays[name], name)
    validation.check_described(arrays["submap_id"], arrays["center_m"], arrays["symmetry"])
    validation.check_order(arrays["submap_id"])
    return arrays
