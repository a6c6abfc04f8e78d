"""Looking after databases: find damage, copy what is whole, put several together."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pc2grid.errors import DatabaseCorrupt, DatabaseError, Pc2GridError
from signature.database import codec, rows, schema
from signature.database.protocol import Problem
from signature.database.rewrite import rewrite
from signature.database.sqlite_file import connect, read_sessions, read_table, whatever_it_holds


def check(path: Path) -> tuple[Problem, ...]:
    """Read everything and list what is wrong; empty if the file is sound.

    Raises NotADatabase or DatabaseVersion if it is not a file of this format at all.
    """
    problems: list[Problem] = []
    try:
        schema.inspect_header(path)
    except DatabaseCorrupt as error:
        problems.append(Problem("file", error.message))
    with whatever_it_holds(path) as connection:
        problems += _structure(connection, path)
        for table in schema.TABLES:
            problems += [problem for _, problem in read_table(connection, path, table) if problem]
        if not problems:
            problems += _counts(connection, path)
    return tuple(dict.fromkeys(problems))


def copy(source: Path, target: Path, *, recover: bool = False, force: bool = False) -> tuple[Problem, ...]:
    """Write a compact copy. With `recover`, damaged submaps and sessions are left out and returned.

    Raises DatabaseCorrupt for damage without `recover`; OutputError if `target` exists without `force`.
    """
    from pc2grid.io.atomic import refuse_existing

    refuse_existing(target, force)
    problems = check(source)
    if problems and not recover:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise rows.corrupt(source, problems[0].where, problems[0].what + more)
    with rewrite(target, keep=False) as out, whatever_it_holds(source) as connection:
        _copy_sessions(connection, source, out)
    return problems


def merge(sources: Sequence[Path], target: Path, *, force: bool = False) -> int:
    """Put the sessions of several databases into a new one; returns how many.

    A session that several of them hold is taken once. Raises DatabaseError if two different sessions
    share a name, or were made with settings whose submaps cannot be compared.
    """
    from pc2grid.io.atomic import refuse_existing

    refuse_existing(target, force)
    seen: dict[str, tuple[str, Path]] = {}
    with rewrite(target, keep=False) as out:
        for source in sources:
            with contextlib.closing(connect(source)) as connection:
                skip = set()
                first = read_sessions(out, target)
                for _, info in read_sessions(connection, source):
                    if first:
                        rows.refuse_other_settings(
                            first[0][1], info.provenance.config, info.resolution_m, source
                        )
                    document = _document(connection, info.name)
                    known = seen.setdefault(info.name, (document, source))
                    if known[0] != document:
                        raise DatabaseError(
                            f"{source}: its session {info.name!r} is not the {info.name!r} of {known[1]}",
                            hint="convert one of them again under another name (--name)",
                        )
                    if known[1] != source:
                        skip.add(info.name)
                _copy_sessions(connection, source, out, skip=skip, strict=True)
    return len(seen)


def _structure(connection: sqlite3.Connection, path: Path) -> list[Problem]:
    problems = []
    try:
        schema.inspect_tables(connection, path)
        for (message,) in connection.execute("PRAGMA integrity_check"):
            problems += [Problem("file", line) for line in str(message).splitlines() if line != "ok"]
        for table, rowid, *_ in connection.execute("PRAGMA main.foreign_key_check"):
            problems.append(Problem(f"{table} row {rowid}", "belongs to no session"))
    except Pc2GridError as error:
        problems.append(Problem("file", error.message))
    except schema.COMPLAINTS as error:
        problems.append(Problem("file", str(error)))
    return problems


def _counts(connection: sqlite3.Connection, path: Path) -> Iterator[Problem]:
    """Every session must be complete: no row lost as a whole."""
    for session, _ in rows.select(connection, "session"):
        where, session_id = f"session {session['name']!r}", session["id"]
        query = "SELECT count(*) FROM {} WHERE session_id = ?"
        lost = [
            table
            for table in schema.ONE_EACH
            if connection.execute(query.format(table), (session_id,)).fetchone() != (1,)
        ]
        if lost:
            yield Problem(where, f"has no {' and no '.join(lost)}")
            continue
        query = "SELECT submap_id, center_x_m, center_y_m FROM submap WHERE session_id = ? ORDER BY id"
        stored = connection.execute(query, (session_id,)).fetchall()
        ((row, _),) = rows.select(connection, "signature", "session_id = ?", session_id)
        arrays = rows.read_signature_arrays(row)
        described = list(zip(arrays["submap_id"].tolist(), *arrays["center_m"].T.tolist(), strict=True))
        what = rows.unlike(stored, described, rows.read_info(session, 1.0, 0, path).submaps)
        if what:
            yield Problem(where, what)


def _copy_sessions(
    connection: sqlite3.Connection,
    source: Path,
    out: sqlite3.Connection,
    *,
    skip: set[str] | frozenset[str] = frozenset(),
    strict: bool = False,
) -> None:
    """Append the sessions of one file to another, row by row; what is damaged stays behind.

    strict : raise DatabaseCorrupt instead of leaving anything behind.
    """
    (last,) = out.execute("SELECT coalesce(max(id), 0) FROM session").fetchone()
    for session, problem in list(read_table(connection, source, "session")):
        if strict and problem:
            raise rows.corrupt(source, problem.where, problem.what)
        if session is None or problem or session["name"] in skip:
            continue
        parts = {
            table: list(read_table(connection, source, table, "session_id = ?", session["id"]))
            for table in (*schema.ONE_EACH, "submap")
        }
        bad = [p for part in parts.values() for _, p in part if p]
        if strict and bad:
            raise rows.corrupt(source, bad[0].where, bad[0].what)
        if any(len(parts[t]) != 1 or parts[t][0][1] for t in schema.ONE_EACH):
            continue
        submaps = [row for row, fault in parts["submap"] if row is not None and fault is None]
        signature = parts["signature"][0][0]
        assert signature is not None
        kept = {row["submap_id"] for row in submaps}
        last += 1
        rows.insert(
            out, "session", {**session, "id": last, "document": _with_count(session["document"], len(kept))}
        )
        for table in ("grid", "trajectory", "loop"):
            rows.insert(out, table, {**(parts[table][0][0] or {}), "session_id": last})
        for row in submaps:
            rows.insert(out, "submap", {**row, "session_id": last})
        rows.insert(out, "signature", {**_only(signature, kept), "session_id": last})


def _with_count(document: str, submaps: int) -> str:
    import json

    content = {**json.loads(document), "submaps": submaps}
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def _only(signature: rows.Row, kept: set[int]) -> rows.Row:
    """A signature row without the submaps that are not in `kept`."""
    arrays = rows.read_signature_arrays(signature)
    mask = np.isin(arrays["submap_id"], sorted(kept))
    types = {"submap_id": "<i4", "center_m": "<f8", "boundary": "<f4", "freespace": "<f4", "symmetry": "<f4"}
    packed = {name: codec.pack_array(arrays[name][mask], dtype) for name, dtype in types.items()}
    return {**signature, "count": int(mask.sum()), **packed}


def _document(connection: sqlite3.Connection, name: str) -> str:
    (document,) = connection.execute("SELECT document FROM session WHERE name = ?", (name,)).fetchone()
    return str(document)
